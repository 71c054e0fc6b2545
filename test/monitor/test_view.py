# SPDX-License-Identifier: Apache-2.0
"""Numbers, times and levels as a person reads them."""

from __future__ import annotations

import math

import pytest

from trainid_ros.monitor.view import Level, duration, number


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
