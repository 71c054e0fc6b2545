# SPDX-License-Identifier: Apache-2.0
"""When ``trainid monitor`` draws and ends; test/ros/test_monitor.py runs it beside nodes."""

from __future__ import annotations

import pytest

from trainid_ros.cli.live import Display


def ended_after(duration_s: float, found_s: float) -> tuple[float, int]:
    """Return when a display ends if a train is found after a time [s], and how often it was drawn."""
    now_s, drawn = 100.0, list[float]()
    display = Display(1.0, duration_s, lambda: drawn.append(now_s), lambda: now_s)
    for k in range(1, 81):
        if display.draw_if_due(has_found=now_s >= 100.0 + found_s):
            break
        now_s = 100.0 + 0.5 * k
    assert display.is_over == (k < 80)
    return now_s - 100.0, len(drawn)


@pytest.mark.parametrize(
    ('duration_s', 'found_s', 'ends_s', 'draws'),
    [
        (1.0, 2.0, 3.0, 4),
        (1.0, 1000.0, 4.0, 5),  # without a train it begins when discovery should be over
        (5.0, 0.0, 5.0, 6),
        (0.0, 0.0, 40.0, 40),  # without a duration it does not end
    ],
)
def test_the_duration_begins_when_a_train_is_found(
    duration_s: float, found_s: float, ends_s: float, draws: int
) -> None:
    assert ended_after(duration_s, found_s) == (ends_s, draws)
