# SPDX-License-Identifier: Apache-2.0
"""Faults of the inputs are named, only estimators that use a wrong input wait, and healthy inputs are left alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pytest

from trainid_ros.estimators.pipeline import EstimatorPipeline, share_streams
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, Record, SpeedRecord
from trainid_ros.interface.results import Reason, Status
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.stream.fault_table import TABLE, Input
from trainid_ros.stream.input_check import Verdict
from trainid_ros.stream.input_faults import InputFaults
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import TrainFile

Make = Callable[..., Sample]
Change = Callable[[Record], Record]


def speed(factor: float) -> Change:
    return lambda record: replace(record, speed=factor * record.speed) if isinstance(record, SpeedRecord) else record


def force(factor: float) -> Change:
    return lambda record: replace(record, force=factor * record.force) if isinstance(record, ForceRecord) else record


def position(change: Callable[[float], float]) -> Change:
    def changed(record: Record) -> Record:
        return replace(record, position=change(record.position)) if isinstance(record, SpeedRecord) else record

    return changed


def findings(stream: SampleStream, records: list[Record]) -> list[tuple[float, str]]:
    """Return all findings with the motion in seconds after which each appeared."""
    found: list[tuple[float, str]] = []
    moved = 0
    for record in sorted(records, key=lambda item: item.stamp_ns):
        for event in stream.push(record):
            moved += isinstance(event, Sample) and event.speed >= 0.5
        if stream.finding and (not found or found[-1][1] != stream.finding):
            found.append((0.2 * moved, stream.finding))
    return found


FORCE_IN_KN: Final = 'ato/force is in kN'


@pytest.mark.parametrize(
    ('change', 'within_s', 'text'),
    [
        (speed(3.6), 30.0, 'ato/speed is in km/h'),
        (force(1e-3), 30.0, FORCE_IN_KN),
        (force(-1.0), 30.0, 'ato/force has the wrong sign'),
        (position(lambda _: 1500.0), 60.0, 'the position in ato/speed follows nothing'),
    ],
)
def test_a_contradiction_from_the_first_message_is_named(
    metro: TrainFile, day: tuple[Record, ...], change: Change, within_s: float, text: str
) -> None:
    found = findings(SampleStream(StreamConfig(metro)), [change(record) for record in day[:1500]])
    assert next(when for when, finding in found if text in finding) <= within_s


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        (speed(3.6), 'ato/speed is in km/h'),
        (force(-1.0), 'ato/force has the wrong sign'),
        (force(1e3), 'ato/force, ato/mass or train.mass is off'),  # by more than any load
        (force(0.8), ''),
        (speed(1.05), ''),
        (position(lambda _: 1500.0), ''),
    ],
)
def test_what_an_effect_can_look_like_is_found_but_not_misread(
    metro: TrainFile, day: tuple[Record, ...], change: Change, text: str
) -> None:
    stream = SampleStream(StreamConfig(metro))
    for record in day[:2500]:
        stream.push(change(record))
    assert stream.finding
    assert (text in stream.faults.misread) if text else stream.faults.misread == ''


def second_publisher(records: Iterable[Record]) -> list[Record]:
    """Return records with a second publisher of the brake command."""
    mixed: list[Record] = []
    for record in records:
        mixed.append(record)
        if isinstance(record, BrakeRecord):
            other = -0.6 if record.target_acceleration == 0.0 else 0.0
            mixed.append(BrakeRecord(record.stamp_ns + NS_PER_S // 10, other, emergency=False))
    return mixed


def test_a_second_publisher_of_the_brake_command_is_named_and_holds_back_the_brake_rate_alone(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    stream = SampleStream(StreamConfig(metro))
    events = [event for record in second_publisher(day[:1500]) for event in stream.push(record)]
    samples = [event for event in events if isinstance(event, Sample)]
    assert 'two publishers' in stream.finding
    assert 'two publishers' in stream.faults.misread
    assert samples[-1].rejection is None
    assert samples[-1].brake_rejection is not None
    assert stream.faults.resistance.finding == stream.faults.resistance.doubt == ''
    assert stream.faults.brake_rate.doubt == 'inputs contradict each other'


def test_a_position_that_is_off_is_named_and_holds_back_nobody(metro: TrainFile, day: tuple[Record, ...]) -> None:
    stream, change = SampleStream(StreamConfig(metro)), position(lambda _: 1500.0)
    events = [event for record in day[:1500] for event in stream.push(change(record))]
    assert 'position' in stream.finding
    assert not any(event.rejection or event.brake_rejection for event in events if isinstance(event, Sample))


def test_beside_a_position_in_feet_the_other_inputs_confirm_each_other(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    stream, change = SampleStream(StreamConfig(metro)), position(lambda x: x / 0.3048)
    for record in day[:4500]:
        stream.push(change(record))
    assert 'position' in stream.finding
    assert stream.faults.resistance.doubt == ''


def test_spikes_of_the_force_are_named(metro: TrainFile, day: tuple[Record, ...]) -> None:
    forces = [record for record in day[:1500] if isinstance(record, ForceRecord)]
    spiked = {record.stamp_ns for record in forces[::25]}
    stream = SampleStream(StreamConfig(metro))
    suspicions = set()
    for record in day[:1500]:
        wrong = isinstance(record, ForceRecord) and record.stamp_ns in spiked
        stream.push(force_plus(record, 1e5) if wrong else record)
        suspicions.add(stream.faults.resistance.doubt)
    assert 'it is suspected that ato/force has spikes' in suspicions
    assert stream.finding == 'ato/force has spikes'


def force_plus(record: Record, more: float) -> Record:
    return replace(record, force=record.force + more) if isinstance(record, ForceRecord) else record


def test_healthy_inputs_are_left_alone(metro: TrainFile, day: tuple[Record, ...]) -> None:
    stream, doubts = SampleStream(StreamConfig(metro)), set()
    for record in day:
        for event in stream.push(record):
            assert not (isinstance(event, Sample) and (event.rejection or event.brake_rejection))
        doubts.add(stream.faults.brake_rate.doubt)
    assert stream.last_finding == ''
    assert doubts == {
        'the inputs have not yet confirmed each other', 'no braking has confirmed brake.delay and brake.rate yet', ''
    }  # fmt: skip
    assert stream.faults.resistance.is_full


@pytest.mark.parametrize('change', [speed(3.6), force(-1.0)])
def test_no_estimate_from_contradictory_inputs_is_valid(
    metro: TrainFile, day: tuple[Record, ...], change: Change
) -> None:
    makers = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
    found: list[EstimatorPipeline[Any]] = [make(metro, EstimatorSettings()) for make in makers]
    (stream,) = share_streams(found)
    statuses = set()
    for record in day[:4000]:
        events = stream.push(change(record))
        for pipeline in found:
            pipeline.take(events, lambda output: statuses.add(output.status))
    assert statuses <= {Status.UNINITIALIZED, Status.CONVERGING, Status.STALE}
    assert all(pipeline.rejections[Reason.CONTRADICTION] > 300 for pipeline in found)


def test_after_a_fault_in_mid_drive_the_estimate_is_that_from_before_it(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    start_ns = day[0].stamp_ns
    begin_ns, end_ns = start_ns + 240 * NS_PER_S, start_ns + 300 * NS_PER_S
    change = speed(3.6)
    hit, healthy = resistance_pipeline(metro, EstimatorSettings()), resistance_pipeline(metro, EstimatorSettings())
    for record in day:
        hit.push(change(record) if begin_ns <= record.stamp_ns < end_ns else record)
        healthy.push(record)
        if begin_ns + 2 * NS_PER_S < record.stamp_ns < end_ns:
            assert hit.current().status is not Status.VALID
    assert hit.rejections[Reason.CONTRADICTION] > 100
    assert hit.stream.finding == ''
    assert hit.stream.successor(continues=True).last_finding == hit.stream.last_finding != ''
    found, expected = hit.current().estimate, healthy.current().estimate
    assert abs(found.resistance - expected.resistance) < found.resistance_std


def test_a_controller_that_toggles_its_command_is_one_publisher(metro: TrainFile, day: tuple[Record, ...]) -> None:
    def toggle(record: Record) -> Record:
        if isinstance(record, BrakeRecord) and record.target_acceleration < 0.0:
            up = (record.stamp_ns // (NS_PER_S // 4)) % 2
            return replace(record, target_acceleration=record.target_acceleration - 0.2 + 0.4 * up)
        return record

    stream = SampleStream(StreamConfig(metro))
    findings(stream, [toggle(record) for record in day[:3000]])
    assert 'two publishers' not in stream.last_finding


def taken(train_file: TrainFile, samples: Iterable[Sample]) -> InputFaults:
    """Return the faults after some samples."""
    faults = InputFaults(KnownForce(train_file))
    for item in samples:
        faults.take(item)
    return faults


@pytest.mark.parametrize(('command', 'rejected'), [(-0.6, True), (0.0, False)])
def test_a_speed_that_rises_from_a_standstill_under_the_brake_is_rejected(
    train_file: TrainFile, sample: Make, command: float, rejected: bool
) -> None:
    changes = (BrakeCommandChange(1, command),)
    unknown = math.nan  # The position
    stopped = [
        sample(k, speed=0.0, position=unknown, brake_command=command, brake_changes=() if k else changes)
        for k in range(50)
    ]
    drifting = [sample(50 + k, speed=0.01 * k, position=unknown, brake_command=command) for k in range(80)]
    taken(train_file, [*stopped, *drifting])
    found = [item.rejection for item in (*stopped, *drifting)]
    assert not any(found[:70])
    assert any(found[70:]) is rejected
    assert [item.brake_rejection for item in drifting] == found[50:]


def test_a_stuck_speed_is_rejected_for_all(train_file: TrainFile, sample: Make) -> None:
    rng = np.random.default_rng(4)
    noisy = [sample(k, speed=15.0 + 0.03 * float(rng.standard_normal())) for k in range(200)]
    stuck = [sample(200 + k, speed=15.01) for k in range(12)]
    taken(train_file, [*noisy, *stuck])
    assert not any(item.rejection for item in noisy)
    rejection = stuck[-1].rejection
    assert rejection is stuck[-1].brake_rejection
    assert rejection is not None
    assert rejection.reason is Reason.SPEED_STUCK


def test_a_mass_in_tonnes_holds_back_all(train_file: TrainFile, sample: Make) -> None:
    mass = train_file.train.mass
    faults = taken(train_file, [sample(k, mass=mass / 1000.0) for k in range(3)])
    assert faults.finding == faults.resistance.finding == faults.brake_rate.finding
    assert 'looks like tonnes' in faults.finding


def test_a_finding_is_confirmed_by_some_motion_and_nothing_is_trusted_at_first(
    train_file: TrainFile, sample: Make
) -> None:
    samples = [sample(k, mass=train_file.train.mass / (1000.0 if 20 <= k < 40 else 1.0)) for k in range(60)]
    faults, confirmed = InputFaults(KnownForce(train_file)), []
    for item in samples:
        faults.take(item)
        confirmed.append(faults.resistance.is_fault_confirmed)
    assert confirmed.index(True) in range(29, 32)
    assert not any(confirmed[40:])
    assert faults.last_finding
    assert faults.resistance.doubt == 'the inputs have not yet confirmed each other'


def test_the_brake_of_the_train_file_is_named_apart_from_the_inputs(train_file: TrainFile, sample: Make) -> None:
    faults = InputFaults(KnownForce(train_file))
    row = next(k for k, item in enumerate(TABLE) if Input.BRAKE in item.condemns)
    faults.check.verdict = Verdict('the brake acts later', '', row, 0)
    item = sample(0)
    faults.take(item)
    assert (faults.finding, faults.brake_warning) == ('', 'the brake acts later')
    assert item.rejection is None
    assert item.brake_rejection is not None
