# SPDX-License-Identifier: Apache-2.0
"""Silence is told once, by simulated time and also while that stands still."""

from __future__ import annotations

import pytest

from trainid_ros.core.records import NS_PER_S
from trainid_ros.ros.watchdog import Watchdog

LIMIT = 8 * NS_PER_S // 10


def at(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def test_silence_is_told_once_and_again_after_news() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(10.7), at(10.7))
    assert watchdog.is_missing(at(10.9), at(10.9))
    watchdog.saw(1, at(10.95), at(10.95))  # the same stamp again is no news
    assert not watchdog.is_missing(at(12), at(12))
    watchdog.saw(2, at(12), at(12))
    assert not watchdog.is_missing(at(12.1), at(12.1))


def test_nothing_is_told_before_the_first_record_and_after_a_restart() -> None:
    watchdog = Watchdog(LIMIT)
    assert not watchdog.is_missing(at(100), at(100))  # never heard of any record
    watchdog.saw(1, at(100), at(100))
    watchdog.restart()
    assert not watchdog.is_missing(at(200), at(200))
    watchdog.saw(1, at(200), at(200))  # after a restart the old stamp is news
    assert watchdog.is_missing(at(201), at(201))


def test_a_short_stall_at_a_high_replay_rate_is_no_silence() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(12), at(10.1))  # 20 times real time, 0.1 s of stall
    assert watchdog.is_missing(at(16), at(10.3))


def test_a_slow_replay_is_not_silent_while_its_clock_moves() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    for tenth in range(1, 20):
        assert not watchdog.is_missing(at(10 + 0.01 * tenth), at(10 + 0.1 * tenth))


def test_a_clock_that_stops_does_not_hide_silence() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(10), at(10.5))
    assert watchdog.is_missing(at(10), at(11.4))


def test_a_clock_that_never_came_does_not_hide_silence() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, 0, at(10))
    assert watchdog.is_missing(0, at(10.9))


def test_the_next_look_comes_when_silence_can_be_too_long_and_not_before() -> None:
    watchdog = Watchdog(LIMIT)
    assert LIMIT < watchdog.pause_ns(at(5), simulated=False) < LIMIT + at(0.1)
    watchdog.saw(1, at(10), at(10))
    pause = watchdog.pause_ns(at(10.3), simulated=False)
    assert not watchdog.is_missing(at(10.3) + pause - at(0.02), at(10.3) + pause - at(0.02))
    assert watchdog.is_missing(at(10.3) + pause, at(10.3) + pause)
    # Simulated time may run fast, so it is looked at often.
    assert watchdog.pause_ns(at(10.3), simulated=True) == at(0.1)


def test_a_longer_limit_holds_from_the_next_look_on() -> None:
    """Slow topics are learned while the node runs."""
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    watchdog.limit_ns = 3 * LIMIT
    assert not watchdog.is_missing(at(10) + 2 * LIMIT, at(10) + 2 * LIMIT)
    assert watchdog.pause_ns(at(10) + 2 * LIMIT, simulated=False) == pytest.approx(LIMIT, abs=at(0.1))
    assert watchdog.is_missing(at(10.1) + 3 * LIMIT, at(10.1) + 3 * LIMIT)
