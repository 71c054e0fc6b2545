# SPDX-License-Identifier: Apache-2.0
"""Contradictory inputs are named before anything is learned from them, and healthy ones are left alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from trainid_ros.estimators.pipeline import EstimatorPipeline, share_streams
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import Reason, Status
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Change = Callable[[Record], Record]


def speed(factor: float) -> Change:
    return lambda record: replace(record, speed=factor * record.speed) if isinstance(record, SpeedRecord) else record


def force(factor: float) -> Change:
    return lambda record: replace(record, force=factor * record.force) if isinstance(record, ForceRecord) else record


def command(change: Callable[[float], float]) -> Change:
    def changed(record: Record) -> Record:
        if isinstance(record, BrakeRecord):
            return replace(record, target_acceleration=change(record.target_acceleration))
        return record

    return changed


def gradient(offset: float) -> Change:
    def changed(record: Record) -> Record:
        return replace(record, gradient=record.gradient + offset) if isinstance(record, GradientRecord) else record

    return changed


def position(change: Callable[[float], float]) -> Change:
    def changed(record: Record) -> Record:
        return replace(record, position=change(record.position)) if isinstance(record, SpeedRecord) else record

    return changed


def late(kind: type[Record], seconds: float) -> Change:
    shift_ns = round(seconds * NS_PER_S)
    return lambda record: replace(record, stamp_ns=record.stamp_ns + shift_ns) if isinstance(record, kind) else record


def between(change: Change, begin_s: float, end_s: float, start_ns: int) -> Change:
    """Return a change of the records between two times since the start [s]."""

    def changed(record: Record) -> Record:
        inside = begin_s <= (record.stamp_ns - start_ns) / NS_PER_S < end_s
        return change(record) if inside else record

    return changed


def departures(day: tuple[Record, ...]) -> list[int]:
    """Return the stamps at which the train has reached 3 m/s after each stop [ns]."""
    speeds = [record for record in day if isinstance(record, SpeedRecord)]
    return [after.stamp_ns for before, after in pairwise(speeds) if before.speed < 3.0 <= after.speed]


def followed(stream: SampleStream, records: Iterable[Record]) -> list[tuple[int, float, bool, str, bool]]:
    """Return stamp [ns], motion so far [s], whether trusted, the finding and whether rejected, of each sample."""
    seen: list[tuple[int, float, bool, str, bool]] = []
    moved_s = 0.0
    for record in sorted(records, key=lambda item: item.stamp_ns):
        for event in stream.push(record):
            if isinstance(event, Sample):
                moved_s += 0.2 * (event.speed >= 1.0)
                seen.append((event.stamp_ns, moved_s, stream.is_trusted, stream.finding, event.rejection is not None))
    return seen


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


@pytest.mark.parametrize(
    ('change', 'within_s', 'text'),
    [
        (speed(3.6), 10.0, 'ato/speed looks like km/h'),
        (speed(1.06), 60.0, 'ato/speed is about +6 % off'),
        (speed(2.2369), 20.0, 'ato/speed looks like mph'),
        (force(0.22481), 20.0, 'ato/force looks like lbf'),
        (force(1e-3), 10.0, 'ato/force looks like kN'),
        (force(1e3), 20.0, 'ato/force is about 1000 times too large'),
        (force(-1.0), 10.0, 'ato/force looks as if it had the wrong sign'),
        (force(0.0), 15.0, 'does not follow ato/force'),
        (command(lambda _: -0.7), 10.0, 'the train does not brake while ato/brake_command brakes'),
        (gradient(4.0), 60.0, 'ato/gradient is about +3'),
    ],
)
def test_a_contradiction_from_the_first_message_is_named(
    metro: TrainFile, day: tuple[Record, ...], change: Change, within_s: float, text: str
) -> None:
    found = findings(SampleStream(StreamConfig(metro)), [change(record) for record in day[:4000]])
    assert next(when for when, finding in found if text in finding) <= within_s


@pytest.mark.parametrize('begin_s', [0.0, 200.0])
@pytest.mark.parametrize(
    'change',
    [
        position(lambda x: 2.0 * x),
        position(lambda x: 1e-3 * x),
        position(lambda _: 1500.0),
        position(lambda x: x + 300.0 * (x // 200.0)),
    ],
)
def test_a_position_that_is_off_is_named_and_not_the_gradient(
    metro: TrainFile, day: tuple[Record, ...], change: Change, begin_s: float
) -> None:
    start_ns = day[0].stamp_ns
    wrong = between(change, begin_s, math.inf, start_ns)
    found = findings(SampleStream(StreamConfig(metro)), [wrong(record) for record in day[:9000]])
    assert found[0][1].startswith('the position in ato/speed')
    assert not any('ato/gradient' in text for _, text in found)


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        (command(lambda target: target / 9.81), 'ato/brake_command looks like g'),
        (late(SpeedRecord, 1.0), 'ato/speed is about 1.'),
        (late(ForceRecord, 1.0), 'ato/force is about 1.'),
    ],
)
def test_what_needs_brakings_or_steps_of_traction_is_named_within_two_runs(
    metro: TrainFile, day: tuple[Record, ...], change: Change, text: str
) -> None:
    found = findings(SampleStream(StreamConfig(metro)), [change(record) for record in day])
    assert any(text in finding for _, finding in found), found


def test_a_brake_command_that_is_late_is_told_from_one_that_is_not(metro: TrainFile, day: tuple[Record, ...]) -> None:
    for late_s, warning in ((0.0, ''), (1.0, 's sooner than brake.delay of the train file says')):
        stream = SampleStream(StreamConfig(metro))
        findings(stream, [late(BrakeRecord, late_s)(record) for record in day])
        assert stream.brake_delay.warning.endswith(warning)
        assert stream.brake_delay.is_trusted == (not warning)
        assert stream.brake_delay.mean == pytest.approx(-late_s, abs=0.35)


def test_a_second_publisher_of_the_brake_command_is_named(metro: TrainFile, day: tuple[Record, ...]) -> None:
    records: list[Record] = []
    for record in day[:4000]:
        records.append(record)
        if isinstance(record, BrakeRecord):
            other = -0.6 if record.target_acceleration == 0.0 else 0.0
            records.append(BrakeRecord(record.stamp_ns + NS_PER_S // 10, other, emergency=False))
    found = findings(SampleStream(StreamConfig(metro)), records)
    assert 'two publishers' in found[0][1]


def test_spikes_of_the_force_are_named(metro: TrainFile, day: tuple[Record, ...]) -> None:
    forces = [record for record in day[:4000] if isinstance(record, ForceRecord)]
    spiked = {record.stamp_ns for record in forces[::25]}
    records = [
        replace(record, force=record.force + 1e5)
        if isinstance(record, ForceRecord) and record.stamp_ns in spiked
        else record
        for record in day[:4000]
    ]
    assert 'ato/force has spikes' in dict(map(reversed, findings(SampleStream(StreamConfig(metro)), records)))  # type: ignore[arg-type]


def test_healthy_inputs_are_left_alone(metro: TrainFile, day: tuple[Record, ...]) -> None:
    stream = SampleStream(StreamConfig(metro))
    events = [event for record in day for event in stream.push(record)]
    rejected = [e for e in events if isinstance(e, Sample) and e.rejection is not None]
    assert rejected == []
    assert stream.last_finding == ''
    assert stream.is_trusted


def pipelines(metro: TrainFile) -> list[EstimatorPipeline[Any]]:
    makers = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
    return [make(metro, EstimatorSettings()) for make in makers]


@pytest.mark.parametrize('change', [speed(3.6), force(-1.0), force(1e-3), force(2.0), command(lambda _: -0.7)])
def test_no_estimate_from_contradictory_inputs_is_valid(
    metro: TrainFile, day: tuple[Record, ...], change: Change
) -> None:
    found = pipelines(metro)
    (stream,) = share_streams(found)
    statuses = set()
    for record in day:
        events = stream.push(change(record))
        for pipeline in found:
            pipeline.take(events, lambda output: statuses.add(output.status))
    assert statuses <= {Status.UNINITIALIZED, Status.CONVERGING, Status.STALE}
    assert all(pipeline.rejections[Reason.CONTRADICTION] > 500 for pipeline in found)


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
        if begin_ns < record.stamp_ns < end_ns:
            assert hit.current().status is not Status.VALID or record.stamp_ns < begin_ns + NS_PER_S
    assert hit.rejections[Reason.CONTRADICTION] > 100
    found, expected = hit.current().estimate, healthy.current().estimate
    assert abs(found.resistance - expected.resistance) < found.resistance_std


def test_an_estimate_that_goes_back_keeps_the_consistency_that_it_had(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    pipeline = resistance_pipeline(metro, EstimatorSettings())
    for record in day:
        pipeline.push(record)
    pipeline._go_back()
    assert pipeline.consistency.updates > 0


def test_what_was_learned_while_the_distances_differed_is_forgotten(metro: TrainFile, day: tuple[Record, ...]) -> None:
    stream = SampleStream(StreamConfig(metro))
    for record in day[:4000]:
        stream.push(record)
    checks = stream._plausibility
    assert not checks.has_changed
    checks.state.distance.sudden = 1
    assert checks.has_changed
    checks.state.distance.sudden = 0
    assert not checks.has_changed
    assert checks.was_false_alarm


def test_a_contradiction_ends_when_the_inputs_agree_again(metro: TrainFile, day: tuple[Record, ...]) -> None:
    stream, change = SampleStream(StreamConfig(metro)), force(-1.0)
    half = len(day) // 2
    found = findings(stream, [change(record) for record in day[:half]])
    assert any('wrong sign' in finding for _, finding in found)
    assert stream.finding
    findings(stream, list(day[half:]))
    assert stream.finding == ''
    assert stream.last_finding


def test_short_slip_at_each_departure_is_rejected_and_names_nothing(metro: TrainFile, day: tuple[Record, ...]) -> None:
    starts, slip_s = departures(day), 2.0
    records: list[Record] = []
    for record in day:
        since = min((t for start in starts if (t := (record.stamp_ns - start) / NS_PER_S) >= 0.0), default=math.inf)
        slip = 4.0 * math.sin(math.pi * since / slip_s) if since < slip_s else 0.0
        records.append(replace(record, speed=record.speed + slip) if isinstance(record, SpeedRecord) else record)
    stream = SampleStream(StreamConfig(metro))
    seen = followed(stream, records)
    assert sum(rejected for *_, rejected in seen) >= 3 * len(starts)
    assert stream.last_finding == ''


@pytest.mark.parametrize(
    ('change', 'seconds'),
    [(speed(3.6), 20.0), (force(-1.0), 15.0), (force(1e-3), 15.0), (command(lambda _: -0.7), 10.0)],
)
def test_trust_is_back_soon_after_a_short_fault_and_never_before_its_end(
    metro: TrainFile, day: tuple[Record, ...], change: Change, seconds: float
) -> None:
    begin_ns = departures(day)[0] + 60 * NS_PER_S
    end_ns = begin_ns + round(seconds * NS_PER_S)
    changed = between(change, 0.0, seconds, begin_ns)
    seen = followed(SampleStream(StreamConfig(metro)), [changed(record) for record in day])
    ended_s = next(moved_s for stamp_ns, moved_s, *_ in seen if stamp_ns > end_ns)
    assert not any(trusted for stamp_ns, _, trusted, *_ in seen if begin_ns + 7 * NS_PER_S < stamp_ns < end_ns)
    assert any(finding for _, _, _, finding, _ in seen)
    back_s = next(moved_s for stamp_ns, moved_s, trusted, *_ in seen if stamp_ns > end_ns and trusted)
    assert back_s - ended_s < 90.0


@pytest.mark.parametrize(
    ('change', 'within_s'), [(force(1.2), 6.0), (force(1e-3), 3.0), (gradient(3.0), 6.0), (speed(1.05), 4.0)]
)
def test_trust_is_withheld_soon_after_a_change_on_the_way(
    metro: TrainFile, day: tuple[Record, ...], change: Change, within_s: float
) -> None:
    begin_ns = departures(day)[1] + 8 * NS_PER_S
    changed = between(change, 0.0, math.inf, begin_ns)
    seen = followed(SampleStream(StreamConfig(metro)), [changed(record) for record in day])
    assert all(trusted for stamp_ns, moved_s, trusted, *_ in seen if stamp_ns < begin_ns and moved_s > 20.0)
    then_ns = begin_ns + round(within_s * NS_PER_S)
    assert not any(trusted for stamp_ns, _, trusted, *_ in seen if then_ns < stamp_ns < then_ns + 10 * NS_PER_S)


def test_a_controller_that_toggles_its_command_is_one_publisher(metro: TrainFile, day: tuple[Record, ...]) -> None:
    def toggle(record: Record) -> Record:
        if isinstance(record, BrakeRecord) and record.target_acceleration < 0.0:
            up = (record.stamp_ns // (NS_PER_S // 4)) % 2
            return replace(record, target_acceleration=record.target_acceleration - 0.2 + 0.4 * up)
        return record

    stream = SampleStream(StreamConfig(metro))
    findings(stream, [toggle(record) for record in day])
    assert 'two publishers' not in stream.last_finding


def alternating(day: tuple[Record, ...], begin_s: float, end_s: float) -> list[Record]:
    """Return records with a second publisher of the brake command for some time [s]."""
    records = list(day)
    for record in day:
        inside = begin_s <= (record.stamp_ns - day[0].stamp_ns) / NS_PER_S < end_s
        if inside and isinstance(record, BrakeRecord):
            other = -0.6 if record.target_acceleration == 0.0 else 0.0
            records.append(BrakeRecord(record.stamp_ns + NS_PER_S // 10, other, emergency=False))
    return sorted(records, key=lambda item: item.stamp_ns)


def test_a_moment_of_contradiction_costs_its_samples_and_nothing_that_was_learned(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    hit, healthy = resistance_pipeline(metro, EstimatorSettings()), resistance_pipeline(metro, EstimatorSettings())
    for record in alternating(day, 290.0, 291.2):
        hit.push(record)
    for record in day:
        healthy.push(record)
    assert 0 < hit.rejections[Reason.CONTRADICTION] < 20
    assert hit.stream.last_finding
    assert hit.current().estimate.resistance_std < 1.2 * healthy.current().estimate.resistance_std


def test_a_restored_stream_knows_the_last_finding_and_rejections_have_numbers(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    stream, change = SampleStream(StreamConfig(metro)), between(force(-1.0), 0.0, 150.0, day[0].stamp_ns)
    events = [event for record in day for event in stream.push(change(record))]
    rejections = [e.rejection for e in events if isinstance(e, Sample) and e.rejection is not None]
    assert rejections
    assert all(math.isfinite(rejection.value) and math.isfinite(rejection.limit) for rejection in rejections)
    assert stream.finding == ''
    assert stream.successor(continues=True).last_finding == stream.last_finding != ''


@pytest.mark.parametrize('change', [force(1.2), gradient(6.0)])
def test_after_a_change_that_has_passed_the_estimate_is_that_from_before_it(
    metro: TrainFile, day: tuple[Record, ...], change: Change
) -> None:
    no_line = replace(metro, line=replace(metro.line, gradient=()))
    begin_ns = departures(day)[0] + 60 * NS_PER_S
    changed = between(change, 0.0, 20.0, begin_ns)
    hit, healthy = resistance_pipeline(no_line, EstimatorSettings()), resistance_pipeline(no_line, EstimatorSettings())
    gaps = 0
    for record in day:
        for event in hit.stream.push(changed(record)):
            gaps += isinstance(event, Sample) and event.stamp_ns > begin_ns and math.isnan(event.dt)
            hit.take([event])
        healthy.push(record)
        output, expected = hit.current(), healthy.current().estimate
        error = abs(output.estimate.resistance - expected.resistance)
        assert output.status is not Status.VALID or error < 3.0 * output.estimate.resistance_std
    assert gaps == 1
    assert error < output.estimate.resistance_std


def test_the_first_sample_after_a_contradiction_states_the_command_in_force(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    stream, change = SampleStream(StreamConfig(metro)), between(force(-1.0), 0.0, 100.0, day[0].stamp_ns)
    samples = [event for record in day for event in stream.push(change(record)) if isinstance(event, Sample)]
    resumed = [after for before, after in pairwise(samples) if before.rejection and not after.rejection]
    assert resumed
    for sample in resumed:
        assert math.isnan(sample.dt)
        assert sample.brake_gap
        assert sample.brake_changes[-1].target_acceleration == sample.brake_command
