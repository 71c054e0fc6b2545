# SPDX-License-Identifier: Apache-2.0
"""Values move at a bounded rate, the same whenever they are asked for, and their std covers what is left of the way."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from trainid_ros.client.channel import MAX_RATE, Gradual, Normal

FILE = Normal((1.0,), (0.04,))
LIVE = Normal((0.8,), (1e-4,))
PROBES = ((1.0, 0.0), (1.0, 20.0))
DAVIS_FILE = Normal((1.5, 0.02), (0.64, 0.0, 0.0, 4e-4))
DAVIS_LIVE = Normal((2.0, 0.03), (0.01, -4e-4, -4e-4, 2e-5))


def std(normal: Normal, direction: tuple[float, ...] = (1.0,)) -> float:
    return math.sqrt(normal.along(direction)[1])


def test_a_weighted_sum_has_its_mean_and_variance() -> None:
    mean, variance = DAVIS_LIVE.along((1.0, 10.0))
    assert mean == pytest.approx(2.3)
    assert variance == pytest.approx(0.01 - 2 * 10.0 * 4e-4 + 100.0 * 2e-5)


def test_values_and_stds_change_at_most_at_the_stated_rate() -> None:
    values = Gradual(DAVIS_FILE, PROBES)
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


@pytest.mark.parametrize(('start', 'target'), [(FILE, LIVE), (LIVE, FILE), (LIVE, Normal((1.4,), (1e-4,)))])
def test_the_std_covers_what_is_left_of_the_way(start: Normal, target: Normal) -> None:
    values = Gradual(start, ((1.0,),))
    values.go_to(target, 0.0)
    duration = values.left_s(0.0)
    for share in (0.0, 0.01, 0.3, 0.7, 0.99, 1.0):
        now = values.at(share * duration)
        assert std(now) >= 0.999 * math.hypot(target.mean[0] - now.mean[0], std(target))


def test_the_std_at_any_speed_covers_no_more_than_what_is_left() -> None:
    """A learned covariance has other proportions than that of the train file."""
    values = Gradual(DAVIS_LIVE, PROBES)
    values.go_to(DAVIS_FILE, 0.0)
    for probe in ((1.0, 0.0), (1.0, 7.0), (1.0, 15.0), (1.0, 20.0)):
        for share in (0.0, 0.1, 0.5, 0.95):
            now = values.at(share * values.left_s(0.0))
            left = DAVIS_FILE.along(probe)[0] - now.along(probe)[0]
            assert std(now, probe) == pytest.approx(math.hypot(std(DAVIS_FILE, probe), left), rel=1e-6)


def test_the_std_falls_gradually_in_every_direction() -> None:
    values = Gradual(DAVIS_FILE, PROBES)
    values.go_to(DAVIS_LIVE, 0.0)
    for probe in ((1.0, 0.0), (1.0, 7.0), (1.0, 15.0), (0.0, 1.0)):
        assert std(values.at(0.0), probe) >= 0.999999 * std(DAVIS_FILE, probe)


def test_a_value_without_uncertainty_moves_gradually_too() -> None:
    values = Gradual(Normal((1.0,), (0.0,)), ((1.0,),))
    values.go_to(Normal((1.01,), (1e-6,)), 0.0)
    assert values.at(2.0).mean[0] == pytest.approx(1.005)
    assert values.left_s(0.0) == pytest.approx(4.0)


def test_values_do_not_depend_on_when_they_are_asked_for() -> None:
    asked, other = Gradual(FILE, ((1.0,),)), Gradual(FILE, ((1.0,),))
    for values in (asked, other):
        values.go_to(LIVE, 0.0)
    for k in range(30):
        asked.at(0.1 * k)
    assert asked.at(3.0) == other.at(3.0)


def test_repeating_the_same_value_does_not_lengthen_the_way() -> None:
    once, repeated = Gradual(FILE, ((1.0,),)), Gradual(FILE, ((1.0,),))
    once.go_to(LIVE, 0.0)
    for k in range(40):
        repeated.go_to(LIVE, 0.2 * k)
        assert repeated.at(0.2 * k).mean[0] == pytest.approx(once.at(0.2 * k).mean[0], abs=0.02)
    assert repeated.at(8.0) == LIVE


def test_a_move_may_have_a_longest_duration() -> None:
    values = Gradual(LIVE, ((1.0,),))
    values.go_to(Normal((3.0,), (0.04,)), 5.0, 0.2)
    assert values.at(5.2) == Normal((3.0,), (0.04,))


@pytest.mark.parametrize('bad', [((math.nan,), (1.0,)), ((1.0,), (math.inf,)), ((1.0,), (-1.0,)), ((1e9,), (1.0,))])
def test_absurd_numbers_are_not_possible(bad: tuple[tuple[float, ...], tuple[float, ...]]) -> None:
    assert not Normal(*bad).is_possible()
    assert not Normal((1.0, 2.0), (1.0,)).is_possible()
    assert FILE.is_possible()


@pytest.mark.parametrize(
    'bad',
    [
        (1.0, 1.5, 1.5, 1.0),  # a correlation above 1: the difference has a negative variance
        (1.0, 0.5, -0.5, 1.0),
        (0.0, 0.1, 0.1, 1.0),
        (1e-320, 1e-3, 1e-3, 1.0),
        (1.0, -0.9, -0.9, -0.9, 1.0, -0.9, -0.9, -0.9, 1.0),  # each pair alone could be
    ],
)
def test_a_matrix_that_is_no_covariance_is_not_possible(bad: tuple[float, ...]) -> None:
    assert not Normal((0.0,) * round(len(bad) ** 0.5), bad).is_possible()


@pytest.mark.parametrize('good', [(1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0), (4e-9, -2e-6, -2e-6, 1e-3)])
def test_a_covariance_of_parameters_that_are_known_together_is_possible(good: tuple[float, ...]) -> None:
    assert Normal((0.0, 0.0), good).is_possible()
