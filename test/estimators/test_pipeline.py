# SPDX-License-Identifier: Apache-2.0
"""Pipelines: statuses by stamps, counters, time jumps, and robustness to irrelevant changes of the input."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from test.estimators.makers import NAMES, make, run
from trainid_ros.estimators.pipeline import WINDOW, EstimatorPipeline, PipelineConfig, PipelineGroup, SharedRecord
from trainid_ros.interface.errors import InputError, TrainIdError
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.interface.results import (
    BrakeRateEstimate,
    Estimate,
    Output,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
)
from trainid_ros.setup.pipelines import EstimatorSettings, resistance_pipeline
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import TimeJumpPolicy
from trainid_ros.train.train_file import TrainFile

HOUR_NS = 3600 * NS_PER_S
Records = tuple[Record, ...]
ALL = pytest.mark.parametrize('name', NAMES)


def policy(kind: TimeJumpPolicy) -> EstimatorSettings:
    return EstimatorSettings(pipeline=PipelineConfig(time_jump_policy=kind))


def seconds(records: Records, low: float, high: float) -> list[Record]:
    start = records[0].stamp_ns
    return [r for r in records if low <= (r.stamp_ns - start) / NS_PER_S < high]


Whole = tuple[EstimatorPipeline[Any], list[Output[Any]]]


@pytest.fixture(scope='module', params=NAMES)
def whole(request: pytest.FixtureRequest, metro: TrainFile, day: Records) -> Whole:
    """Return a pipeline at the end of the day, not to be changed, and its outputs."""
    pipeline = make(request.param, metro)
    return pipeline, run(pipeline, day)


# Outputs and counters


def test_every_sample_gives_one_output_with_its_stamp(whole: Whole, day: Records) -> None:
    pipeline, outputs = whole
    speeds = [r.stamp_ns for r in day if isinstance(r, SpeedRecord)]
    stamps = [output.stamp_ns for output in outputs]
    assert stamps == speeds[: len(stamps)]
    assert len(speeds) - len(stamps) <= 2
    assert pipeline.samples == len(outputs)
    assert pipeline.newest_ns == max(r.stamp_ns for r in day)
    assert repr(outputs[-1]) == repr(pipeline.current())


def test_counters_account_for_every_sample(whole: Whole) -> None:
    pipeline, outputs = whole
    assert pipeline.used + pipeline.rejections.total() == pipeline.samples
    for before, after in pairwise(outputs):
        assert (after.used - before.used, after.rejected - before.rejected) in {(1, 0), (0, 1)}
        if after.rejected > before.rejected:
            assert after.last_rejection is not None
            assert after.last_rejection.stamp_ns == after.stamp_ns
    assert outputs[-1].used > 100


@ALL
def test_rejected_records_are_counted_too(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    for record in seconds(day, 0.0, 60.0):
        pipeline.push(record)
    before = pipeline.current().rejected
    pipeline.push(ForceRecord(pipeline.newest_ns, math.nan))
    pipeline.push(SpeedRecord(0, 1.0, 0.0))
    assert pipeline.current().rejected == before + 2
    assert pipeline.rejections[Reason.NOT_FINITE] == 1
    assert pipeline.rejections[Reason.ZERO_STAMP] == 1
    rejection = pipeline.current().last_rejection
    assert rejection is not None
    assert rejection.reason is Reason.ZERO_STAMP


@ALL
def test_a_topic_faster_than_the_period_is_not_a_fault(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro, EstimatorSettings(alignment=AlignmentConfig(period=0.4)))
    outputs = run(pipeline, seconds(day, 0.0, 60.0))
    assert len(outputs) == pytest.approx(150, abs=3)
    assert Reason.THINNED not in pipeline.rejections


def test_settings_out_of_range_are_rejected(metro: TrainFile) -> None:
    with pytest.raises(InputError, match='stale_after'):
        resistance_pipeline(metro, EstimatorSettings(pipeline=PipelineConfig(stale_after=0.0)))
    with pytest.raises(InputError, match='max_lag'):
        resistance_pipeline(metro, EstimatorSettings(alignment=AlignmentConfig(max_lag=-1.0)))


# Statuses


def test_the_status_goes_from_converging_to_valid_and_holding(whole: Whole) -> None:
    outputs = whole[1]
    statuses = [output.status for output in outputs]
    assert statuses[0] is Status.CONVERGING
    assert {Status.CONVERGING, Status.VALID, Status.HOLDING} == set(statuses)
    # A brake rate may be trusted at a sample from which nothing is learned.
    first = min(statuses.index(Status.VALID), statuses.index(Status.HOLDING))
    assert set(statuses[:first]) == {Status.CONVERGING}
    for before, after in pairwise(outputs):
        if after.status is Status.VALID:
            assert after.used == before.used + 1
        if after.status is Status.HOLDING:
            assert after.rejected == before.rejected + 1


def test_a_valid_status_does_not_flicker(whole: Whole) -> None:
    """Hysteresis: an estimate near its limit does not alternate between fit and unfit for use."""
    statuses = [output.status for output in whole[1]]
    fit = [status in (Status.VALID, Status.HOLDING) for status in statuses]
    assert sum(a != b for a, b in pairwise(fit)) <= 3


@ALL
@pytest.mark.parametrize('kind', [SpeedRecord, ForceRecord, GradientRecord, BrakeRecord])
def test_missing_input_makes_the_status_stale_within_one_second_of_stamps(
    name: str, kind: type[Record], metro: TrainFile, day: Records
) -> None:
    pipeline = make(name, metro)
    run(pipeline, seconds(day, 0.0, 20.0))
    assert pipeline.status is not Status.STALE
    stopped_ns = pipeline.newest_ns
    # Commands hold for two seconds, but a topic without records is missing.
    became: int | None = None
    for record in seconds(day, 20.0, 30.0):
        if isinstance(record, kind):
            continue
        for output in pipeline.push(record):
            if output.status is Status.STALE and became is None:
                became = pipeline.newest_ns
            # The status remains STALE until the input is back.
            assert became is None or output.status is Status.STALE
    assert became is not None
    assert 0.5 < (became - stopped_ns) / NS_PER_S < 1.0
    outputs = run(pipeline, seconds(day, 30.0, 40.0))
    assert outputs[-1].status is not Status.STALE
    back = [(o.stamp_ns - outputs[0].stamp_ns) / NS_PER_S for o in outputs if o.status is not Status.STALE]
    assert back[0] < 2.0


@ALL
def test_nothing_is_learned_while_an_input_is_missing(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    run(pipeline, seconds(day, 0.0, 20.0))
    used = pipeline.used
    # A clock of the speed that is ahead: the other topics reach each of its stamps after stale_after.
    ahead = [
        replace(r, stamp_ns=r.stamp_ns + round(0.9 * NS_PER_S)) if isinstance(r, SpeedRecord) else r
        for r in seconds(day, 20.0, 120.0)
    ]
    outputs = run(pipeline, ahead)
    late = [o for o in outputs if o.status is Status.STALE and o.stamp_ns > ahead[0].stamp_ns + 2 * NS_PER_S]
    assert len(late) > 400
    assert {o.used for o in late} == {late[0].used}
    assert late[0].used - used < 20
    assert pipeline.rejections[Reason.LATE] > 0


@ALL
def test_an_input_that_never_begins_makes_the_status_stale(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    records = [r for r in seconds(day, 0.0, 5.0) if not isinstance(r, GradientRecord)]
    outputs = run(pipeline, records)
    assert outputs[-1].status is Status.STALE
    assert (outputs[0].status, pipeline.used) == (Status.STALE, 0)


@ALL
def test_a_fault_holds_until_a_reset(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    run(pipeline, seconds(day, 0.0, 30.0))
    assert pipeline.fail().status is Status.FAULT
    assert {o.status for o in run(pipeline, seconds(day, 30.0, 40.0))} == {Status.FAULT}
    pipeline.reset()
    assert run(pipeline, seconds(day, 40.0, 50.0))[-1].status is not Status.FAULT


# Time jumps


@ALL
def test_by_default_a_jump_back_starts_over(name: str, metro: TrainFile, day: Records) -> None:
    looped, fresh = make(name, metro), make(name, metro)
    first, second = seconds(day, 0.0, 100.0), seconds(day, 0.0, 80.0)
    run(looped, [replace(record, stamp_ns=record.stamp_ns + 2 * HOUR_NS) for record in first])
    again = run(looped, second)
    expected = run(fresh, second)
    assert looped.resets == 1
    assert repr(again[-1]) == repr(expected[-1])
    assert looped.rejections == fresh.rejections
    assert looped.estimator.save() == fresh.estimator.save()


@ALL
@pytest.mark.parametrize('back_s', [10.0, 3000.0])
def test_a_clock_that_is_set_back_by_up_to_an_hour_loses_nothing(
    name: str, metro: TrainFile, day: Records, back_s: float
) -> None:
    stepped, steady = make(name, metro), make(name, metro)
    first, second = seconds(day, 0.0, 150.0), seconds(day, 150.0, 300.0)
    run(stepped, first)
    run(stepped, [replace(record, stamp_ns=record.stamp_ns - round(back_s * NS_PER_S)) for record in second])
    run(steady, [*first, *second])
    assert stepped.resets == 0
    assert stepped.used == pytest.approx(steady.used, abs=40)
    (found, std), (expected, _) = (learned(pipeline.current().estimate) for pipeline in (stepped, steady))
    assert abs(found - expected) < 0.5 * std


def learned(estimate: Estimate) -> tuple[float, float]:
    """Return the most important value and its standard deviation."""
    if isinstance(estimate, ResistanceEstimate):
        return estimate.resistance, estimate.resistance_std
    if isinstance(estimate, BrakeRateEstimate):
        return estimate.brake_rate, estimate.brake_rate_std
    assert isinstance(estimate, SpeedModelEstimate)
    return estimate.b1, math.sqrt(estimate.covariance[10])


@ALL
def test_a_jump_back_can_be_ignored(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro, policy(TimeJumpPolicy.IGNORE))
    run(pipeline, seconds(day, 0.0, 150.0))
    used = pipeline.used
    outputs = run(pipeline, seconds(day, 0.0, 150.0))
    assert pipeline.resets == 0
    # The estimate is kept, and learning continues in the new time base.
    assert pipeline.used == pytest.approx(2 * used, rel=0.1)
    assert outputs[-1].stamp_ns < pipeline.newest_ns + 1
    assert outputs[-1].status in (Status.VALID, Status.HOLDING, Status.CONVERGING)


@ALL
def test_a_jump_back_can_be_rejected(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro, policy(TimeJumpPolicy.REFUSE))
    run(pipeline, seconds(day, 0.0, 100.0))
    state, used = pipeline.estimator.save(), pipeline.used
    run(pipeline, seconds(day, 0.0, 80.0))
    assert (pipeline.estimator.save(), pipeline.used, pipeline.resets) == (state, used, 0)
    assert pipeline.rejections[Reason.STAMP_JUMP] > 1000


@ALL
def test_a_jump_forward_keeps_the_estimate(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    run(pipeline, seconds(day, 0.0, 150.0))
    used = pipeline.used
    later = [replace(r, stamp_ns=r.stamp_ns + 1800 * NS_PER_S) for r in seconds(day, 150.0, 300.0)]
    outputs = run(pipeline, later)
    assert pipeline.resets == 0
    assert pipeline.used > used + 100
    assert all(map(math.isfinite, values(outputs[-1].estimate)))


@ALL
@pytest.mark.parametrize(
    ('kind', 'ahead_s'), [(TimeJumpPolicy.RESET, 3700.0), (TimeJumpPolicy.RESET, 3e7), (TimeJumpPolicy.REFUSE, 3e7)]
)
def test_a_clock_that_is_ahead_for_some_seconds_costs_their_samples(
    name: str, kind: TimeJumpPolicy, ahead_s: float, metro: TrainFile, day: Records
) -> None:
    struck, without = make(name, metro, policy(kind)), make(name, metro, policy(kind))
    ahead = [replace(r, stamp_ns=r.stamp_ns + round(ahead_s * NS_PER_S)) for r in seconds(day, 150.0, 154.0)]
    for pipeline, missing in ((struck, ahead), (without, [])):
        run(pipeline, [*seconds(day, 0.0, 150.0), *missing, *seconds(day, 154.0, 300.0)])
    assert struck.resets == 0
    assert struck.used == pytest.approx(without.used, abs=25)
    (found, std), (expected, expected_std) = (learned(item.current().estimate) for item in (struck, without))
    assert abs(found - expected) < 0.1 * expected_std
    assert std == pytest.approx(expected_std, rel=0.02)


@ALL
@pytest.mark.parametrize('ahead_s', [5.0, 9.0, 1e6, -50.0])
def test_one_stray_stamp_costs_one_record(name: str, ahead_s: float, metro: TrainFile, day: Records) -> None:
    plain, struck = make(name, metro), make(name, metro)
    before, after = seconds(day, 0.0, 30.0), seconds(day, 30.0, 40.0)
    for pipeline in (plain, struck):
        run(pipeline, before)
        if pipeline is struck:
            pipeline.push(ForceRecord(pipeline.newest_ns + round(ahead_s * NS_PER_S), 0.0))
        run(pipeline, after)
    assert struck.estimator.save() == plain.estimator.save()
    assert struck.rejections == plain.rejections + Counter({Reason.STAMP_JUMP: 1})


@ALL
def test_reset_equals_new(name: str, metro: TrainFile, day: Records) -> None:
    used, new = make(name, metro), make(name, metro)
    records = seconds(day, 0.0, 200.0)
    run(used, records)
    used.reset()
    assert used.status is Status.UNINITIALIZED
    assert repr(run(used, records)) == repr(run(new, records))
    assert used.resets == 1


@ALL
def test_a_restore_discards_earlier_records(name: str, metro: TrainFile, day: Records) -> None:
    """The mass is in tonnes until samples wait for the next accepted one; then a state is restored."""
    used, new = make(name, metro), make(name, metro)
    state = make(name, metro).save()
    wrong_from = day[0].stamp_ns + 20 * NS_PER_S
    for record in seconds(day, 0.0, 40.0):
        wrong = isinstance(record, MassRecord) and record.stamp_ns > wrong_from
        used.push(replace(record, mass=1e-3 * record.mass) if isinstance(record, MassRecord) and wrong else record)
    assert used.rejections[Reason.CONTRADICTION] > 5
    later = [replace(r, stamp_ns=r.stamp_ns + 1000 * NS_PER_S) for r in seconds(day, 60.0, 100.0)]
    used.restore(state)
    new.restore(state)
    estimates = [[repr(output.estimate) for output in run(pipeline, later)] for pipeline in (used, new)]
    assert estimates[0] == estimates[1]
    assert used.rejections == new.rejections


@ALL
def test_a_restored_state_ends_a_fault(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    state = pipeline.save()
    run(pipeline, seconds(day, 0.0, 30.0))
    pipeline.fail()
    pipeline.restore(state)
    assert run(pipeline, seconds(day, 30.0, 40.0))[-1].status is Status.CONVERGING


# Irrelevant changes of the input


def values(estimate: Estimate) -> list[float]:
    numbers = (getattr(estimate, key) for key in estimate.__dataclass_fields__)
    return [float(x) for x in numbers if isinstance(x, int | float)]


@ALL
def test_the_order_of_topics_does_not_matter(name: str, metro: TrainFile, day: Records) -> None:
    rng = np.random.default_rng(8)
    records = seconds(day, 0.0, 80.0)
    delays = {kind: float(rng.uniform(0.0, 0.25)) for kind in {type(r) for r in records}}
    keyed = sorted(records, key=lambda r: r.stamp_ns + round(delays[type(r)] * NS_PER_S))
    shuffled, plain = make(name, metro), make(name, metro)
    assert repr(run(shuffled, keyed)[-50:-5]) == repr(run(plain, records)[-50:-5])


@pytest.mark.slow
def test_a_microsecond_of_jitter_barely_changes_the_estimates(metro: TrainFile, day: Records) -> None:
    """All stamps of seven minutes jittered by 1 us: w(v) changes by less than 0.02 N/kN, the brake rate by 0.01.

    Both are an order of magnitude below the stated standard deviations. Resampling may select other particles after
    any change of its input, so the brake rate cannot remain exactly the same.
    """
    rng = np.random.default_rng(4)
    jittered = [replace(r, stamp_ns=r.stamp_ns + int(rng.integers(-1000, 1001))) for r in day]
    for name, bound in (('resistance', 0.02), ('brake_rate', 0.01)):
        plain, moved = make(name, metro), make(name, metro)
        run(plain, day)
        run(moved, jittered)
        if name == 'resistance':
            worst = max(
                abs(plain.estimator.estimate(v).resistance - moved.estimator.estimate(v).resistance)
                for v in (5.0, 10.0, 15.0, 20.0)
            )
        else:
            worst = abs(plain.current().estimate.brake_rate - moved.current().estimate.brake_rate)
        print(f'{name}: 1 us of jitter moves it by {worst:.2g}')
        assert worst < bound


def test_the_seed_of_the_settings_is_that_of_the_particles(metro: TrainFile, day: Records) -> None:
    records = seconds(day, 0.0, 150.0)
    one, two = (make('brake_rate', metro, EstimatorSettings(seed=seed)) for seed in (1, 2))
    run(one, records)
    run(two, records)
    assert one.current().estimate.brake_rate != two.current().estimate.brake_rate


# Consistency


@pytest.mark.parametrize('name', ['resistance', 'brake_rate'])
def test_each_update_is_judged_once(name: str, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    pairs: list[tuple[float, float]] = []
    last, used = (0.0, 0.0), 0
    for output in run(pipeline, seconds(day, 0.0, 150.0)):
        pair = (output.estimate.innovation, output.estimate.innovation_variance)
        if pair != last and output.used > used and pair[1] > 0.0:
            pairs.append(pair)
        last, used = pair, output.used
    squares = [nu * nu / variance for nu, variance in pairs[-WINDOW:]]
    assert pipeline.consistency.updates == len(squares)
    assert pipeline.consistency.ratio == pytest.approx(np.mean(np.minimum(squares, 100.0)))
    # The resistance lags two samples behind, and starts each piece of the drive with one speed.
    assert pipeline.used - 20 < len(pairs) <= pipeline.used


def test_an_estimate_refuted_by_its_innovations_is_not_valid(metro: TrainFile, day: Records) -> None:
    pipeline = make('resistance', metro)
    before = run(pipeline, seconds(day, 0.0, 280.0))
    assert before[-1].status in (Status.VALID, Status.HOLDING)
    for k in range(2 * WINDOW):
        pipeline._consistency.add(2.1 + 1e-9 * k, 1.0, used=True)
    refuted = run(pipeline, seconds(day, 280.0, 281.0))
    assert {output.status for output in refuted} == {Status.CONVERGING}


def test_a_group_goes_on_with_the_stream_that_a_pipeline_has_after_a_reset(metro: TrainFile, day: Records) -> None:
    together, alone = ([make(name, metro) for name in NAMES] for _ in range(2))
    group = PipelineGroup(together)
    for first, last in ((0, 1000), (1000, 2000)):
        records = day[first:last]
        for pipeline in alone:
            run(pipeline, records)
        assert group.push_rows(record.row() for record in records) == 1000
        assert [pipeline.save() for pipeline in together] == [pipeline.save() for pipeline in alone]
        assert {pipeline.newest_ns for pipeline in together} == {max(record.stamp_ns for record in day[:last])}
        for pipelines in (together, alone):
            pipelines[0].reset()
            pipelines[1].interrupt()


def test_a_stream_that_fails_fails_for_all_its_pipelines(metro: TrainFile) -> None:
    record = SharedRecord((77, 1, 0.0, 0.0, False))
    pipeline = make('resistance', metro)
    with pytest.raises(IndexError):
        record.events(pipeline.stream)
    with pytest.raises(TrainIdError, match='shares with another estimator has failed'):
        record.events(pipeline.stream)


def test_a_group_knows_when_the_inputs_contradicted_each_other(metro: TrainFile, day: Records) -> None:
    pipeline = resistance_pipeline(metro, EstimatorSettings())
    group = PipelineGroup([pipeline])
    assert math.isnan(group.contradiction.begin_s)
    start_ns, seen = day[0].stamp_ns, []
    for record in day:
        t = (record.stamp_ns - start_ns) / NS_PER_S
        wrong = isinstance(record, ForceRecord) and 40.0 <= t < 70.0
        topic, stamp_ns, x, y, flag = record.row()
        group.push_rows([(topic, stamp_ns, -x if wrong else x, y, flag)])
        if pipeline.stream.finding:
            seen.append(group.covered_s)
            assert math.isnan(group.contradiction.end_s)
    assert 40.0 < seen[0] < 100.0
    assert group.contradiction.finding == pipeline.stream.last_finding != ''
    assert group.contradiction.begin_s == seen[0]
    assert group.contradiction.end_s == pytest.approx(seen[-1], abs=0.5)
    assert group.contradiction.end_s > seen[-1]
