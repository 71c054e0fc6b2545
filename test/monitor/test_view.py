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


def test_numbers_and_times_are_short() -> None:
    times = {0.0: '0 s', 59.9: '59 s', 60.0: '1:00 min', 3599.0: '59:59 min', 7260.0: '2:01 h'}
    assert {seconds: duration(seconds) for seconds in times} == times
    assert duration(1.62, 1) == '1.6 s'
    assert [number(value) for value in (1.23456, math.nan, -math.inf, 1e12)] == ['1.235', '–', '–', '1.000e+12']
    assert value_text(((72.04, 'km/h', 1), (math.nan, 'm', 0))) == '72.0 km/h'


@pytest.mark.parametrize(
    ('low', 'high', 'shown_kmh'),
    [
        (18.0 / 3.6, 72.0 / 3.6, 45.0),  # the middle, in steps of 5 km/h
        (17.0 / 3.6, 70.0 / 3.6, 45.0),
        (math.nan, math.inf, 50.0),  # ranges that cannot be
        (-math.inf, math.inf, 50.0),
        (5.0, math.nan, 50.0),
        (20.0, 5.0, 50.0),
    ],
)
def test_resistance_is_shown_in_the_middle_of_the_speeds_learned_from(
    low: float, high: float, shown_kmh: float
) -> None:
    assert 3.6 * reference_speed(replace(RESISTANCE, speed_min=low, speed_max=high)) == pytest.approx(shown_kmh)


def test_stds_are_those_of_the_covariance_if_that_can_be() -> None:
    w, std = resistance_at(RESISTANCE, 10.0)
    assert w == pytest.approx(1.6 + 0.2 + 0.1)
    assert std == resistance_std(RESISTANCE.covariance, 10.0)
    for variance in (math.nan, math.inf, 1e308):
        assert math.isnan(resistance_at(replace(RESISTANCE, covariance=(variance,) * 9), 10.0)[1])
    assert math.isnan(mass_factor(replace(MODEL, b1=0.0))[1])
