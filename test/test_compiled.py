# SPDX-License-Identifier: Apache-2.0
"""Compiled modules give the same numbers as their sources, to the bit: every sample and output of a hard drive."""

from __future__ import annotations

import math
import os
import struct
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pytest

from benchmarks.yizhuang_day import yizhuang_day
from trainid_ros.compiled import SWITCH, uses_sources
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, SpeedRecord
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.setup.pipelines import (
    RESISTANCE,
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.sim.scenario import simulate
from trainid_ros.stream import alignment
from trainid_ros.stream.alignment import TimeJump
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import TrainFile, load_train_file

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.records import Record
    from trainid_ros.interface.results import Output

ROOT: Final = Path(__file__).resolve().parents[1]
EFFECTS: Final = (
    'stamp_skew:delay=0.06',
    'wheel_diameter:ratio=1.01',
    'curve_resistance:coefficient=700',
    'brake_fade:loss=0.2,energy=300',
    'gradient_error:permille=1.5,start=500,end=900',
    'brake_scale:ratio=0.95',
)
# The last fault begins at 250 s.
END_S: Final = 265
# A double counts nanoseconds only up to 104 days.
YEAR_NS: Final = 365 * 24 * 3600 * NS_PER_S
FAULTS: Final = {
    *(Reason.NOT_FINITE, Reason.OUT_OF_RANGE, Reason.ZERO_STAMP, Reason.LATE, Reason.DUPLICATE, Reason.STAMP_JUMP),
    *(Reason.GAP, Reason.FORCE_MISSING, Reason.BRAKE_COMMAND_MISSING, Reason.THINNED),
    Reason.CONTRADICTION,
}


def hard(records: Iterable[Record]) -> list[Record]:
    """Return records with every fault: gaps, jumps, late, double and impossible ones, a stuck speed, a fast topic."""
    found: list[Record] = []
    first_ns, late, stuck = 0, [], 0.0
    for k, record in enumerate(records):
        first_ns = first_ns or record.stamp_ns
        second = (record.stamp_ns - first_ns) / NS_PER_S
        if 60.0 <= second < 63.0 or (isinstance(record, BrakeRecord) and 135.0 <= second < 139.0):
            continue
        stamp_ns = record.stamp_ns + (0 if second < 150.0 else -3600 * NS_PER_S if second < 250.0 else YEAR_NS)
        moved = replace(record, stamp_ns=stamp_ns)
        if isinstance(moved, SpeedRecord):
            if 20.0 <= second < 58.0:
                moved = replace(moved, speed=stuck)
            stuck = moved.speed
            if 40.0 <= second < 50.0:  # at 10 Hz
                found.append(replace(moved, stamp_ns=stamp_ns - NS_PER_S // 10))
            if k % 100 < 4:
                found.append(replace(moved, speed=math.nan))
        if isinstance(moved, GradientRecord) and 200.0 <= second < 300.0:
            moved = replace(moved, curve_radius=500.0 + second, tunnel=second > 240.0)
        if isinstance(moved, ForceRecord) and k % 100 < 4:
            found += [replace(moved, force=1e9), replace(moved, stamp_ns=0)]
        if k % 97 == 0:
            late.append(moved)
            continue
        found.append(moved)
        if k % 53 == 0:
            found.append(moved)
        if k % 97 == 12:
            found += late
            late.clear()
        if k % 211 == 0:
            found.append(replace(moved, stamp_ns=stamp_ns - YEAR_NS))
    return found


def numbers(value: Any) -> Iterable[bytes]:
    """Yield all numbers in a result, exactly."""
    if is_dataclass(value):
        for item in fields(value):
            yield from numbers(getattr(value, item.name))
    elif isinstance(value, tuple):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, float):
        yield struct.pack('<d', math.nan if math.isnan(value) else value)
    else:
        yield str(value).encode()


def digest(train_file: TrainFile, records: list[Record]) -> tuple[str, set[str]]:
    """Return a hash of all that streams and estimators make of records, and which kinds of events were among it."""
    found, kinds = sha256(), set()

    def take(value: object) -> None:
        for number in numbers(value):
            found.update(number + b'\n')

    def pipelines() -> list[EstimatorPipeline[Any]]:
        settings = EstimatorSettings()
        makers = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
        v_mils = resistance_pipeline(train_file, replace(settings, resistance=RESISTANCE.choose('V-MILS')))
        return [*(make(train_file, settings) for make in makers), v_mils]

    def publish(output: Output[Any]) -> None:
        take(output)
        if output.last_rejection is not None:
            kinds.add(output.last_rejection.reason.name)

    published = pipelines()
    for record in records:
        for pipeline in published:
            events = pipeline.stream.push(record)
            for event in events:
                kinds.add(event.reason.name if isinstance(event, Rejection) else type(event).__name__)
                take(event)
            pipeline.take(events, publish)
    quiet = pipelines()
    group = PipelineGroup(quiet)
    take(group.push_rows(record.row() for record in records))
    take(group.covered_s)
    for one, other in zip(published, quiet, strict=True):
        assert one.save() == other.save()
        for value in (one.consistency, other.consistency, one.current(), other.current(), one.save()):
            take(value)
    return found.hexdigest(), kinds


def main() -> None:
    """Print how the modules run, what happened in the drive, and the hashes."""
    metro = load_train_file(ROOT / 'config' / 'trains' / 'yizhuang.yaml')
    day = simulate(yizhuang_day(metro, runs=2), np.random.default_rng(2015)).records
    records = [record for record in day if record.stamp_ns < day[0].stamp_ns + END_S * NS_PER_S]
    clean, _ = digest(metro, records[: len(records) // 2])
    faulty, kinds = digest(replace(metro, effects=parse_effects(EFFECTS)), hard(records))
    print('sources' if alignment.__file__.endswith('.py') else 'compiled', *sorted(kinds), sep=' ')
    print(clean, faulty)


def outcome(switch: str) -> tuple[set[str], str]:
    """Return what :func:`main` prints in a process of its own: the words of the first line, and the second."""
    environment = os.environ | {SWITCH: switch, 'PYTHONPATH': os.pathsep.join(sys.path)}
    process = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True, check=True)
    first, second = process.stdout.splitlines()
    return set(first.split()), second


@pytest.mark.slow
@pytest.mark.skipif(SWITCH in os.environ, reason='the sources were asked for')
def test_compiled_modules_give_the_same_numbers_as_their_sources() -> None:
    assert not uses_sources()
    compiled, sources = outcome('1'), outcome('0')
    assert compiled[0] - sources[0] == {'compiled'}
    assert sources[0] - compiled[0] == {'sources'}
    assert compiled[1] == sources[1]
    assert sources[0] >= {reason.name for reason in FAULTS} | {Sample.__name__, TimeJump.__name__}


if __name__ == '__main__':
    main()
