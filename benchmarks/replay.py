# SPDX-License-Identifier: Apache-2.0
"""Replay of the bags in ``bags/``: speed relative to real time, and share of each stage."""

from __future__ import annotations

import cProfile
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from benchmarks.days import REPOSITORY
from benchmarks.tables import Table
from trainid_ros.bag.bag_replay import Replay, replay
from trainid_ros.bag.reader import BagReader
from trainid_ros.estimators.pipeline import EstimatorSettings
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from pathlib import Path

_BAGS: Final = ('yizhuang_day', 'altrios_manifest')
# Stage, and the function that does it (including its callees).
_STAGES: Final = (
    ('reading', 'BagReader.messages'),
    ('to records', 'record_from_message'),
    ('aligning', 'Aligner.push'),
    ('filter bank', 'FilterBank.step'),
    ('AM-VFF-RLS', 'SpeedModelEstimator.step'),
    ('GSMA', 'BrakeRateEstimator.step'),
)


@dataclass(frozen=True, slots=True)
class Pace:
    """Replay of one bag: size, duration and computing time [s], and the share of each stage."""

    bag: str
    records: int
    duration_s: float
    wall_s: float
    cpu_s: float
    shares: tuple[float, ...]


def measure() -> tuple[Table, ...]:
    """Replay all bags; return the table."""
    paces = [_pace(REPOSITORY / 'bags' / name) for name in _BAGS]
    speed_header = ('bag', 'records', 'recorded s', 'wall s', 'CPU s', 'x real time (wall)', 'x real time (CPU)')
    speed = Table('Speed of trainid replay', speed_header, tuple(_speed_row(pace) for pace in paces))
    share_header = ('share of the time', *(name for name, _ in _STAGES), 'rest')
    rows = tuple((pace.bag, *(f'{share:.0%}' for share in (*pace.shares, 1.0 - sum(pace.shares)))) for pace in paces)
    note = (
        'By cProfile, which overstates the cost of small Python functions. Each estimator has its own aligner, as in '
        'its node. "rest": pipelines, estimates computed for outputs, the loop.'
    )
    return speed, Table('Where the time goes', share_header, rows, note)


def _speed_row(pace: Pace) -> tuple[str, ...]:
    times = (f'{pace.duration_s:.0f}', f'{pace.wall_s:.1f}', f'{pace.cpu_s:.1f}')
    paces = (f'{pace.duration_s / spent:.0f}' for spent in (pace.wall_s, pace.cpu_s))
    return pace.bag, str(pace.records), *times, *paces


def _pace(bag: Path) -> Pace:
    wall, cpu = time.perf_counter(), time.process_time()
    outcome = _replayed(bag)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return Pace(bag.name, outcome.records, outcome.duration_s, wall, cpu, _shares(bag))


def _replayed(bag: Path) -> Replay:
    with BagReader(bag) as reader:
        return replay(reader, load_train_file(bag / 'train.yaml'), EstimatorSettings())


def _shares(bag: Path) -> tuple[float, ...]:
    """Return the share of each stage in the time of a replay."""
    profile = cProfile.Profile()
    profile.runcall(_replayed, bag)
    total, spent = 0.0, dict.fromkeys((function for _, function in _STAGES), 0.0)
    for entry in profile.getstats():
        total = max(total, entry.totaltime)
        if not isinstance(entry.code, str) and entry.code.co_qualname in spent:
            spent[entry.code.co_qualname] += entry.totaltime
    return tuple(value / total for value in spent.values())
