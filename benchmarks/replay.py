# SPDX-License-Identifier: Apache-2.0
"""Replay of the bags in ``bags/``, in one run with rosbags deserialising the same messages, and by stages.

All figures are CPU times; the subjects take turns, and the best of several rounds counts.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from rosbags.highlevel import AnyReader

from benchmarks.days import REPOSITORY
from benchmarks.tables import Table, columns
from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import typestore
from trainid_ros.compiled import SWITCH, uses_sources
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.train.train_file import TrainFile, load_train_file

_BAGS: Final = ('yizhuang_day', 'altrios_manifest')
_ROUNDS: Final = 5
_TICK_S: Final = 0.2
_SETTINGS: Final = EstimatorSettings()
_MAKERS: Final = {name: kind.pipeline for name, kind in zip(('filter bank', 'AM-VFF-RLS', 'GSMA'), KINDS, strict=True)}
# What the project wants: CPU time over that of rosbags deserialising, and times real time.
_MAX_RATIO: Final = 1.0
_MIN_PACE: Final = 5000.0
# One replay by the sources, in a process of its own because the choice is made at import.
_BY_SOURCES: Final = """
import sys
sys.path.insert(0, '.')
from pathlib import Path
from benchmarks.replay import paced
print(paced(Path(sys.argv[1])))
"""


@dataclass(frozen=True, slots=True)
class Times:
    """Size of a bag, its duration [s], and CPU times over the whole bag by subject [s]."""

    bag: str
    messages: int
    duration_s: float
    spent: dict[str, float]
    by_sources: float


def measure() -> tuple[Table, ...]:
    times = [_times(REPOSITORY / 'bags' / name) for name in _BAGS]
    return _pace_table(times), _stage_table(times)


def _pace_table(times: list[Times]) -> Table:
    rows = []
    for item in times:
        alone, read, replayed = (item.spent[name] for name in ('deserialise', 'rosbags', 'replay'))
        numbers = (
            f'{alone:.2f}',
            f'{read:.2f}',
            f'{replayed:.2f}',
            f'{replayed / alone:.2f}',
            f'{item.duration_s / replayed:.0f}',
            f'{item.duration_s / item.by_sources:.0f}',
        )
        rows.append((item.bag, str(item.messages), f'{item.duration_s:.0f}', *numbers))
    header = columns(
        'CPU s | messages | recorded s | rosbags deserialises | and reads | trainid replay | over deserialising | '
        'x real time | its sources, x real time'
    )
    kind = 'Nothing was compiled.' if uses_sources() else 'With compiled modules, but for the last column.'
    note = f'{kind} Targets: at most {_MAX_RATIO:.1f} times deserialising, and at least {_MIN_PACE:.0f} x real time.'
    return Table('Pace of trainid replay with three estimators', header, tuple(rows), note)


def _stage_table(times: list[Times]) -> Table:
    rows = []
    for item in times:
        us = 1e6 * _TICK_S / item.duration_s
        before = item.spent['stream']
        stages = [item.spent['rows'], before - item.spent['rows']]
        stages += [item.spent[name] - before for name in _MAKERS]
        rows.append((item.bag, *(f'{us * stage:.1f}' for stage in stages)))
    header = ('us per tick of 0.2 s', 'reading', 'stream', *_MAKERS)
    note = 'By differences of runs: rows only; with correction, alignment and checks; with one pipeline at a time.'
    return Table('Where the time goes', header, tuple(rows), note)


def paced(bag: Path) -> float:
    """Return the CPU time of a replay with all three estimators [s]."""
    train = load_train_file(bag / 'train.yaml')
    began = time.process_time()
    with BagReader(bag) as reader:
        replay_through(Pipelines.of(train, _SETTINGS), reader)
    return time.process_time() - began


def _times(bag: Path) -> Times:
    train = load_train_file(bag / 'train.yaml')
    raw = _raw(bag)
    subjects: dict[str, Callable[[], object]] = {
        'deserialise': lambda: _deserialise(raw),
        'rosbags': lambda: _deserialise(_raw(bag)),
        'rows': lambda: _rows(bag),
        'stream': lambda: _stream(bag, train),
        'replay': lambda: paced(bag),
        **{name: partial(_alone, bag, maker, train) for name, maker in _MAKERS.items()},
    }
    spent = dict.fromkeys(subjects, float('inf'))
    for _ in range(_ROUNDS):
        for name, run in subjects.items():
            began = time.process_time()
            run()
            spent[name] = min(spent[name], time.process_time() - began)
    with BagReader(bag) as reader:
        duration_s = replay_through(Pipelines.of(train, _SETTINGS), reader).duration_s
    return Times(bag.name, len(raw), duration_s, spent, _by_sources(bag))


def _raw(bag: Path) -> list[tuple[bytes, str]]:
    with AnyReader([bag], default_typestore=typestore()) as reader:
        wanted = [item for item in reader.connections if item.msgtype.startswith('trainid_msgs/')]
        return [(bytes(data), item.msgtype) for item, _, data in reader.messages(connections=wanted)]


def _deserialise(raw: list[tuple[bytes, str]]) -> None:
    store = typestore()
    for data, kind in raw:
        store.deserialize_cdr(data, kind)


def _rows(bag: Path) -> None:
    with BagReader(bag) as reader:
        for _ in reader.rows():
            pass


def _stream(bag: Path, train: TrainFile) -> None:
    stream = SampleStream(StreamConfig(train))
    with BagReader(bag) as reader:
        for _, row in reader.rows():
            stream.push_row(*row)


def _alone(bag: Path, maker: Callable[..., Any], train: TrainFile) -> None:
    with BagReader(bag) as reader:
        PipelineGroup([maker(train, _SETTINGS)]).push_rows(row for _, row in reader.rows())


def _by_sources(bag: Path) -> float:
    command = [sys.executable, '-c', _BY_SOURCES, str(bag)]
    env = os.environ | {SWITCH: '0'}
    done = subprocess.run(command, cwd=REPOSITORY, env=env, capture_output=True, text=True, check=True)
    return float(done.stdout)
