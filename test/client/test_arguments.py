# SPDX-License-Identifier: Apache-2.0
"""Arguments of the client: numbers that are refused by name, and clocks that go back or stop."""

from __future__ import annotations

import math
import time
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from trainid_ros.client.arguments import (
    ACCELERATION,
    APPLIED,
    COMMAND,
    CONFIDENCE,
    DISTANCE,
    GRADIENT,
    MASS,
    MAX_AGE,
    SPEED,
    STOP,
    Argument,
    ForwardClock,
    checked_direction,
    distance_to,
)
from trainid_ros.interface.errors import InputError


def test_any_number_becomes_a_float() -> None:
    numbers: list[Any] = [np.float32(3.0), np.float64(3.0), np.int16(3), Fraction(3), 3, 3.0]
    found = [SPEED.checked(number) for number in numbers]
    assert (found, {type(x) for x in found}) == ([3.0] * 6, {float})


@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        ([None, '5', '', [5.0], 5.0 + 0.0j, np.array(5.0), object()], 'must be a number in m/s'),
        ([10**400, -(10**400), math.nan, math.inf, -1.0, 151.0], r'm/s is outside \[0, 150\]'),
    ],
)
def test_what_is_no_number_or_out_of_range_is_named(values: list[Any], reason: str) -> None:
    for value in values:
        with pytest.raises(InputError, match=rf'^speed = .* {reason}$'):
            SPEED.checked(value)


# As docs/client_reference.md and the docstrings state them, and what lies outside.
RANGES = {
    SPEED: (0.0, 150.0, -0.1, 150.1),
    GRADIENT: (-500.0, 500.0, -500.1, 500.1),
    ACCELERATION: (-20.0, 20.0, -20.1, 20.1),
    MASS: (1.0, 1e9, 0.9, 1.1e9),
    COMMAND: (-20.0, -1e-3, -20.1, -0.9e-3),
    APPLIED: (-20.0, 0.0, -20.1, 1e-9),
    CONFIDENCE: (0.5, 0.999999, 0.49, 0.9999995),
    MAX_AGE: (0.01, 1e12, 0.009, 1.1e12),
    DISTANCE: (0.0, 1e5, -0.1, 100001.0),
    STOP: (-1e9, 1e9, -1.1e9, 1.1e9),
}


@pytest.mark.parametrize('argument', RANGES, ids=lambda argument: argument.name)
def test_the_ends_of_a_range_are_inside(argument: Argument) -> None:
    low, high, *outside = RANGES[argument]
    assert [argument.checked(x) for x in (low, high)] == [low, high]
    for value in outside:
        with pytest.raises(InputError, match=f'^{argument.name} = '):
            argument.checked(value)


def test_a_distance_is_that_in_the_direction_of_travel() -> None:
    assert [distance_to(100.0, at, way) for at, way in ((60.0, 1), (160.0, -1), (160.0, 1))] == [40.0, 60.0, 0.0]
    wrong: list[Any] = [0, 2, -1.5, None, '1']
    for direction in wrong:
        with pytest.raises(InputError, match=r'^direction = .* must be 1 or -1'):
            checked_direction(direction)


def test_time_goes_on_from_where_the_clock_went_back() -> None:
    readings = iter([79.0, 80.0, 81.0, 5.0, 5.5, 4.0, 6.0, 90.0])
    clock = ForwardClock(lambda: next(readings))
    assert [clock.now() for _ in range(7)] == [80.0, 81.0, 81.0, 81.5, 81.5, 83.5, 167.5]


def test_a_clock_without_a_number_stands_still_and_one_that_has_stopped_goes_on_with_a_steady_one() -> None:
    wrong: Any = None
    readings = iter([5.0, 6.0, math.nan, wrong, 6.5])
    clock = ForwardClock(lambda: next(readings), lambda: 0.0)
    assert [clock.now() for _ in range(4)] == [6.0, 6.0, 6.0, 6.5]
    steady = iter([0.0, 1.0, 2.0, 2.1, 2.2, 4.3])
    clock = ForwardClock(lambda: 100.0, lambda: next(steady), runs=True)
    found = [clock.now() for _ in range(5)]
    assert found == pytest.approx([100.0, 100.0, 102.1, 102.2, 104.3])


def test_a_clock_that_stands_at_a_number_may_wait_but_one_without_a_number_may_not() -> None:
    readings, steady = iter([5.0, 5.0, math.nan, math.nan, 5.5]), iter([0.0, 60.0, 61.0, 65.0, 66.0])
    clock = ForwardClock(lambda: next(readings), lambda: next(steady))
    assert [clock.now() for _ in range(4)] == [5.0, 5.0, 10.0, 10.5]


@pytest.mark.parametrize('wrong', [None, 5.0, time, 'now', math.nan])
def test_a_clock_that_is_no_function_or_returns_no_number_is_named(wrong: Any) -> None:
    with pytest.raises(InputError, match=r'^clock = .* must be a function'):
        ForwardClock(wrong)
    if wrong != 5.0:
        with pytest.raises(InputError, match=r'^clock\(\) = '):
            ForwardClock(lambda: wrong)
