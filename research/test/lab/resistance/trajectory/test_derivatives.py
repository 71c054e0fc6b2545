# SPDX-License-Identifier: Apache-2.0
"""Derivatives of (7) against complex steps and against differences of the exact gradient."""

from __future__ import annotations

import cmath
from typing import Any

import numpy as np

from trainid_lab.resistance.trajectory.stages import STALL_SPEED, Coefficients, Stages, first_derivatives, objective

SCALE = np.array([1.0, 0.02, 0.001])


def complex_step(stages: Stages, x: np.ndarray, k: int) -> np.ndarray:
    a, b, c, v = (complex(value, 1e-30 if i == k else 0.0) for i, value in enumerate(x.tolist()))
    out = []
    for lam, drive in zip(stages.lam.tolist(), stages.drive.tolist(), strict=True):
        v = cmath.sqrt(v * v + 2.0 * lam * (drive - a - v * (b + c * v)))
        out.append(v.imag / 1e-30)
    return np.array(out)


def test_jacobian_is_that_of_a_complex_step(ride: Any) -> None:
    x = np.array([*ride.theta * [1.1, 0.8, 1.05], 18.0])
    v = ride.stages.speeds(x[:3], x[3])
    J = first_derivatives(Coefficients.along(ride.stages, x[:3], v), v)
    for k in range(4):
        right = complex_step(ride.stages, x, k)
        assert np.max(np.abs(J[k] - right)) <= 1e-12 * np.max(np.abs(right))


def test_hessian_is_the_derivative_of_the_gradient(ride: Any) -> None:
    seen = ride.speed[1:] + 0.5 * np.sin(np.arange(ride.speed.size - 1))
    theta = ride.theta * [1.1, 0.8, 1.05]
    H = objective(ride.stages, seen, theta, 17.0).H
    columns = []
    for k in range(3):
        unit = np.where(np.arange(3) == k, SCALE, 0.0) * 1e-4
        g = [objective(ride.stages, seen, theta + n * unit, 17.0).g for n in (-2, -1, 1, 2)]
        columns.append((8.0 * (g[2] - g[1]) - (g[3] - g[0])) / (12.0 * unit[k]))
    size = np.outer(SCALE, SCALE)
    assert np.max(np.abs(H - np.array(columns)) * size) <= 1e-9 * np.max(np.abs(H) * size)


def test_gradient_is_that_of_the_objective(ride: Any) -> None:
    theta = ride.theta * [1.2, 1.0, 0.9]
    at = objective(ride.stages, ride.speed[1:], theta, 17.0)
    for k in range(3):
        unit = np.where(np.arange(3) == k, SCALE, 0.0) * 1e-5
        f = [objective(ride.stages, ride.speed[1:], theta + sign * unit, 17.0).f for sign in (-1.0, 1.0)]
        assert abs((f[1] - f[0]) / (2.0 * unit[k]) / at.g[k] - 1.0) < 1e-6


def test_a_stalled_train_continues_at_the_stall_speed_with_zero_derivatives(ride: Any) -> None:
    theta = np.array([40.0, 0.0, 0.0])
    v = ride.stages.speeds(theta, 17.0)
    assert v.min() == STALL_SPEED
    J = first_derivatives(Coefficients.along(ride.stages, theta, v), v)
    assert np.all(J[:, v[1:] == STALL_SPEED] == 0.0)
