# SPDX-License-Identifier: Apache-2.0
"""The recent history of a quantity."""

from __future__ import annotations

import math

import pytest

from trainid_ros.sim.delay_line import MAX_DELAY_S, DelayLine

STEP_NS = 20_000_000


def test_the_history_is_zero_before_the_first_value() -> None:
    recent = DelayLine()
    assert recent.before(0.0) == 0.0
    recent.add(10**9, 5.0)
    assert (recent.before(0.0), recent.before(-1.0), recent.before(1e-6)) == (5.0, 5.0, 0.0)


def test_values_are_interpolated_between_steps_and_memory_is_bounded() -> None:
    recent = DelayLine()
    for k in range(5000):
        recent.add(10**9 + k * STEP_NS, math.sin(0.02 * k))
        for seconds in (0.0, 0.013, 0.4, MAX_DELAY_S):
            if k * 0.02 >= seconds:
                assert recent.before(seconds) == pytest.approx(math.sin(0.02 * k - seconds), abs=1e-4)
    assert len(recent._stamps) <= 2 * MAX_DELAY_S / 0.02 + 2
