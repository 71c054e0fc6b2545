# SPDX-License-Identifier: Apache-2.0
"""Gains of speed by errors of dead time and lag, and the update of both to their estimates."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.brake_rate.motion_model import Timing, TimingStep
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.forces import BrakeCommandChange, CommandHistory, lag_integral, lag_response
from trainid_ros.train.train_file import Brake

COMMANDS = CommandHistory((BrakeCommandChange(NS_PER_S, -0.8),))
STEP_NS = NS_PER_S // 5


def integral(delay: float, lag: float, until_s: float) -> float:
    """Return the integral of the lagged target [m/s]."""
    return lag_integral(0.0, -0.8, lag, until_s - 1.0 - delay)


def followed(timing: Timing, seconds: float) -> list[TimingStep]:
    steps = []
    for k in range(round(5.0 * seconds)):
        end_s = 0.2 * (k + 1)
        nominal = integral(timing.delay, timing.lag, end_s) - integral(timing.delay, timing.lag, end_s - 0.2)
        steps.append(timing.step(COMMANDS, k * STEP_NS, (k + 1) * STEP_NS, nominal))
    return steps


def targets(timing: Timing) -> tuple[float, float, float, float]:
    return timing.later, timing.sooner, timing.slower, timing.faster


def test_the_gains_are_the_derivatives_of_the_response() -> None:
    timing = Timing(0.6, 0.4, 0.02, 0.02)
    steps = followed(timing, 3.0)
    h = 1e-3
    delay = (integral(0.6 + h, 0.4, 3.0) - integral(0.6 - h, 0.4, 3.0)) / (2.0 * h)
    lag = (integral(0.6, 0.4 + h, 3.0) - integral(0.6, 0.4 - h, 3.0)) / (2.0 * h)
    assert sum(step.delay_gain for step in steps) == pytest.approx(delay, rel=0.01)
    assert sum(step.lag_gain for step in steps) == pytest.approx(lag, rel=0.01)
    # The gain is the full brake acceleration, for dead time and lag.
    assert delay == pytest.approx(0.8, rel=0.04)
    assert targets(timing) == pytest.approx((-0.8,) * 4, abs=0.03)


def test_a_large_timing_error_adds_variance_while_the_response_changes() -> None:
    stds = ((0.3, 0.2), (0.3, 0.0), (0.0, 0.2))
    variances, of_delay, of_lag = (
        np.array([step.variance for step in followed(Timing(0.6, 0.4, *pair), 5.0)]) for pair in stds
    )
    assert variances == pytest.approx(of_delay + of_lag, rel=1e-9, abs=1e-15)
    assert min(of_delay.max(), of_lag.max()) > 1e-5
    assert variances[:4].max() < 1e-12
    assert variances[4:12].max() > 1e-4
    assert variances[-3:].max() < 1e-5


def test_without_commands_the_gains_are_zero() -> None:
    timing = Timing(0.6, 0.4, 0.1, 0.1)
    step = timing.step(CommandHistory(), 0, STEP_NS, 0.0)
    assert (step.delay_gain, step.lag_gain, step.variance) == (0.0, 0.0, 0.0)
    assert not timing.has_acted
    assert timing.is_idle(CommandHistory(), STEP_NS)
    assert not timing.is_idle(COMMANDS, 2 * NS_PER_S)


def test_the_timing_moves_to_its_estimate_and_stays_valid() -> None:
    moved, low, known = (
        Timing(0.6, 0.4, 0.3, 0.2, has_acted=True),
        Timing(0.6, 0.4, 0.3, 0.2),
        Timing(0.6, 0.4, 0.0, 0.0),
    )
    moved.move((0.15, -0.1), (0.05, 0.5), Brake())
    assert (moved.delay, moved.lag) == pytest.approx((0.75, 0.3))
    assert not moved.has_acted
    assert (moved.delay_std, moved.lag_std) == pytest.approx((0.05, 0.2))
    low.move((-9.0, -9.0), (0.0, 0.0), Brake())
    assert (low.delay, low.lag) == pytest.approx((0.0, 0.1))
    assert min(low.delay_std, low.lag_std) > 0.0
    # A known timing is not estimated.
    known.move((0.0, 0.0), (1.0, 1.0), Brake())
    assert (known.delay_std, known.lag_std) == (0.0, 0.0)


def test_the_four_targets_equal_those_of_four_brakes() -> None:
    timing = Timing(0.6, 0.4, 0.2, 0.1)
    followed(timing, 2.2)
    brakes = ((0.8, 0.4), (0.4, 0.4), (0.6, 0.5), (0.6, 0.3))
    expected = [lag_response(0.0, -0.8, lag, 1.2 - delay) for delay, lag in brakes]
    assert targets(timing) == pytest.approx(expected, rel=1e-6)
