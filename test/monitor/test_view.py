# SPDX-License-Identifier: Apache-2.0
"""Numbers, times and levels as a person reads them, and which value of an estimate is shown."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from test.monitor.conftest import MODEL, RESISTANCE
from trainid_ros.monitor.view import Level, duration, mass_factor, number, reference_speed, resistance_at, value_text
from trainid_ros.resistance.davis_posterior import resistance_std


def test_an_error_is_the_worst_level() -> None:
    assert sorted(Level, key=lambda level: level.severity) == [Level.OK, Level.WARN, Level.STALE, Level.ERROR]


@pytest.mark.parametrize(
    ('seconds', 'shown'), [(0.0, '0 s'), (59.9, '59 s'), (60.0, '1:00 min'), (3599.0, '59:59 min'), (7260.0, '2:01 h')]
)
def test_times_are_short(seconds: float, shown: str) -> None:
    assert duration(seconds) == shown


def test_short_times_may_have_decimals() -> None:
    assert duration(1.62, 1) == '1.6 s'


@pytest.mark.parametrize(
    ('value', 'shown'), [(1.23456, '1.235'), (math.nan, '–'), (-math.inf, '–'), (1e12, '1.000e+12')]
)
def test_numbers_have_a_fixed_count_of_decimals(value: float, shown: str) -> None:
    assert number(value) == shown


@pytest.mark.parametrize('speeds', [(math.nan, math.inf), (-math.inf, math.inf), (5.0, math.nan), (20.0, 5.0)])
def test_a_range_of_speeds_that_cannot_be_counts_as_none(speeds: tuple[float, float]) -> None:
    assert 3.6 * reference_speed(replace(RESISTANCE, speed_min=speeds[0], speed_max=speeds[1])) == pytest.approx(50.0)


@pytest.mark.parametrize('range_kmh', [(18.0, 72.0), (17.0, 70.0)])
def test_resistance_is_shown_in_the_middle_of_the_speeds_in_steps_of_5_kmh(range_kmh: tuple[float, float]) -> None:
    low, high = (speed / 3.6 for speed in range_kmh)
    assert 3.6 * reference_speed(replace(RESISTANCE, speed_min=low, speed_max=high)) == pytest.approx(45.0)


def test_the_std_of_resistance_is_that_of_its_covariance() -> None:
    w, std = resistance_at(RESISTANCE, 10.0)
    assert w == pytest.approx(1.6 + 0.2 + 0.1)
    assert std == resistance_std(RESISTANCE.covariance, 10.0)


@pytest.mark.parametrize('variance', [math.nan, math.inf, 1e308])
def test_a_covariance_that_cannot_be_has_no_std(variance: float) -> None:
    assert math.isnan(resistance_at(replace(RESISTANCE, covariance=(variance,) * 9), 10.0)[1])


def test_a_mass_factor_without_b1_has_no_std() -> None:
    assert math.isnan(mass_factor(replace(MODEL, b1=0.0))[1])


def test_values_that_are_not_known_are_left_out() -> None:
    assert value_text(((72.04, 'km/h', 1), (math.nan, 'm', 0))) == '72.0 km/h'
