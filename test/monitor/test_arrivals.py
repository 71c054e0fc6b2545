# SPDX-License-Identifier: Apache-2.0
"""Rates and silences from times of arrival."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest

from trainid_ros.monitor.trains import Arrivals


def arrived(times: Iterable[float]) -> Arrivals:
    arrivals = Arrivals()
    for time in times:
        arrivals.add(time)
    return arrivals


def test_the_rate_is_the_count_over_five_seconds() -> None:
    arrivals = arrived(0.2 * k for k in range(50))
    assert arrivals.rate(9.8) == pytest.approx(5.0, rel=0.05)
    assert arrivals.rate(12.3) == pytest.approx(2.5, rel=0.1)  # silent for half of them
    assert arrivals.rate(20.0) == 0.0


def test_bursts_do_not_raise_the_rate() -> None:
    assert arrived(k + 0.001 * j for k in range(10) for j in range(5)).rate(9.5) == pytest.approx(5.0)


def test_a_rate_is_known_soon_and_also_if_it_is_slow_or_fast() -> None:
    assert arrived((0.0, 0.2, 0.4)).rate(0.4) == pytest.approx(5.0)
    assert arrived(6.0 * k for k in range(4)).rate(19.0) == pytest.approx(0.2)
    assert arrived(0.002 * k for k in range(5000)).rate(9.998) == pytest.approx(500.0)


def test_one_message_has_no_rate() -> None:
    assert math.isnan(Arrivals().rate(1.0))
    assert math.isnan(arrived((0.0,)).rate(1.0))


def test_late_is_later_than_usual() -> None:
    assert not Arrivals().is_late(100.0)
    assert [arrived((0.0, 0.2, 0.4)).is_late(0.4 + silent) for silent in (1.3, 1.5)] == [False, True]
    assert [arrived((0.0, 2.0, 4.0)).is_late(4.0 + silent) for silent in (4.9, 5.1)] == [False, True]


def test_silence_is_counted_from_the_last_message() -> None:
    assert math.isinf(Arrivals().silent_s(1.0))
    assert arrived((1.0, 3.0)).silent_s(4.5) == 1.5
