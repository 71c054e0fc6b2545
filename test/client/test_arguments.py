# SPDX-License-Identifier: Apache-2.0
"""Arguments are numbers of any kind, and what is none is named."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from trainid_ros.client.train_model import COMMAND, SPEED, checked_direction, distance_to
from trainid_ros.interface.errors import InputError


@pytest.mark.parametrize('number', [np.float32(3.0), np.float64(3.0), np.int16(3), Fraction(3), 3, 3.0])
def test_any_number_becomes_a_float(number: Any) -> None:
    assert SPEED.checked(number) == 3.0
    assert type(SPEED.checked(number)) is float


@pytest.mark.parametrize('value', [None, '5', '', [5.0], 5.0 + 0.0j, np.array(5.0), object()])
def test_what_is_no_number_is_named(value: Any) -> None:
    with pytest.raises(InputError, match=r'^speed = .* must be a number in m/s$'):
        SPEED.checked(value)


@pytest.mark.parametrize('value', [10**400, -(10**400), math.nan, math.inf, -1.0, 151.0])
def test_what_is_out_of_range_is_named(value: float) -> None:
    with pytest.raises(InputError, match=r'^speed = .* m/s is outside \[0, 150\]$'):
        SPEED.checked(value)


def test_the_ends_of_a_range_are_inside() -> None:
    assert [COMMAND.checked(x) for x in (-20.0, -1e-3)] == [-20.0, -1e-3]


def test_a_distance_is_that_in_the_direction_of_travel() -> None:
    assert [distance_to(100.0, at, way) for at, way in ((60.0, 1), (160.0, -1), (160.0, 1))] == [40.0, 60.0, 0.0]
    with pytest.raises(InputError, match=r'^position = '):
        distance_to(100.0, math.nan, 1)


@pytest.mark.parametrize('direction', [0, 2, -1.5, None, '1'])
def test_a_direction_is_1_or_minus_1(direction: Any) -> None:
    assert [checked_direction(way) for way in (1, -1)] == [1, -1]
    with pytest.raises(InputError, match=r'^direction = .* must be 1 or -1'):
        checked_direction(direction)
