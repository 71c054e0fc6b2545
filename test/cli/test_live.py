# SPDX-License-Identifier: Apache-2.0
"""When ``trainid monitor`` draws and ends; test/ros/test_monitor.py runs it beside nodes."""

from __future__ import annotations

from trainid_ros.cli.live import Display


class Clock:
    """A clock that is set."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def ended_after(duration_s: float, found_s: float) -> tuple[float, int]:
    """Return when a display ends if a train is found after a time [s], and how often it was drawn."""
    clock, drawn = Clock(), list[float]()
    display = Display(1.0, duration_s, lambda: drawn.append(clock.now_s), clock)
    for k in range(1, 81):
        if display.draw_if_due(has_found=clock.now_s >= 100.0 + found_s):
            break
        clock.now_s = 100.0 + 0.5 * k
    assert display.is_over == (k < 80)
    return clock.now_s - 100.0, len(drawn)


def test_the_duration_begins_when_a_train_is_found() -> None:
    assert ended_after(1.0, found_s=2.0)[0] == 3.0


def test_without_a_train_the_duration_begins_when_discovery_should_be_over() -> None:
    assert ended_after(1.0, found_s=1000.0)[0] == 4.0


def test_it_draws_at_its_interval() -> None:
    assert ended_after(5.0, found_s=0.0) == (5.0, 6)


def test_without_a_duration_it_does_not_end() -> None:
    assert ended_after(0.0, found_s=0.0)[0] == 40.0
