# SPDX-License-Identifier: Apache-2.0
"""Detection of missing input by two clocks."""

from __future__ import annotations

import pytest

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.ros.estimate_publisher import Watchdog

LIMIT = 8 * NS_PER_S // 10


def at(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def test_missing_input_is_reported_until_new_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(10.7), at(10.7))
    assert watchdog.is_missing(at(10.9), at(10.9))
    watchdog.saw(1, at(10.95), at(10.95))  # the same stamp again is not new input
    assert watchdog.is_missing(at(12), at(12))
    watchdog.saw(2, at(12), at(12))
    assert not watchdog.is_missing(at(12.1), at(12.1))


def test_input_that_never_came_is_missing_from_the_first_check_on_and_again_after_a_restart() -> None:
    watchdog = Watchdog(LIMIT)
    assert not watchdog.is_missing(at(100), at(100))
    assert not watchdog.is_missing(at(100.7), at(100.7))
    assert watchdog.is_missing(at(100.9), at(100.9))
    watchdog.saw(1, at(101), at(101))
    watchdog.restart()
    assert not watchdog.is_missing(at(200), at(200))
    watchdog.saw(1, at(200), at(200))  # after a restart the old stamp counts as new
    assert watchdog.is_missing(at(201), at(201))


def test_a_short_stall_at_a_high_replay_rate_is_not_missing_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(12), at(10.1))  # 20 times real time, 0.1 s of stall
    assert watchdog.is_missing(at(16), at(10.3))


def test_input_is_not_missing_in_a_slow_replay_while_its_clock_moves() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    for tenth in range(1, 20):
        assert not watchdog.is_missing(at(10 + 0.01 * tenth), at(10 + 0.1 * tenth))


def test_a_stopped_clock_does_not_hide_missing_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    assert not watchdog.is_missing(at(10), at(10.5))
    assert watchdog.is_missing(at(10), at(11.4))


def test_a_clock_that_never_started_does_not_hide_missing_input() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, 0, at(10))
    assert watchdog.is_missing(0, at(10.9))


def test_the_next_check_is_due_when_the_limit_can_be_exceeded_and_not_before() -> None:
    watchdog = Watchdog(LIMIT)
    assert LIMIT < watchdog.pause_ns(at(5), simulated=False) < LIMIT + at(0.1)
    watchdog.saw(1, at(10), at(10))
    pause = watchdog.pause_ns(at(10.3), simulated=False)
    assert not watchdog.is_missing(at(10.3) + pause - at(0.02), at(10.3) + pause - at(0.02))
    assert watchdog.is_missing(at(10.3) + pause, at(10.3) + pause)
    # Once it is missing there is no hurry.
    assert watchdog.pause_ns(at(50), simulated=False) == pytest.approx(LIMIT, abs=at(0.1))
    # Simulated time may run fast, so it is polled often.
    assert watchdog.pause_ns(at(10.3), simulated=True) == at(0.1)


def test_a_longer_limit_applies_from_the_next_check_on() -> None:
    """The rate of slow topics is learned while the node runs."""
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    watchdog.limit_ns = 3 * LIMIT
    assert not watchdog.is_missing(at(10) + 2 * LIMIT, at(10) + 2 * LIMIT)
    assert watchdog.pause_ns(at(10) + 2 * LIMIT, simulated=False) == pytest.approx(LIMIT, abs=at(0.1))
    assert watchdog.is_missing(at(10.1) + 3 * LIMIT, at(10.1) + 3 * LIMIT)
