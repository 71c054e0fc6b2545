# SPDX-License-Identifier: Apache-2.0
"""Alignment of topics at any rate from 1 to 50 Hz: limits follow slow topics and are fixed for fast ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from test.stream.alignment.events import START, at
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, AlignmentEvent
from trainid_ros.stream.samples import Sample

CONFIG = AlignmentConfig()
# All intervals are longer, so the limits are those of the settings at any rate.
FIXED = AlignmentConfig(max_interval=0.02)
KINDS = (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord)
RATES = (1.0, 2.0, 5.0, 10.0, 50.0)
LEARNED_S = 20.0
"""From this time on the rates are known, including changed ones [s]."""
SEEDS = settings(max_examples=40, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
Rates = tuple[float, float, float, float]


def seconds_of(stamp_ns: int) -> float:
    return (stamp_ns - START) / NS_PER_S


def no_brake(_: float) -> float:
    return 0.0


def record(kind: type[Record], t: float, command: Callable[[float], float] = no_brake) -> Record:
    """Return a record of values linear in time, so that interpolation is exact."""
    if kind is SpeedRecord:
        return SpeedRecord(at(t), 10.0 + 0.1 * t, 100.0 + 10.0 * t)
    if kind is ForceRecord:
        return ForceRecord(at(t), 1000.0 * t)
    if kind is GradientRecord:
        return GradientRecord(at(t), 0.1 * t, 0.0, tunnel=False)
    return BrakeRecord(at(t), command(t), emergency=False)


def topic_times(rate: float, low: float, high: float, rng: np.random.Generator) -> list[float]:
    """Return the times of one topic: a random phase, and jitter of up to a tenth of the interval."""
    times = low + (np.arange(math.floor((high - low) * rate)) + rng.uniform(0.2, 0.8)) / rate
    jittered: list[float] = (times + rng.uniform(-0.1, 0.1, len(times)) / rate).tolist()
    return jittered


def drive(
    rates: Rates, high: float, seed: int = 0, *, low: float = 0.0, command: Callable[[float], float] = no_brake
) -> list[Record]:
    """Return records of speed, force, gradient and brake command, each at its own rate."""
    rng = np.random.default_rng(seed)
    records = [
        record(kind, t, command)
        for kind, rate in zip(KINDS, rates, strict=True)
        for t in topic_times(rate, low, high, rng)
    ]
    return sorted(records, key=lambda item: item.stamp_ns)


def run(records: list[Record], config: AlignmentConfig = CONFIG) -> list[AlignmentEvent]:
    aligner = Aligner(config)
    return [event for item in records for event in aligner.push(item)]


def samples_of(events: list[AlignmentEvent], since: float = LEARNED_S) -> list[Sample]:
    return [event for event in events if isinstance(event, Sample) and event.stamp_ns >= at(since)]


def without(kind: type[Record], records: list[Record], low: float, high: float) -> list[Record]:
    return [item for item in records if not (isinstance(item, kind) and at(low) <= item.stamp_ns < at(high))]


def assert_complete(samples: list[Sample]) -> None:
    for before, sample in pairwise(samples):
        t, dt = seconds_of(sample.stamp_ns), (sample.stamp_ns - before.stamp_ns) / NS_PER_S
        assert sample.dt == pytest.approx(dt, abs=1e-9)
        assert sample.force == pytest.approx(1000.0 * t, rel=1e-6)
        assert sample.force_mean == pytest.approx(1000.0 * (t - 0.5 * dt), rel=1e-6)
        assert sample.gradient_mean == pytest.approx(0.1 * (t - 0.5 * dt), rel=1e-6)
        assert math.isfinite(sample.brake_command)


# All rates and mixtures


@pytest.mark.parametrize('rates', list(product((1.0, 10.0), (1.0, 5.0, 50.0), (1.0, 2.0), (1.0, 2.0, 50.0))), ids=str)
def test_mixed_rates_give_complete_samples_at_the_stamps_of_the_speed(rates: Rates) -> None:
    events = run(drive(rates, 60.0))
    samples = samples_of(events)
    assert_complete(samples)
    assert len(samples) == pytest.approx(min(rates[0], 5.0) * 40.0, abs=2.5 * min(rates[0], 5.0) + 2.0)
    assert {event.reason for event in events if isinstance(event, Rejection)} <= {Reason.THINNED}
    assert not any(sample.brake_gap for sample in samples)


@pytest.mark.parametrize(('rate', 'known_s'), [(1.0, 9.0), (2.0, 5.0), (5.0, 1.0), (10.0, 1.0), (50.0, 1.0)])
def test_one_rate_for_all_and_when_it_is_known(rate: float, known_s: float) -> None:
    samples = samples_of(run(drive((rate, rate, rate, rate), 60.0, seed=2)), known_s)
    assert len(samples) > 45 * min(rate, 5.0)
    assert_complete(samples)


def test_a_topic_slower_than_the_limit_is_not_interpolated() -> None:
    samples = samples_of(run(drive((5.0, 0.5, 5.0, 5.0), 60.0)))
    assert all(math.isnan(sample.force_mean) for sample in samples)
    slower = AlignmentConfig(max_interval=2.5)
    assert_complete(samples_of(run(drive((5.0, 0.5, 5.0, 5.0), 90.0), slower), 40.0)[:150])


@SEEDS
@given(
    st.integers(0, 2**32 - 1),
    st.tuples(*(st.sampled_from([5.0, 8.0, 10.0, 50.0]) for _ in KINDS)),
    st.floats(0.0, 0.3),
)
def test_nothing_changes_for_topics_of_5_hz_and_more(seed: int, rates: Rates, loss: float) -> None:
    """Jitter, a third of the records lost, dropouts of any length: limits are those of the settings, to the bit."""
    rng = np.random.default_rng(seed)
    records = [item for item in drive(rates, 60.0, seed) if rng.random() >= loss or item.stamp_ns < at(5.0)]
    for kind in KINDS:
        begin = rng.uniform(5.0, 50.0)
        records = without(kind, records, begin, begin + rng.exponential(2.0))
    records = [
        replace(item, target_acceleration=-0.4 * int(rng.integers(3))) if isinstance(item, BrakeRecord) else item
        for item in records
    ]
    assert repr(run(records)) == repr(run(records, FIXED))


@SEEDS
@given(st.integers(0, 2**32 - 1), st.tuples(*(st.sampled_from(RATES) for _ in KINDS)))
def test_the_order_of_topics_does_not_matter_at_any_rate(seed: int, rates: Rates) -> None:
    """No topic lags by more than the limit, and each keeps its own order."""
    records = drive(rates, 40.0, seed, command=lambda t: -0.4 if t % 9.0 > 5.0 else 0.0)
    rng = np.random.default_rng(seed)
    delay: dict[type[Record], float] = {kind: rng.uniform(0.0, CONFIG.max_lag) for kind in KINDS}
    arrivals = sorted(records, key=lambda item: item.stamp_ns + round(delay[type(item)] * NS_PER_S))
    by_stamp, by_arrival = (samples_of(run(order), 0.0) for order in (records, arrivals))
    common = min(len(by_stamp), len(by_arrival))
    assert common > 30
    assert repr(by_arrival[:common]) == repr(by_stamp[:common])


# Dropouts and changes of rate


@pytest.mark.parametrize('rate', RATES)
@pytest.mark.parametrize('kind', [ForceRecord, GradientRecord])
def test_a_slow_topic_may_lose_one_record_in_a_row_but_not_two(kind: type[Record], rate: float) -> None:
    rates: Rates = tuple(rate if k is kind else 5.0 for k in KINDS)  # type: ignore[assignment]
    records = drive(rates, 60.0)
    longest = max(CONFIG.max_gap, 2.5 / rate)
    name = 'force' if kind is ForceRecord else 'gradient'
    for gap, missing in ((longest - 0.6 / rate, False), (longest + 1.4 / rate, True)):
        samples = samples_of(run(without(kind, records, 30.0, 30.0 + gap - 1.0 / rate)))
        unknown = [seconds_of(s.stamp_ns) for s in samples if math.isnan(getattr(s, f'{name}_mean'))]
        assert bool(unknown) is missing
        assert all(29.0 - 1.0 / rate < t < 31.0 + gap + 1.0 / rate for t in unknown)


def test_one_lost_speed_makes_a_longer_step_and_two_end_the_drive() -> None:
    records = drive((1.0, 10.0, 1.0, 50.0), 60.0)
    lost = samples_of(run(without(SpeedRecord, records, 30.0, 31.0)))
    assert sum(1.5 < sample.dt < 2.5 for sample in lost) == 1
    assert not any(math.isnan(sample.dt) for sample in lost)
    ended = samples_of(run(without(SpeedRecord, records, 30.0, 32.0)))
    assert sum(math.isnan(sample.dt) for sample in ended) == 1


@pytest.mark.parametrize('rate', [1.0, 2.0])
def test_a_command_is_known_for_as_long_as_one_may_be_lost(rate: float) -> None:
    records = without(BrakeRecord, drive((5.0, 5.0, 5.0, rate), 60.0), 30.0, 99.0)
    last = max(seconds_of(r.stamp_ns) for r in records if isinstance(r, BrakeRecord))
    unknown = [seconds_of(s.stamp_ns) for s in samples_of(run(records)) if math.isnan(s.brake_command)]
    assert unknown[0] == pytest.approx(last + max(CONFIG.command_timeout, 2.5 / rate), abs=0.4)


def test_a_topic_that_becomes_slow_and_fast_again_is_followed() -> None:
    fast, slow, again = (
        drive(rates, high, low=low)
        for rates, low, high in (
            ((10.0, 10.0, 10.0, 10.0), 0.0, 30.0),
            ((10.0, 1.0, 10.0, 10.0), 30.0, 90.0),
            ((10.0, 10.0, 10.0, 10.0), 90.0, 120.0),
        )
    )
    samples = samples_of(run([*fast, *slow, *again]))
    unknown = [seconds_of(s.stamp_ns) for s in samples if math.isnan(s.force_mean)]
    # 14 intervals of one second, and those not yet passed by samples.
    assert 30.0 <= min(unknown) < 32.0
    assert 42.0 < max(unknown) < 48.0
    assert_complete([s for s in samples if s.stamp_ns > at(48.0)])
    # Once fast again, a gap of a second and a half is a gap.
    broken = samples_of(run(without(ForceRecord, [*fast, *slow, *again], 100.0, 101.5)), 98.0)
    assert any(math.isnan(sample.force_mean) for sample in broken)


def test_the_wait_for_a_slow_topic_is_limited_by_its_rate() -> None:
    aligner = Aligner(CONFIG)
    records = without(ForceRecord, drive((5.0, 1.0, 5.0, 5.0), 60.0), 30.0, 99.0)
    waits = [
        (aligner.newest_ns - event.stamp_ns) / NS_PER_S
        for item in records
        for event in aligner.push(item)
        if isinstance(event, Sample) and event.stamp_ns > at(31.0)
    ]
    assert min(waits) > 2.0
    assert max(waits) < 2.5 * 1.1 + CONFIG.max_lag + 0.3


def test_a_late_record_is_counted_and_leaves_the_rate_unchanged() -> None:
    records = drive((5.0, 1.0, 5.0, 5.0), 60.0)
    k = [i for i, item in enumerate(records) if isinstance(item, ForceRecord)][40]
    late = records.pop(k)
    place = next(i for i, item in enumerate(records) if item.stamp_ns > late.stamp_ns + 1.7 * NS_PER_S)
    events = run([*records[:place], late, *records[place:]])
    assert [event.reason for event in events if isinstance(event, Rejection)] == [Reason.LATE]
    assert_complete(samples_of(events))


def test_a_jump_of_time_forgets_the_rates() -> None:
    rates = (1.0, 1.0, 1.0, 1.0)
    aligner = Aligner(CONFIG)
    for item in drive(rates, 40.0):
        aligner.push(item)
    assert all(aligner.silence_ns(topic) > 2.0 * NS_PER_S for topic in range(4))
    again = drive(rates, 1040.0, low=1000.0)
    jumped = [event for item in again for event in aligner.push(item)]
    assert repr(samples_of(jumped, 1000.0)) == repr(samples_of(run(again), 1000.0))


# Brake commands


def test_a_change_of_a_slow_command_counts_from_the_middle_of_its_interval() -> None:
    records = drive((10.0, 10.0, 10.0, 1.0), 80.0, command=lambda t: -0.2 * (int(t / 3.0) % 2))
    samples = samples_of(run(records), 0.0)
    brakes = [r for r in records if isinstance(r, BrakeRecord)]
    middle = [(a.stamp_ns + b.stamp_ns) / 2.0 for a, b in pairwise(brakes) if a != replace(b, stamp_ns=a.stamp_ns)]
    known = [s for s in samples if s.stamp_ns >= at(LEARNED_S)]
    changes = [change.stamp_ns for s in known for change in s.brake_changes]
    assert changes == pytest.approx([m for m in middle if at(LEARNED_S) < m <= known[-1].stamp_ns], abs=1)
    assert not any(s.brake_gap for s in known)
    # Before the rate is known the same changes count as missed.
    assert any(s.brake_gap for s in samples)
    for before, after in pairwise(known):
        assert all(before.stamp_ns < change.stamp_ns <= after.stamp_ns for change in after.brake_changes)
        if after.brake_changes:
            assert after.brake_command == after.brake_changes[-1].target_acceleration


@pytest.mark.parametrize('rate', [1.0, 2.0])
def test_a_large_change_or_a_lost_record_of_a_slow_command_is_a_brake_gap(rate: float) -> None:
    def gaps(step: float, *, lost_s: float = 0.0) -> int:
        records = drive((5.0, 5.0, 5.0, rate), 60.0, command=lambda t: -step if t > 40.0 else 0.0)
        return sum(s.brake_gap for s in samples_of(run(without(BrakeRecord, records, 40.0, 40.0 + lost_s))))

    # Made half a second sooner or later, a change by 0.2 m/s^2 moves the speed by 0.1 m/s, one by 1.1 m/s^2 by 0.55.
    assert (gaps(0.2), gaps(1.1)) == (0, 1)
    assert gaps(0.2, lost_s=1.0 / rate) == 1
