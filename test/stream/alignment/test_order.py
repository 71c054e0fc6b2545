# SPDX-License-Identifier: Apache-2.0
"""The order of arrival does not matter; bad records and jumps of the stamps are counted and survived."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
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
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.stream.samples import Sample

PERIOD = NS_PER_S // 5
CONFIG = AlignmentConfig()
# Examples are seeds: a smaller seed is not a simpler example, so shrinking is useless.
SEEDS = settings(max_examples=50, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))


def lost(records: list[Record], rng: np.random.Generator) -> set[int]:
    """Ids of lost records; never two in a row of one topic."""
    kinds = (ForceRecord, GradientRecord, BrakeRecord, SpeedRecord)
    seconds = [[r for r in records if isinstance(r, kind)][1::2] for kind in kinds]
    return {id(r) for topic in seconds for r in topic if rng.random() < 0.4}


@SEEDS
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_topics_does_not_matter(seed: int, run: Any, reasons: Any, arrivals: Any) -> None:
    by_stamp, by_arrival = (run(records) for records in arrivals(seed, CONFIG.max_lag))
    # repr shows every bit of a float, and NaN equals itself in it.
    assert repr(of(Sample, by_arrival)) == repr(of(Sample, by_stamp))
    assert reasons(by_arrival) == reasons(by_stamp)


@SEEDS
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_topics_does_not_matter_where_records_are_lost(seed: int, run: Any, arrivals: Any) -> None:
    """A lost record leaves gaps of 0.5 s, which are interpolated: samples wait for the next record."""
    orders = arrivals(seed, CONFIG.max_lag)
    gone = lost(orders[0], np.random.default_rng(seed))
    by_stamp, by_arrival = (run([r for r in records if id(r) not in gone]) for records in orders)
    assert repr(of(Sample, by_arrival)) == repr(of(Sample, by_stamp))


@SEEDS
@given(seed=st.integers(0, 2**32 - 1))
def test_a_lagging_mass_gives_the_same_samples(seed: int, drive: Any, run: Any, reasons: Any) -> None:
    """Mass is optional and never waited for; its lag must not affect from which sample on it counts."""
    rng = np.random.default_rng(seed)
    records = drive(8.0)
    masses: list[Record] = [MassRecord(at(t), 2e5 + 1e3 * t) for t in np.arange(0.55, 8.0, 1.0)]
    lags = rng.uniform(0.0, CONFIG.max_lag, len(masses)).tolist()
    in_time = [*((r.stamp_ns, r) for r in records), *((m.stamp_ns, m) for m in masses)]
    late = [(m.stamp_ns + round(lag * NS_PER_S), m) for m, lag in zip(masses, lags, strict=True)]
    lagging = [*((r.stamp_ns, r) for r in records), *late]
    expected, found = (run([r for _, r in sorted(order, key=lambda item: item[0])]) for order in (in_time, lagging))
    same = repr(of(Sample, found)) == repr(of(Sample, expected))
    assert same, f'seed {seed}: samples depend on when a mass arrives'
    # No topic lags by more than the limit, so nothing is rejected.
    assert not reasons(found)


def reordered(records: list[Record], rng: np.random.Generator) -> list[Record]:
    """Return records in an order in which none comes after another whose stamp is more than ``max_lag`` newer."""
    came = [record.stamp_ns + float(rng.uniform(0.0, CONFIG.max_lag)) * NS_PER_S for record in records]
    return [records[i] for i in np.argsort(came)]


@SEEDS
@given(seed=st.integers(0, 2**32 - 1), share_lost=st.sampled_from([0.0, 0.2]))
@pytest.mark.parametrize('rate', [2.0, 5.0, 20.0])
def test_any_order_within_the_lag_gives_the_same_samples(
    seed: int, share_lost: float, rate: float, drive: Any, run: Any, reasons: Any
) -> None:
    rng = np.random.default_rng(seed)
    jitter_ns = round(0.1 * NS_PER_S / rate)
    records = [
        replace(record, stamp_ns=record.stamp_ns + int(rng.integers(-jitter_ns, jitter_ns)))
        for record in drive(12.0, rate=rate)
        if rng.random() >= share_lost
    ]
    records.sort(key=lambda record: record.stamp_ns)
    by_stamp, by_arrival = run(records), run(reordered(records, rng))
    end_ns = records[-1].stamp_ns - round(2.0 * NS_PER_S)  # the last samples still wait
    samples, others = ([s for s in of(Sample, events) if s.stamp_ns < end_ns] for events in (by_stamp, by_arrival))
    assert len(samples) >= 5
    assert repr(others) == repr(samples)
    # Late records of other topics that no sample needs any more may be rejected.
    assert reasons(by_arrival)[Reason.LATE] <= 0.02 * len(records)


def test_records_in_order_are_used_at_once(drive: Any) -> None:
    """Where no record can be missing, a sample does not wait for late ones."""
    aligner, ages = Aligner(CONFIG), []
    for record in drive(12.0):
        samples = of(Sample, aligner.push(record))
        ages += [record.stamp_ns - sample.stamp_ns for sample in samples if sample.stamp_ns > at(4.0)]
    assert max(ages) == at(0.19) - START  # the next brake command, gradient and force are the last to come


@pytest.mark.parametrize(
    ('bad', 'reason'),
    [
        (SpeedRecord(0, 10.0, 0.0), Reason.ZERO_STAMP),
        (SpeedRecord(at(5.05), math.nan, 0.0), Reason.NOT_FINITE),
        (ForceRecord(at(5.05), math.inf), Reason.NOT_FINITE),
        (GradientRecord(at(5.05), math.nan, 0.0, tunnel=False), Reason.NOT_FINITE),
        (BrakeRecord(at(5.05), 0.5, emergency=False), Reason.OUT_OF_RANGE),
        (SpeedRecord(at(5.05), 500.0, 0.0), Reason.OUT_OF_RANGE),
        (MassRecord(at(5.05), -1.0), Reason.OUT_OF_RANGE),
        (SpeedRecord(at(3.1), 10.0, 0.0), Reason.LATE),
        (ForceRecord(at(3.1), 1000.0 * 3.1), Reason.LATE),
        (SpeedRecord(at(4.0), 99.0, 0.0), Reason.LATE),
        (ForceRecord(at(4.78), 9e9 / 100.0), Reason.DUPLICATE),
        (GradientRecord(at(4.77), 99.0, 0.0, tunnel=False), Reason.DUPLICATE),
        (BrakeRecord(at(4.79), -1.0, emergency=False), Reason.DUPLICATE),
        (SpeedRecord(at(4.8), 99.0, 0.0), Reason.DUPLICATE),
        (SpeedRecord(at(3600.0), 99.0, 0.0), Reason.STAMP_JUMP),
        (SpeedRecord(at(-3600.0), 99.0, 0.0), Reason.STAMP_JUMP),
        (SpeedRecord(1, 99.0, 0.0), Reason.STAMP_JUMP),
    ],
    ids=lambda value: value.name if isinstance(value, Reason) else type(value).__name__,
)
def test_a_bad_record_is_counted_once_and_changes_nothing(
    bad: Record, reason: Reason, drive: Any, run: Any, reasons: Any
) -> None:
    records = drive(10.0)
    k = next(i for i, record in enumerate(records) if record.stamp_ns > at(4.9))
    events = run([*records[:k], bad, *records[k:]])
    assert reasons(events) == {reason: 1}
    assert repr(of(Sample, events)) == repr(of(Sample, run(records)))


@pytest.mark.parametrize('step_s', [100.0, -100.0])
def test_a_rejection_holds_the_value_and_the_limit(step_s: float, drive: Any, run: Any) -> None:
    records = drive(5.0)
    newest_ns = records[-2].stamp_ns
    stray = ForceRecord(newest_ns + round(step_s * NS_PER_S), 1.0)
    # A stray stamp is rejected once the next record continues as before.
    (rejection,) = of(Rejection, run([*records[:-1], stray, records[-1]]))
    assert (rejection.stamp_ns, rejection.reason) == (stray.stamp_ns, Reason.STAMP_JUMP)
    assert rejection.value == pytest.approx(step_s)
    assert rejection.limit == math.copysign(CONFIG.max_jump_back, step_s)


def test_a_bag_that_starts_over_is_one_jump_back_and_continues(drive: Any, run: Any, reasons: Any) -> None:
    records = drive(20.0)
    events = run([*records, *records])
    (jump,) = of(TimeJump, events)
    assert jump.step_s == pytest.approx(-19.9, abs=0.3)
    # Records are held until one topic has brought three; none is lost.
    assert not reasons(events)
    samples = of(Sample, events)
    assert len(samples) >= 2 * 100 - 1
    first = next(i for i, (a, b) in enumerate(pairwise(samples)) if b.stamp_ns < a.stamp_ns)
    assert math.isnan(samples[first + 1].dt)
    # Samples pending at the end of the first pass are released before the jump, not lost.
    assert samples[first].stamp_ns == at(19.8)


def test_a_jump_forward_is_one_jump_and_continues(drive: Any, run: Any) -> None:
    events = run([*drive(20.0), *drive(20.0, start_s=1000.0)])
    (jump,) = of(TimeJump, events)
    assert jump.step_s == pytest.approx(980.0, abs=0.5)
    samples = of(Sample, events)
    assert len(samples) >= 2 * 100 - 3
    assert [math.isnan(s.dt) for s in samples].count(True) == 2


def test_where_jumps_back_are_rejected_all_records_are_until_the_stamps_catch_up(
    drive: Any, run: Any, reasons: Any
) -> None:
    events = run([*drive(20.0), *drive(25.0)], reject=True)
    assert not of(TimeJump, events)
    stamps = [s.stamp_ns for s in of(Sample, events)]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] > at(24.0)
    # 18 s of four topics at 5 Hz lie more than two seconds back.
    assert reasons(events)[Reason.STAMP_JUMP] == pytest.approx(18 * 20, abs=10)


def test_a_jump_forward_is_followed_even_where_jumps_back_are_rejected(drive: Any, run: Any) -> None:
    events = run([*drive(20.0), *drive(20.0, start_s=1000.0)], reject=True)
    assert len(of(TimeJump, events)) == 1


@pytest.mark.parametrize('ahead_s', [1.0, 3.0, 5.0, 9.0, 11.0, 1e6])
def test_one_stray_stamp_does_not_move_the_time_base(ahead_s: float, drive: Any, run: Any) -> None:
    """A single record whose stamp is wrong must not make estimators forget what they have learned."""
    records = drive(30.0)
    stray = ForceRecord(at(15.0 + ahead_s) + 7, 0.0)
    k = next(i for i, record in enumerate(records) if record.stamp_ns > at(15.0))
    events = run([*records[:k], stray, *records[k:]])
    assert not of(TimeJump, events)
    assert len(of(Sample, events)) >= 140


@pytest.mark.parametrize('ahead_s', [5.0, 30.0, 1e8, -1e8])
@pytest.mark.parametrize('each', [1, 2])
def test_stray_stamps_of_all_topics_at_once_do_not_move_the_time_base(
    each: int, ahead_s: float, drive: Any, run: Any, reasons: Any
) -> None:
    records = drive(20.0)
    k = next(i for i, record in enumerate(records) if record.stamp_ns > at(10.0))
    kinds = (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord)
    following = [[r for r in records[k:] if isinstance(r, kind)][:each] for kind in kinds]
    stray = sorted((r for topic in following for r in topic), key=lambda r: r.stamp_ns)
    ahead_ns = round(ahead_s * NS_PER_S)
    events = run([*records[:k], *(replace(r, stamp_ns=r.stamp_ns + ahead_ns) for r in stray), *records[k:]])
    assert not of(TimeJump, events)
    assert reasons(events) == {Reason.STAMP_JUMP: len(stray)}
    assert repr(of(Sample, events)) == repr(of(Sample, run(records)))


@pytest.mark.parametrize('step_s', [-3000.0, -7200.0, 1800.0])
def test_a_step_of_all_topics_is_followed_within_a_second_of_data(step_s: float, drive: Any) -> None:
    records, step_ns, aligner = drive(20.0), round(step_s * NS_PER_S), Aligner(CONFIG)
    for record in records:
        if record.stamp_ns < at(10.0):
            aligner.push(record)
            continue
        if of(TimeJump, aligner.push(replace(record, stamp_ns=record.stamp_ns + step_ns))):
            break
    assert at(10.3) < record.stamp_ns < at(11.0)


def test_one_topic_with_a_different_clock_does_not_move_the_time_base(drive: Any, run: Any) -> None:
    records = [
        replace(r, stamp_ns=r.stamp_ns + 3600 * NS_PER_S) if isinstance(r, GradientRecord) else r for r in drive(20.0)
    ]
    events = run(sorted(records, key=lambda r: r.stamp_ns - (3600 * NS_PER_S if isinstance(r, GradientRecord) else 0)))
    assert len(of(TimeJump, events)) <= 1
    # The aligner never switches back and forth between two time bases.
    stamps = [s.stamp_ns for s in of(Sample, events)]
    assert sum(b < a for a, b in pairwise(stamps)) == 0


def test_a_dropout_of_all_topics_is_a_gap_and_not_a_jump(drive: Any, run: Any, reasons: Any) -> None:
    events = run([*drive(10.0), *drive(10.0, start_s=15.0)])
    assert not of(TimeJump, events)
    assert not reasons(events)
    samples = of(Sample, events)
    assert [math.isnan(s.dt) for s in samples].count(True) == 2


@pytest.mark.parametrize('kind', [SpeedRecord, ForceRecord, GradientRecord, BrakeRecord, MassRecord])
def test_one_topic_alone_does_not_exhaust_memory(kind: type[Record]) -> None:
    def record(i: int) -> Record:
        stamp = START + i * PERIOD
        if kind is SpeedRecord:
            return SpeedRecord(stamp, 1.0, 0.0)
        if kind is ForceRecord:
            return ForceRecord(stamp, 1.0)
        if kind is GradientRecord:
            return GradientRecord(stamp, 1.0, 0.0, tunnel=False)
        return BrakeRecord(stamp, -0.1, emergency=False) if kind is BrakeRecord else MassRecord(stamp, 1e5)

    aligner = Aligner(CONFIG)
    tracemalloc.start()
    for i in range(20_000):
        aligner.push(record(i))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # 4096 records at most; all of them would take 1.2 MB at least.
    assert held < 800_000


def test_reset_equals_new(drive: Any, run: Any) -> None:
    used = Aligner(CONFIG)
    for record in drive(13.3):
        used.push(record)
    used.reset()
    assert used.newest_ns == 0
    again = [event for record in drive(10.0) for event in used.push(record)]
    assert repr(again) == repr(run(drive(10.0)))


def test_records_of_one_topic_with_stray_stamps_are_kept_up_to_a_number_and_then_rejected(drive: Any) -> None:
    aligner = Aligner(CONFIG)
    for record in drive(10.0):
        aligner.push(record)
    stray = [SpeedRecord(at(3600.0 + 0.2 * k), 10.0, 0.0) for k in range(40)]
    rejected = [event for record in stray for event in aligner.push(record) if isinstance(event, Rejection)]
    # Two of each of five topics, and one more.
    assert len(aligner._suspects) == 11
    assert len(rejected) == 40 - 11
