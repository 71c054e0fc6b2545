# SPDX-License-Identifier: Apache-2.0
"""Which estimates are used, how fast their values move, and how soon the train file replaces them."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from trainid_ros.client.live_estimate import (
    FALL_BACK_S,
    MAX_AGE_S,
    MAX_RATE,
    LiveEstimate,
    Normal,
    Parameter,
    RateLimitedValue,
)
from trainid_ros.interface.results import Status

FILE = Normal((1.0,), (0.04,))
LEARNED = Normal((0.8,), (1e-4,))
LIVE = {'rate': LEARNED}
UNSURE = {'rate': Normal((0.3,), (0.04,))}


SUSPECTED = 'CONVERGING, the last valid value as uncertain as that of the train file'
SILENT = 'train file: no new estimate for more than 0.75 s'


def rate(value: float, variance: float = 1e-4) -> dict[str, Normal]:
    return {'rate': Normal((value,), (variance,))}


def estimate(until_s: float = 0.0) -> LiveEstimate:
    """Return an estimate that has had a VALID estimate at 5 Hz from 0 s until a time."""
    out = LiveEstimate({'rate': Parameter(FILE, ((1.0,),), 0.01, 10.0)}, MAX_AGE_S)
    for k in range(round(until_s / 0.2) + 1 if until_s else 0):
        out.take(Status.VALID, LIVE, 0.2 * k)
    return out


def test_the_train_file_applies_until_an_estimate_comes_which_is_approached_and_then_followed() -> None:
    new = estimate()
    new.go_on(5.0)
    assert (new.normal('rate'), new.state()) == (FILE, (False, 'train file: no estimate yet'))
    new.take(Status.CONVERGING, LIVE, 5.0)
    new.go_on(5.5)
    assert (new.normal('rate'), new.state()) == (FILE, (False, 'train file: CONVERGING, not fit to use'))
    one = estimate(1.0)
    assert 0.8 < one.normal('rate').mean[0] < 1.0
    assert one.state() == (True, 'VALID, moving to the live value')
    one = estimate(10.0)
    assert (one.normal('rate'), one.state()) == (LEARNED, (True, 'VALID'))
    one.take(Status.HOLDING, LIVE, 10.2)
    assert one.state() == (True, 'HOLDING')


@pytest.mark.parametrize(
    ('status', 'values', 'said'),
    [
        (Status.UNINITIALIZED, LIVE, 'UNINITIALIZED, the node has no sample yet'),
        (Status.STALE, LIVE, 'STALE, inputs of the node are missing'),
        (Status.FAULT, LIVE, 'FAULT, the node has failed'),
        (Status.VALID, rate(math.nan), 'rate = nan with a std of 0.01 is not possible'),
        (Status.VALID, rate(math.inf), 'rate = inf with a std of 0.01 is not possible'),
        (Status.VALID, rate(1e300), 'rate = 1e+300 with a std of 0.01 is not possible'),
        (Status.VALID, rate(50.0), 'rate = 50 with a std of 0.01 is not possible'),
        (Status.VALID, rate(1e-4), 'rate = 0.0001 with a std of 0.01 is not possible'),
        (Status.VALID, rate(0.9, -1.0), 'rate = 0.9 with a std of -1 is not possible'),
        (Status.VALID, rate(0.9, math.nan), 'rate = 0.9 with a std of nan is not possible'),
    ],
)
def test_what_is_not_fit_to_use_brings_the_train_file_back(
    status: Status, values: dict[str, Normal], said: str
) -> None:
    one = estimate(10.0)
    one.take(status, values, 10.2)
    assert one.state() == (False, f'train file: {said}')
    one.go_on(10.2 + FALL_BACK_S)
    assert one.normal('rate') == FILE


def test_a_suspected_estimate_stands_with_the_uncertainty_of_the_train_file() -> None:
    one = estimate(10.0)
    for k in range(1, 4):
        one.take(Status.CONVERGING, UNSURE, 10.0 + 0.2 * k)
    assert one.state() == (True, SUSPECTED)
    assert one.normal('rate') == Normal((0.8,), FILE.covariance)
    one.take(Status.VALID, LIVE, 10.8)
    assert one.state() == (True, 'VALID, moving to the live value')
    one.take(Status.CONVERGING, LIVE, 11.0)
    one.take(Status.STALE, LIVE, 11.2)
    one.go_on(11.2 + FALL_BACK_S)
    assert one.normal('rate') == FILE


def test_a_suspicion_on_the_way_to_a_live_value_does_not_hasten_it() -> None:
    one = estimate(1.0)
    values, stds = [], []
    for k in range(1, 40):
        if k % 4 == 1:
            one.take(Status.CONVERGING, LIVE, 1.0 + 0.05 * k)
        one.go_on(1.0 + 0.05 * k)
        now = one.normal('rate')
        values.append(now.mean[0])
        stds.append(math.sqrt(now.covariance[0]))
    steps = [after - value for value, after in pairwise(values)]
    assert all(-1.001 * MAX_RATE * 0.05 * 0.2 <= step <= 0.0 for step in steps)
    assert values[-1] < values[0] - 0.05
    assert min(stds) >= 0.2


@pytest.mark.parametrize('suspected_first', [False, True])
def test_a_late_joiner_gets_the_last_valid_value_whatever_came_first(*, suspected_first: bool) -> None:
    one = estimate()
    if suspected_first:
        one.take(Status.CONVERGING, UNSURE, 0.0)
        assert not one.is_live
    one.take_latched(Status.VALID, LIVE, 0.01)
    one.take(Status.CONVERGING, UNSURE, 0.02)
    assert one.state() == (True, SUSPECTED)
    for k in range(1, 30):
        one.take(Status.CONVERGING, UNSURE, 0.2 * k)
    assert one.normal('rate') == Normal((0.8,), FILE.covariance)


@pytest.mark.parametrize('status', [Status.VALID, Status.STALE, Status.FAULT])
def test_a_latched_estimate_does_not_count_beside_what_was_heard(status: Status) -> None:
    one, other = estimate(), estimate()
    for item in (one, other):
        item.take(status, LIVE, 0.0)
    assert not one.take_latched(Status.VALID, rate(0.5), 0.1)
    one.go_on(20.0)
    other.go_on(20.0)
    assert (one.state(), one.normal('rate')) == (other.state(), other.normal('rate'))


def test_the_small_moves_of_each_estimate_are_not_said() -> None:
    one = estimate(10.0)
    for k in range(1, 30):
        one.take(Status.VALID, rate(0.8 + 0.02 * (k % 2)), 10.0 + 0.2 * k)
        assert one.state() == (True, 'VALID')
    one.take(Status.VALID, rate(1.0), 16.0)
    said = []
    for k in range(1, 30):
        one.take(Status.VALID, rate(1.0 - 0.02 * (k % 2)), 16.0 + 0.2 * k)
        said.append(one.state()[1])
    assert said == sorted(said, reverse=True)  # moving first, then VALID, once
    assert {said[0], said[-1]} == {'VALID, moving to the live value', 'VALID'}


@pytest.mark.parametrize('asked_at', [(10.7, 10.8, 10.85), (10.85,)])
def test_silence_brings_the_train_file_back_whenever_it_is_asked_for(asked_at: tuple[float, ...]) -> None:
    one = estimate(10.0)
    for time_s in asked_at:
        one.go_on(time_s)
    assert one.state() == (False, SILENT)
    assert one.normal('rate').mean[0] == pytest.approx(0.8 + 0.2 * 0.5)
    one.go_on(10.0 + MAX_AGE_S + FALL_BACK_S)
    assert one.normal('rate') == FILE
    assert MAX_AGE_S + FALL_BACK_S <= 1.0


def test_an_estimate_may_be_used_until_it_is_older_than_allowed() -> None:
    one = estimate(10.0)
    one.go_on(10.0 + MAX_AGE_S)
    assert one.is_live
    one.go_on(10.0 + MAX_AGE_S + 1e-6)
    assert not one.is_live


@pytest.mark.parametrize('lost_s', [10.1, 20.0])  # before and after the silence is noticed
def test_a_node_that_is_gone_brings_the_train_file_back_until_the_next_estimate(lost_s: float) -> None:
    one = estimate(10.0)
    one.mark_lost('its node is gone', lost_s)
    one.go_on(lost_s + 0.9)
    assert (one.normal('rate'), one.state()) == (FILE, (False, 'train file: its node is gone'))
    one.take(Status.VALID, LIVE, 22.0)
    assert (one.is_live, one.normal('rate').mean) == (True, FILE.mean)
    # A lost publisher does not end what another one sends.
    one.mark_lost('its node is gone', 22.1)
    assert one.state()[1].startswith('VALID')
    one.take(Status.VALID, LIVE, 22.2)
    one.go_on(23.5)
    assert one.state() == (False, SILENT)


def test_a_step_of_a_live_value_is_gradual_too() -> None:
    one = estimate(10.0)
    one.take(Status.VALID, rate(0.6), 10.2)
    now = one.normal('rate')
    assert now.mean == (0.8,)
    assert math.sqrt(now.covariance[0]) == pytest.approx(math.hypot(0.2, 0.01))


def test_a_clock_that_goes_back_stands_still() -> None:
    one = estimate(10.0)
    one.go_on(9.0)
    assert one.normal('rate') == LEARNED
    assert one.is_heard(10.0)
    assert not one.is_heard(10.0 + MAX_AGE_S + 0.1)


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_a_present_estimate_far_away_refutes_the_last_valid_value(side: float) -> None:
    one = estimate(10.0)
    one.take(Status.CONVERGING, rate(0.8 + side * 0.029), 10.2)
    assert one.state() == (True, SUSPECTED)
    for k in range(1, 5):
        one.take(Status.CONVERGING, rate(0.8 + side * 0.031), 10.2 + 0.2 * k)
        assert one.state() == (False, 'train file: CONVERGING, the present estimate refutes the last valid value')
    assert one.normal('rate') == FILE
    one.take(Status.VALID, rate(0.83), 11.2)
    assert one.state() == (True, 'VALID, moving to the live value')
    one.go_on(11.2 + MAX_AGE_S)
    assert 1.0 - MAX_RATE * MAX_AGE_S * 0.2 <= one.normal('rate').mean[0] < 0.98


@pytest.mark.parametrize('variance', [-1e-4, math.nan, math.inf])
def test_an_impossible_estimate_refutes_nothing(variance: float) -> None:
    one = estimate(10.0)
    one.take(Status.CONVERGING, rate(0.3, variance), 10.2)
    assert one.is_live


def test_a_resistance_is_refuted_at_any_speed_of_its_probes() -> None:
    valid, file = Normal((1.0, 0.05), (0.01, 0.0, 0.0, 1e-4)), Normal((1.0, 0.1), (1.0, 0.0, 0.0, 0.01))
    for b, is_live in ((0.07, True), (0.1, False)):  # at 20 m/s, 0.4 and 1.0 N/kN from the valid value, std 0.22
        one = LiveEstimate({'w': Parameter(file, ((1.0, 0.0), (1.0, 20.0)))}, MAX_AGE_S)
        one.take(Status.VALID, {'w': valid}, 0.0)
        one.take(Status.CONVERGING, {'w': Normal((1.0, b), (0.01, 0.0, 0.0, 1e-4))}, 0.2)
        assert one.is_live is is_live


@pytest.mark.parametrize('status', [Status.VALID, Status.CONVERGING])
def test_a_repeated_stamp_is_no_news(status: Status) -> None:
    one = estimate()
    one.take_new(Status.VALID, LIVE, 0.0, stamp_ns=7)
    one.take_new(status, LIVE, 0.2, stamp_ns=7)  # a suspicion says that the last must not be used any more
    assert one.state()[1].startswith(status.name)
    for k in range(2, 20):
        one.take_new(status, LIVE, 0.2 * k, stamp_ns=7)
    one.go_on(3.9)
    assert one.state() == (False, SILENT)
    one.take_new(Status.VALID, LIVE, 4.0, stamp_ns=8)
    assert one.is_live
    one.take_new(Status.FAULT, LIVE, 4.1, stamp_ns=8)
    assert one.state() == (False, 'train file: FAULT, the node has failed')


def test_two_stamps_in_turn_are_no_news() -> None:
    one = estimate()
    for k in range(20):
        one.take_new(Status.VALID, LIVE, 0.2 * k, stamp_ns=7 + k % 2)
    one.go_on(4.0)
    assert one.state() == (False, SILENT)


def test_older_stamps_between_newer_ones_are_no_news() -> None:
    one = estimate()
    for k in range(20):
        one.take_new(Status.VALID, LIVE, 0.2 * k, stamp_ns=10**12 + 200_000_000 * k)
        one.take_new(Status.VALID, rate(0.5), 0.2 * k + 0.1, stamp_ns=200_000_000 * k)
    assert one.is_live
    assert one.normal('rate').mean[0] > 0.79


def test_stamps_that_start_again_are_news_once_they_have_risen_for_the_allowed_age() -> None:
    one = estimate()
    one.take_new(Status.VALID, LIVE, 0.0, stamp_ns=10**12)
    lives = []
    for k in range(1, 9):
        one.take_new(Status.VALID, LIVE, 0.2 * k, stamp_ns=200_000_000 * k)
        one.go_on(0.2 * k)
        lives.append(one.is_live)
    assert lives == [True] * 3 + [False] + [True] * 4  # 0.75 s after the last one, and 0.8 s of rising stamps


@pytest.mark.parametrize(
    ('value', 'variance', 'said'),
    [
        (2.1, 0.01, 'train file: rate: more than 5 standard deviations of the train file from its value'),
        (0.8, 3.9e-6, 'train file: rate: a std below 1% of that of the train file is not credible'),
        (1.9, 4.1e-6, ''),
    ],
)
def test_an_estimate_that_is_not_credible_beside_the_train_file_is_not_used(
    value: float, variance: float, said: str
) -> None:
    one = estimate()
    one.take(Status.VALID, rate(value, variance), 0.0)
    one.go_on(0.1)
    assert (one.is_live, one.state()[1]) == (not said, said or 'VALID, moving to the live value')


def test_a_refused_estimate_brings_the_train_file_back_at_once() -> None:
    one = estimate(10.0)
    one.refuse('two publishers', 10.1)
    one.go_on(10.1 + FALL_BACK_S)
    assert (one.normal('rate').mean, one.state()) == (FILE.mean, (False, 'train file: two publishers'))
    one.take(Status.VALID, LIVE, 10.4)
    assert one.is_live


def test_copies_for_late_joiners_do_not_replace_what_is_refused_or_does_not_come() -> None:
    one = estimate()
    one.take_new(Status.CONVERGING, UNSURE, 0.0, stamp_ns=1)
    one.refuse('two publishers', 0.2)
    assert not one.take_latched(Status.VALID, LIVE, 0.3)
    assert one.state() == (False, 'train file: two publishers')
    new = estimate()
    assert [new.take_latched(Status.VALID, LIVE, 0.2 * k) for k in range(8)] == [True, *[False] * 7]
    new.go_on(1.4)
    assert new.state() == (False, SILENT)
    new.take_new(Status.CONVERGING, LIVE, 1.5, stamp_ns=1)
    assert new.take_latched(Status.VALID, LIVE, 1.6)


def test_on_the_way_to_the_train_file_no_bound_is_beyond_both() -> None:
    one = estimate(10.0)
    one.take(Status.STALE, LIVE, 10.2)
    bounds = []
    for k in range(11):
        one.go_on(10.2 + 0.1 * FALL_BACK_S * k)
        normal = one.normal('rate')
        bounds.append(normal.mean[0] - 1.645 * math.sqrt(normal.covariance[0]))
    assert one.normal('rate') == FILE
    assert min(bounds) > bounds[-1] - 0.02


PROBES = ((1.0, 0.0), (1.0, 20.0))
DAVIS_FILE = Normal((1.5, 0.02), (0.64, 0.0, 0.0, 4e-4))
DAVIS_LIVE = Normal((2.0, 0.03), (0.01, -4e-4, -4e-4, 2e-5))


def std(normal: Normal, direction: tuple[float, ...] = (1.0,)) -> float:
    return math.sqrt(normal.along(direction)[1])


def test_a_weighted_sum_has_its_mean_and_variance() -> None:
    assert DAVIS_LIVE.along((1.0, 10.0)) == pytest.approx((2.3, 0.01 - 2 * 10.0 * 4e-4 + 100.0 * 2e-5))


def test_values_and_stds_change_at_most_at_the_stated_rate() -> None:
    values = RateLimitedValue(DAVIS_FILE, PROBES)
    values.go_to(DAVIS_LIVE, 10.0)
    dt, end = 0.05, 10.0 + values.left_s(10.0)
    assert 2.0 < end - 10.0 < 6.0
    times = [10.0 + dt * k for k in range(round((end - 10.0) / dt) + 2)]
    for probe in PROBES:
        limit = 1.001 * MAX_RATE * dt * std(DAVIS_FILE, probe)
        steps = [values.at(t) for t in times]
        for before, after in pairwise(steps):
            assert abs(after.along(probe)[0] - before.along(probe)[0]) <= limit
            assert abs(std(after, probe) - std(before, probe)) <= 2.0 * limit
    assert values.at(end) == DAVIS_LIVE


@pytest.mark.parametrize(('start', 'target'), [(FILE, LEARNED), (LEARNED, FILE), (LEARNED, Normal((1.4,), (1e-4,)))])
def test_the_std_covers_what_is_left_of_the_way(start: Normal, target: Normal) -> None:
    values = RateLimitedValue(start, ((1.0,),))
    values.go_to(target, 0.0)
    duration = values.left_s(0.0)
    for share in (0.0, 0.01, 0.3, 0.7, 0.99, 1.0):
        now = values.at(share * duration)
        assert std(now) >= 0.999 * math.hypot(target.mean[0] - now.mean[0], std(target))


def test_the_std_at_any_speed_covers_no_more_than_what_is_left() -> None:
    """A learned covariance has other proportions than that of the train file."""
    values = RateLimitedValue(DAVIS_LIVE, PROBES)
    values.go_to(DAVIS_FILE, 0.0)
    for probe in ((1.0, 0.0), (1.0, 7.0), (1.0, 15.0), (1.0, 20.0)):
        for share in (0.0, 0.1, 0.5, 0.95):
            now = values.at(share * values.left_s(0.0))
            left = DAVIS_FILE.along(probe)[0] - now.along(probe)[0]
            assert std(now, probe) == pytest.approx(math.hypot(std(DAVIS_FILE, probe), left), rel=1e-6)


def test_the_std_falls_gradually_in_every_direction() -> None:
    values = RateLimitedValue(DAVIS_FILE, PROBES)
    values.go_to(DAVIS_LIVE, 0.0)
    for probe in ((1.0, 0.0), (1.0, 7.0), (1.0, 15.0), (0.0, 1.0)):
        assert std(values.at(0.0), probe) >= 0.999999 * std(DAVIS_FILE, probe)


def test_a_value_without_uncertainty_moves_gradually_too() -> None:
    values = RateLimitedValue(Normal((1.0,), (0.0,)), ((1.0,),))
    values.go_to(Normal((1.01,), (1e-6,)), 0.0)
    assert values.at(2.0).mean[0] == pytest.approx(1.005)
    assert values.left_s(0.0) == pytest.approx(4.0)


def test_a_move_starts_at_the_present_value_also_where_the_clock_is_coarse() -> None:
    """At such times a clock in seconds has steps of 0.06 ms."""
    values, begin_s = RateLimitedValue(LEARNED, ((1.0,),)), 3e11
    values.go_to(FILE, begin_s, FALL_BACK_S)
    assert values.left_s(begin_s) > FALL_BACK_S
    assert values.at(begin_s).mean[0] == pytest.approx(LEARNED.mean[0], abs=1e-12)


def test_repeating_the_same_value_does_not_lengthen_the_way() -> None:
    once, repeated = RateLimitedValue(FILE, ((1.0,),)), RateLimitedValue(FILE, ((1.0,),))
    once.go_to(LEARNED, 0.0)
    for k in range(40):
        repeated.go_to(LEARNED, 0.2 * k)
        assert repeated.at(0.2 * k).mean[0] == pytest.approx(once.at(0.2 * k).mean[0], abs=0.02)
    assert repeated.at(8.0) == LEARNED


@pytest.mark.parametrize(
    ('covariance', 'is_possible'),
    [
        ((math.inf,), False),
        ((-1.0,), False),
        ((1.0, 2.0), False),
        ((1.0, 1.0, 1.0, 1.0), True),  # known together
        ((0.0, 0.0, 0.0, 0.0), True),
        ((4e-9, -2e-6, -2e-6, 1e-3), True),
        ((1.0, 1.5, 1.5, 1.0), False),  # a correlation above 1: the difference has a negative variance
        ((1.0, 0.5, -0.5, 1.0), False),
        ((0.0, 0.1, 0.1, 1.0), False),
        ((1e-320, 1e-3, 1e-3, 1.0), False),
        ((1.0, -0.9, -0.9, -0.9, 1.0, -0.9, -0.9, -0.9, 1.0), False),  # each pair alone could be
    ],
)
def test_a_matrix_that_is_no_covariance_is_not_possible(covariance: tuple[float, ...], is_possible: bool) -> None:
    assert Normal((0.0,) * round(len(covariance) ** 0.5), covariance).is_possible() is is_possible


def test_absurd_numbers_are_not_possible() -> None:
    assert not any(Normal((mean,), (1.0,)).is_possible() for mean in (math.nan, 1e9))
    assert Parameter(FILE, ((1.0,),), 0.01, 10.0).problem('rate', FILE) == ''


@pytest.mark.parametrize(('correlation', 'is_possible'), [(-0.49, True), (-0.51, False)])
def test_parameters_of_small_and_large_units_are_judged_alike(correlation: float, is_possible: bool) -> None:
    """Three parameters cannot all be correlated below -1/2 with each other."""
    stds = (1e-4, 1.0, 1e2)
    P = tuple(a * b * (1.0 if i == k else correlation) for i, a in enumerate(stds) for k, b in enumerate(stds))
    assert Normal((0.0, 0.0, 0.0), P).is_possible() is is_possible
