# SPDX-License-Identifier: Apache-2.0
"""Equations and methods of Xia et al. 2023 as printed, including errors, for comparison with the corrected ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from research.papers.highspeed_line import INERTIA
from trainid_lab.resistance.trajectory.derivatives import PAIRS, Objective, assemble, first_derivatives
from trainid_lab.resistance.trajectory.stages import Coefficients, Stages
from trainid_ros.resistance.davis_fit import recur

if TYPE_CHECKING:
    from numpy.typing import NDArray


def printed_objective(
    stages: Stages, measured: NDArray[np.float64], theta: NDArray[np.float64], start: float
) -> Objective:
    """Return (8), (11), (16) with dv/da on the right of (14) and the flipped sign of q in (18)-(23)."""
    v = stages.speeds(theta, start)
    coefficients = Coefficients.along(stages, theta, v)
    first = first_derivatives(coefficients, v)[:3]
    last = np.concatenate((np.zeros((3, 1)), first[:, :-1]), axis=1)
    first[1] = coefficients.k * last[0] - coefficients.p * v[:-1]  # (14) as printed
    last[1, 1:] = first[1, :-1]
    powers = v[:-1] ** np.arange(3)[:, None]
    slope = np.vstack((np.zeros_like(powers[0]), powers[0], 2.0 * powers[1]))
    rows = [
        -coefficients.q * last[x] * last[y]
        - coefficients.u * first[x] * first[y]
        - coefficients.p * (slope[y] * last[x] + slope[x] * last[y])
        for x, y in PAIRS
    ]
    return assemble(v[1:] - measured, first, recur(coefficients.k, np.array(rows)))


def full_steps(
    stages: Stages, measured: NDArray[np.float64], theta: NDArray[np.float64], accepted: float, most: int = 50
) -> tuple[NDArray[np.float64], float, int]:
    """Run Gauss-Newton with full steps, no box, v_0 as measured, ended by (25); explains the published iterations."""
    f = np.inf
    for n in range(most):
        v = stages.speeds(theta, float(measured[0]))
        error = measured[1:] - v[1:]
        f = float(error @ error) / error.size
        if f < accepted or not np.max(v) < 1e3:
            return theta, f, n
        first = first_derivatives(Coefficients.along(stages, theta, v), v)[:3]
        scale = np.array([1.0, 0.02, 0.001])
        theta = theta + scale * np.linalg.lstsq(first.T * scale, error)[0]
        theta = np.clip(theta, -1e3, 1e3)
    return theta, f, most


def differenced_least_squares(stages: Stages, measured: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Return a, b, c of (2): resistance from speed differences."""
    slope = np.diff(measured * measured) / (2.0 * spacing)  # dv/dt = v dv/ds
    y = stages.drive - INERTIA * slope
    phi = measured[:-1, None] ** np.arange(3)
    return np.asarray(np.linalg.lstsq(phi, y)[0])
