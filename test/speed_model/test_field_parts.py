# SPDX-License-Identifier: Apache-2.0
"""Estimates of the speed model other than theta: force delay, disturbance strength, error of the curve resistance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.speed_model.curve_share import CurveShare
from trainid_ros.speed_model.disturbance_observer import Disturbance
from trainid_ros.speed_model.force_delay import ForceDelay
from trainid_ros.speed_model.recent_values import RecentValues


def test_a_past_value_is_interpolated_and_limited_to_the_oldest() -> None:
    recent = RecentValues().add(1.0, math.nan).add(2.0, 0.2).add(4.0, 0.2)
    assert [recent.before(t) for t in (-1.0, 0.0, 0.1, 0.2, 0.3, 9.0)] == pytest.approx([4.0, 4.0, 3.0, 2.0, 1.5, 1.0])
    assert recent.add(7.0, math.nan).before(0.3) == 7.0


def test_changes_of_the_force_reveal_its_delay() -> None:
    rng, late = np.random.default_rng(1), ForceDelay.unknown(0.15)
    for _ in range(50):
        late = late.anchored().changed(0.9)
        error = 0.9 * (0.2 - late.delay) + 0.03 * float(rng.standard_normal())
        late = late.learn(error, 0.03**2 + late.gain**2 * late.variance, 0.03**2)
    assert late.delay == pytest.approx(0.2, abs=0.02)
    assert math.sqrt(late.variance) < 0.01


@pytest.mark.parametrize('density', [1e-5, 4e-4])
def test_the_strength_of_a_disturbance_is_estimated(density: float) -> None:
    rng, disturbance = np.random.default_rng(2), Disturbance.declared(0.006)
    for _ in range(9000):
        disturbance = disturbance.add(float(rng.normal(0.0, math.sqrt(0.2 * density))), (0.0,), (1.0,), 0.2, 0.0)
    assert disturbance.density == pytest.approx(density, rel=0.6)


def test_window_errors_of_one_sign_indicate_a_change() -> None:
    disturbance = Disturbance.declared(0.01)
    for _ in range(450):
        disturbance = disturbance.add(0.0015, (0.0,), (1.0,), 0.2, 0.0)
    assert disturbance.chi2 > 9.0


def test_the_curve_error_is_estimated_as_by_a_kalman_filter() -> None:
    """For x and the error only: a matrix Kalman filter with two states."""
    numbers, curve = (10.0, 0.0, 1.0, 0.0, 0.0, 1e-2, *[0.0] * 14), CurveShare(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04)
    P, R, change = np.diag([1e-2, 0.04]), 4e-4, -0.05
    F = np.array([[1.0, change], [0.0, 1.0]])
    numbers, curve = curve.push(numbers, change)
    curve = curve.step(numbers[0], numbers[1:5], 0.0, 1.0)
    P = F @ P @ F.T
    assert (numbers[5], curve.x) == pytest.approx((P[0, 0], P[0, 1]))
    S, error = P[0, 0] + R, 0.03
    corrected = (*numbers[:5], numbers[5] * R / S, *numbers[6:])
    after = curve.learn(corrected, error, S, R)
    K = P[:, 0] / S
    expected = P - np.outer(K, P[0])
    assert (after.error, after.x, after.variance) == pytest.approx((K[1] * error, expected[0, 1], expected[1, 1]))
