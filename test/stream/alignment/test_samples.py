# SPDX-License-Identifier: Apache-2.0
"""One sample per speed record, at its stamp: values, dropouts, brake commands, mass, curve and direction."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from test.stream.alignment.events import START, at, of
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.interface.results import Reason
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange

CONFIG = AlignmentConfig()


def without(kind: type[Record], records: list[Record], low_s: float, high_s: float) -> list[Record]:
    return [r for r in records if not (isinstance(r, kind) and at(low_s) <= r.stamp_ns < at(high_s))]


def test_each_speed_record_becomes_one_sample_at_its_stamp(drive: Any, run: Any, reasons: Any) -> None:
    records = drive(20.0)
    events = run(records)
    samples = of(Sample, events)
    speeds = [record for record in records if isinstance(record, SpeedRecord)]
    # The last ones still wait for force and gradient.
    assert len(speeds) - len(samples) <= 2
    assert [s.stamp_ns for s in samples] == [r.stamp_ns for r in speeds[: len(samples)]]
    assert [s.speed for s in samples] == [r.speed for r in speeds[: len(samples)]]
    assert not reasons(events)


def test_force_and_gradient_are_interpolated_to_the_stamp_and_averaged_over_the_step(drive: Any, run: Any) -> None:
    for sample in of(Sample, run(drive(20.0)))[2:]:
        t = (sample.stamp_ns - START) / NS_PER_S
        # Linear in time: exact but for rounding.
        assert sample.dt == pytest.approx(0.2, abs=1e-12)
        assert sample.force == pytest.approx(1000.0 * t, abs=1e-6)
        assert sample.force_mean == pytest.approx(1000.0 * (t - 0.1), abs=1e-6)
        assert sample.gradient == pytest.approx(0.1 * t, abs=1e-10)
        assert sample.gradient_mean == pytest.approx(0.1 * (t - 0.1), abs=1e-10)


def test_the_mean_counts_every_record_inside_the_step() -> None:
    aligner = Aligner(CONFIG)
    ramp = [0.0, 0.0, 100.0, 0.0, 0.0]  # a triangle of base 0.1 s inside the second step
    records: list[Record] = [ForceRecord(at(x), f) for x, f in zip((0.0, 0.25, 0.3, 0.35, 0.5), ramp, strict=True)]
    for t in (0.0, 0.2, 0.4, 0.6, 0.8):
        records.append(GradientRecord(at(t), 0.0, 0.0, tunnel=False))
        records.append(BrakeRecord(at(t), 0.0, emergency=False))
    records += [SpeedRecord(at(t), 1.0, math.nan) for t in (0.0, 0.2, 0.4)]
    records.sort(key=lambda record: record.stamp_ns)
    samples = of(Sample, [event for record in records for event in aligner.push(record)])
    assert samples[2].force_mean == pytest.approx(0.5 * 0.1 * 100.0 / 0.2, rel=1e-12)


def test_the_first_sample_and_one_after_a_gap_have_no_dt(drive: Any, run: Any) -> None:
    records = without(SpeedRecord, drive(20.0), 8.0, 9.5)
    samples = of(Sample, run(records))
    gaps = [sample.stamp_ns for sample in samples if math.isnan(sample.dt)]
    assert gaps == [at(0.0), at(9.6)]
    assert samples[1].dt == pytest.approx(0.2)


def test_one_lost_speed_record_makes_a_step_of_twice_the_period(drive: Any, run: Any) -> None:
    records = without(SpeedRecord, drive(10.0), 3.95, 4.05)
    samples = {s.stamp_ns: s for s in of(Sample, run(records))}
    assert at(4.0) not in samples
    assert samples[at(4.2)].dt == pytest.approx(0.4)
    assert samples[at(4.2)].force_mean == pytest.approx(1000.0 * 4.0, rel=1e-9)


@pytest.mark.parametrize('rate', [10.0, 20.0, 50.0, 100.0])
def test_faster_topics_are_thinned_evenly(rate: float, drive: Any, run: Any, reasons: Any) -> None:
    events = run(drive(40.0, rate=rate))
    samples = of(Sample, events)
    steps = [(b.stamp_ns - a.stamp_ns) / NS_PER_S for a, b in pairwise(samples)]
    # The first step may be shorter: it finds the phase.
    assert steps[1:] == pytest.approx([0.2] * (len(steps) - 1), abs=1e-9)
    assert reasons(events) == {Reason.THINNED: pytest.approx(len(samples) * (rate / 5.0 - 1.0), abs=2 * rate / 5)}
    assert samples[-1].force_mean == pytest.approx(1000.0 * ((samples[-1].stamp_ns - START) / NS_PER_S - 0.1), rel=1e-6)


def test_jitter_costs_no_sample(drive: Any, run: Any, reasons: Any) -> None:
    rng = np.random.default_rng(3)
    shifted = [replace(r, stamp_ns=r.stamp_ns + int(rng.integers(-30_000_000, 30_000_000))) for r in drive(60.0)]
    events = run(sorted(shifted, key=lambda record: record.stamp_ns))
    assert len(of(Sample, events)) >= 5 * 60 - 2
    assert not reasons(events)


@pytest.mark.parametrize('kind', [ForceRecord, GradientRecord])
def test_a_dropout_of_an_input_gives_nan_until_it_ends(kind: type[Record], drive: Any, run: Any) -> None:
    samples = of(Sample, run(without(kind, drive(20.0), 8.0, 11.0)))
    name = 'force' if kind is ForceRecord else 'gradient'
    unknown = [(s.stamp_ns - START) / NS_PER_S for s in samples if math.isnan(getattr(s, f'{name}_mean'))]
    # No sample is lost, and only those without a record nearby have no value.
    assert len(samples) >= 98
    assert min(unknown) == pytest.approx(8.0)
    # The mean up to 11.2 s begins at 11.0 s, where the value is not known yet.
    assert max(unknown) == pytest.approx(11.2)
    assert len(unknown) == 17


def test_a_short_dropout_is_interpolated(drive: Any, run: Any) -> None:
    samples = of(Sample, run(without(ForceRecord, drive(20.0), 8.0, 8.35)))
    assert all(math.isfinite(s.force_mean) for s in samples[2:])
    sample = next(s for s in samples if s.stamp_ns == at(8.2))
    assert sample.force == pytest.approx(1000.0 * 8.2, rel=1e-9)


def test_a_brake_command_is_unknown_once_it_is_older_than_the_timeout(drive: Any, run: Any) -> None:
    samples = of(Sample, run(without(BrakeRecord, drive(20.0), 5.0, 99.0)))
    unknown = [s for s in samples if math.isnan(s.brake_command)]
    # The last command came at 4.99 - 0.2 s; it is known for two seconds more.
    assert unknown[0].stamp_ns == at(7.0)
    assert unknown[-1] is samples[-1]
    assert all(not s.emergency for s in unknown)


def test_the_wait_for_a_lagging_topic_is_limited_by_stamps(drive: Any) -> None:
    aligner = Aligner(CONFIG)
    released = [
        (aligner.newest_ns - event.stamp_ns) / NS_PER_S
        for record in without(ForceRecord, drive(20.0), 10.0, 99.0)
        for event in aligner.push(record)
        if isinstance(event, Sample) and event.stamp_ns >= at(10.0)
    ]
    assert released
    # Released by the first record past the longest wait: records are at most 0.18 s apart.
    longest = CONFIG.max_gap + CONFIG.max_lag
    assert longest < min(released)
    assert max(released) < longest + 0.2


@settings(max_examples=40, deadline=None)
@given(commands=st.lists(st.sampled_from([0.0, -0.3, -0.5]), min_size=30, max_size=80), seed=st.integers(0, 2**32 - 1))
def test_every_change_of_the_command_is_delivered_once_with_its_stamp(
    commands: list[float], seed: int, drive: Any, run: Any
) -> None:
    rng = np.random.default_rng(seed)
    stamps = START - 10_000_000 + np.cumsum(rng.integers(20_000_000, 200_000_000, len(commands)))
    brakes: list[Record] = [BrakeRecord(int(s), u, emergency=False) for s, u in zip(stamps, commands, strict=True)]
    others = [r for r in drive(16.0, start_s=0.0) if not isinstance(r, BrakeRecord)]
    records = sorted([*brakes, *others], key=lambda record: record.stamp_ns)
    samples = of(Sample, run(records))
    last_ns = samples[-1].stamp_ns
    expected: list[BrakeCommandChange] = []
    for record in brakes:
        assert isinstance(record, BrakeRecord)
        if record.stamp_ns > last_ns:
            break
        if not expected or expected[-1].target_acceleration != record.target_acceleration:
            expected.append(BrakeCommandChange(record.stamp_ns, record.target_acceleration))
    assert [change for s in samples for change in s.brake_changes] == expected
    for before, after in pairwise(samples):
        assert all(before.stamp_ns < change.stamp_ns <= after.stamp_ns for change in after.brake_changes)


@pytest.mark.parametrize(('missing_for_s', 'missed'), [(0.05, False), (0.2, True), (1.0, True)])
def test_a_command_that_differs_after_a_gap_is_a_brake_gap(
    missing_for_s: float, missed: bool, drive: Any, run: Any
) -> None:
    # Commands come every 0.2 s, one of them at 4.99 s: the shortest dropout loses none.
    records = without(BrakeRecord, drive(10.0), 4.9, 4.9 + missing_for_s)
    braked = [
        replace(r, target_acceleration=-0.5) if isinstance(r, BrakeRecord) and r.stamp_ns > at(4.9) else r
        for r in records
    ]
    samples = of(Sample, run(braked))
    assert any(s.brake_gap for s in samples) is missed
    # A gap with the same command before and after is no brake gap.
    assert not any(s.brake_gap for s in of(Sample, run(records)))


def test_the_emergency_flag_holds_from_its_stamp(drive: Any, run: Any) -> None:
    records = [replace(r, emergency=r.stamp_ns >= at(5.0)) if isinstance(r, BrakeRecord) else r for r in drive(10.0)]
    samples = of(Sample, run(records))
    assert [s.emergency for s in samples] == [s.stamp_ns > at(5.0) for s in samples]


def test_the_mass_holds_until_the_next_weighing(drive: Any, run: Any) -> None:
    records = [*drive(10.0), MassRecord(at(1.05), 2e5), MassRecord(at(6.05), 3e5)]
    samples = of(Sample, run(sorted(records, key=lambda record: record.stamp_ns)))
    early, middle, late = (samples[i].mass for i in (2, 20, 45))
    assert math.isnan(early)
    assert (middle, late) == (2e5, 3e5)


@pytest.mark.parametrize(
    ('weighed_s', 'first_drive', 'second_drive', 'overdue'),
    [
        ([], False, False, False),
        ([0.55], True, False, False),  # once, before the first departure
        ([0.55, 5.05], True, False, False),  # weighing fails before the stop
        ([0.55, 6.55], True, True, False),  # once per stop
        ([k + 0.05 for k in range(14)], True, True, False),  # every second
        ([0.5 * k + 0.05 for k in range(10)], True, False, True),  # twice a second, until before the stop
        ([0.5 * k + 0.05 for k in range(14)], True, False, True),  # twice a second, until the doors open
    ],
)
def test_a_load_counts_as_weighed_until_the_train_next_stops(
    weighed_s: list[float], first_drive: bool, second_drive: bool, overdue: bool, stopping: Any
) -> None:
    samples = stopping(weighed_s=weighed_s)
    first, second = samples[5 * 4], samples[5 * 12]
    assert (first.weighed, second.weighed) == (first_drive, second_drive)
    assert (first.is_weighing_overdue, second.is_weighing_overdue) == (False, overdue)
    assert math.isnan(second.mass) is (not weighed_s)


def test_a_mass_is_kept_while_a_lagging_one_may_still_come(drive: Any, run: Any) -> None:
    records = [*drive(10.0), *(MassRecord(at(k + 0.05), 2e5) for k in range(10))]
    samples = of(Sample, run(sorted(records, key=lambda record: record.stamp_ns), AlignmentConfig(max_lag=1.5)))
    assert not any(math.isnan(sample.mass) for sample in samples[10:])


def test_the_force_interval_is_that_of_the_records_around_the_stamp(drive: Any, run: Any) -> None:
    records = without(ForceRecord, drive(10.0), 4.9, 5.3)  # two are missing
    intervals = [sample.force_interval for sample in of(Sample, run(records))]
    assert intervals[10] == pytest.approx(0.2)
    assert max(intervals) == pytest.approx(0.6)
    unknown = of(Sample, run(without(ForceRecord, drive(10.0), 4.0, 6.0)))
    missing = [sample.force_interval for sample in unknown if math.isnan(sample.force)]
    assert len(missing) > 5
    assert set(missing) == {0.0}


def test_curvature_is_interpolated_and_a_tunnel_holds_from_its_record(drive: Any, run: Any) -> None:
    records = [
        replace(r, curve_radius=1.0 / (1e-4 * ((r.stamp_ns - START) / NS_PER_S + 1.0)), tunnel=r.stamp_ns > at(5.0))
        if isinstance(r, GradientRecord)
        else r
        for r in drive(10.0)
    ]
    samples = of(Sample, run(records))
    for sample in samples[2:]:
        t = (sample.stamp_ns - START) / NS_PER_S
        assert 1.0 / sample.curve_radius == pytest.approx(1e-4 * (t + 1.0), rel=1e-9)
        assert sample.tunnel is (t > 5.1)


def in_a_curve(low_s: float, high_s: float, records: list[Record]) -> list[Record]:
    """Return the records with a curve of 250 m radius between two times."""
    return [
        replace(r, curve_radius=250.0) if isinstance(r, GradientRecord) and at(low_s) <= r.stamp_ns < at(high_s) else r
        for r in records
    ]


def test_the_mean_curvature_is_that_of_the_interval(drive: Any, run: Any) -> None:
    records = [
        replace(r, curve_radius=1.0 / (1e-4 * ((r.stamp_ns - START) / NS_PER_S + 1.0)))
        if isinstance(r, GradientRecord)
        else r
        for r in drive(10.0)
    ]
    for sample in of(Sample, run(records))[2:]:
        t = (sample.stamp_ns - START) / NS_PER_S
        # Linear in time: that in the middle of the interval.
        assert sample.curvature_mean == pytest.approx(1e-4 * (t - 0.1 + 1.0), rel=1e-9)
        assert sample.curvature == sample.curvature_mean


def test_where_a_curve_begins_the_mean_includes_the_part_inside_it(drive: Any, run: Any) -> None:
    samples = of(Sample, run(in_a_curve(5.0, 99.0, drive(10.0))))
    means = {round((s.stamp_ns - START) / NS_PER_S, 1): 250.0 * s.curvature_mean for s in samples}
    # Between the records at 4.97 and 5.17 s the curvature rises: to 0.15 at 5.0 s, and on to 1.
    expected = [0.0, 0.5 * 0.03 * 0.15 / 0.2, (0.5 * 0.17 * 1.15 + 0.03) / 0.2, 1.0]
    assert [means[t] for t in (4.8, 5.0, 5.2, 5.4)] == pytest.approx(expected, abs=1e-9)
    assert samples[2].curvature == 0.0


def test_the_mean_includes_a_curve_between_two_slow_samples(drive: Any, run: Any) -> None:
    """Half a second of curve, speeds once a second: at the stamps there is none."""
    records = in_a_curve(5.2, 5.7, drive(20.0))
    slow = [r for r in records if not isinstance(r, SpeedRecord) or (r.stamp_ns - START) % NS_PER_S == 0]
    samples = {s.stamp_ns: s for s in of(Sample, run(slow))}
    # Records at 5.37 and 5.57 s are in the curve, those at 5.17 and 5.77 s are not.
    assert 250.0 * samples[at(6.0)].curvature_mean == pytest.approx(0.4, abs=1e-9)
    assert samples[at(6.0)].curve_radius == 0.0
    assert samples[at(5.0)].curvature_mean == samples[at(7.0)].curvature_mean == 0.0


def test_after_a_gap_the_mean_curvature_is_that_at_the_stamp(drive: Any, run: Any) -> None:
    records = without(SpeedRecord, in_a_curve(4.0, 8.4, drive(20.0)), 8.0, 9.5)
    samples = of(Sample, run(records))
    (gap,) = (s for s in samples[1:] if math.isnan(s.dt))
    assert gap.curvature_mean == 0.0
    assert samples[0].curvature_mean == 0.0


def test_a_reset_forgets_the_curve(drive: Any) -> None:
    used = Aligner(CONFIG)
    for record in in_a_curve(0.0, 99.0, drive(10.0)):
        used.push(record)
    used.reset()
    again = of(Sample, [event for record in drive(10.0) for event in used.push(record)])
    assert {s.curvature_mean for s in again} == {0.0}


def test_without_a_mean_the_curvature_is_that_at_the_stamp(drive: Any, run: Any) -> None:
    (sample, *_) = of(Sample, run(drive(2.0)))
    curved = replace(sample, curve_radius=400.0, curvature_mean=math.nan)
    assert curved.curvature == pytest.approx(1.0 / 400.0, rel=1e-15)
    assert replace(curved, curve_radius=0.0).curvature == 0.0
    # A known mean counts, even if it is zero.
    assert replace(curved, curvature_mean=0.0).curvature == 0.0


def test_the_direction_follows_the_positions_but_not_their_noise(drive: Any, run: Any) -> None:
    rng = np.random.default_rng(5)
    records: list[Record] = []
    for r in drive(60.0):
        if not isinstance(r, SpeedRecord):
            records.append(r)
            continue
        t = (r.stamp_ns - START) / NS_PER_S
        # Up the line, a stand at 300 m, down the line; then positions are lost.
        position = min(10.0 * t, 300.0) - max(0.0, 10.0 * (t - 40.0)) + rng.normal(0.0, 0.3)
        records.append(replace(r, position=math.nan if t > 55.0 else position))
    for sample in of(Sample, run(records)):
        t = (sample.stamp_ns - START) / NS_PER_S
        if not 39.9 < t < 41.5:
            assert sample.direction == (1 if t < 40.0 else -1), t
