# SPDX-License-Identifier: Apache-2.0
"""Brake commands that are published only when they change."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

import pytest

from test.stream.alignment.events import START, at
from trainid_ros.interface.records import BRAKE, NS_PER_S, BrakeRecord, ForceRecord, Record, SpeedRecord
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Drive: TypeAlias = Callable[..., list[Record]]
Run: TypeAlias = Callable[..., Any]
HOLD_S = 20.0
PERIODIC = AlignmentConfig()
ON_CHANGE = AlignmentConfig(command_hold=HOLD_S)
STALE_NS = 8 * NS_PER_S // 10


def braking(drive: Drive, seconds: float = 12.0) -> list[Record]:
    """A drive with a command of -0.5 m/s^2 from 3 s to 7 s, repeated all the time."""
    return [
        replace(record, target_acceleration=-0.5 if at(3.0) <= record.stamp_ns < at(7.0) else 0.0)
        if isinstance(record, BrakeRecord)
        else record
        for record in drive(seconds)
    ]


def only_changes(records: list[Record]) -> list[Record]:
    """The same records, with a brake command only where it changes."""
    kept: list[Record] = []
    last = math.nan
    for record in records:
        if isinstance(record, BrakeRecord):
            if record.target_acceleration == last:
                continue
            last = record.target_acceleration
        kept.append(record)
    return kept


def samples(events: list[Any]) -> list[Sample]:
    return [event for event in events if isinstance(event, Sample)]


def test_commands_on_change_give_the_samples_of_commands_all_the_time(drive: Drive, run: Run) -> None:
    expected = samples(run(braking(drive), PERIODIC))
    found = samples(run(only_changes(braking(drive)), ON_CHANGE))
    # The last ones still wait for a change that may be on its way.
    assert len(expected) - 3 <= len(found) < len(expected)
    for sample, other in zip(found, expected, strict=False):
        assert repr(sample) == repr(other)
    assert [change.target_acceleration for sample in found for change in sample.brake_changes] == [0.0, -0.5, 0.0]


@pytest.mark.parametrize('seed', range(5))
def test_the_order_of_arrival_does_not_matter(arrivals: Callable[..., Any], run: Run, seed: int) -> None:
    ordered, arrived = arrivals(seed, 0.2)
    expected, found = (samples(run(only_changes(records), ON_CHANGE)) for records in (ordered, arrived))
    common = min(len(expected), len(found))
    assert common > 30
    assert repr(found[:common]) == repr(expected[:common])


def test_without_the_setting_such_commands_are_missing(drive: Drive, run: Run) -> None:
    found = samples(run(only_changes(braking(drive)), PERIODIC))
    assert sum(math.isnan(sample.brake_command) for sample in found) > 20


def test_a_command_is_unknown_after_the_declared_time(drive: Drive, run: Run) -> None:
    found = samples(run(only_changes(drive(HOLD_S + 10.0)), ON_CHANGE))
    held = [(sample.stamp_ns - START) / NS_PER_S for sample in found if not math.isnan(sample.brake_command)]
    assert max(held) == pytest.approx(HOLD_S, abs=0.3)
    assert found[-1].stamp_ns > at(HOLD_S + 5.0)


def test_a_command_that_comes_too_late_counts_from_its_arrival_and_marks_the_sample(drive: Drive) -> None:
    aligner, found = Aligner(ON_CHANGE), []
    late = BrakeRecord(at(2.0), -0.5, emergency=True)
    for record in only_changes(drive(6.0)):
        if isinstance(record, SpeedRecord) and record.stamp_ns == at(4.0):
            aligner.push(late)
        found += samples(aligner.push(record))
    (marked,) = [sample for sample in found if sample.brake_gap]
    assert at(3.0) < marked.stamp_ns < at(4.0)
    assert [change.target_acceleration for change in marked.brake_changes] == [-0.5]
    assert {(sample.brake_command, sample.emergency) for sample in found if sample.stamp_ns >= marked.stamp_ns} == {
        (-0.5, True)
    }


def stream(train_file: TrainFile) -> SampleStream:
    return SampleStream(StreamConfig(train_file, ON_CHANGE))


def test_inputs_are_missing_until_the_first_command_and_after_the_declared_time(
    drive: Drive, train_file: TrainFile
) -> None:
    tested = stream(train_file)
    assert tested.timeout_ns(BRAKE, STALE_NS) == round(HOLD_S * NS_PER_S)
    missing = []
    for record in only_changes(drive(HOLD_S + 5.0)):
        if not (isinstance(record, BrakeRecord) and record.stamp_ns < at(1.0)):
            tested.push(record)
        if record.stamp_ns == at(2.0):
            assert tested.is_input_missing(STALE_NS)
            tested.push(BrakeRecord(at(2.0), 0.0, emergency=False))
        missing.append((record.stamp_ns, tested.is_input_missing(STALE_NS)))
    known = [(stamp_ns - START) / NS_PER_S for stamp_ns, is_missing in missing if not is_missing and stamp_ns > at(2.0)]
    assert known[0] < 2.2
    assert known[-1] == pytest.approx(2.0 + HOLD_S + 0.8, abs=0.3)
    assert len(known) == pytest.approx((HOLD_S + 0.8) * 15, rel=0.05)


def test_another_input_that_stops_is_missing_as_before(drive: Drive, train_file: TrainFile) -> None:
    tested = stream(train_file)
    for record in only_changes(drive(6.0)):
        if not (isinstance(record, ForceRecord) and record.stamp_ns > at(4.0)):
            tested.push(record)
    assert tested.is_input_missing(STALE_NS)
