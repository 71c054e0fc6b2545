# SPDX-License-Identifier: Apache-2.0
"""Derivatives of (7) of Xia et al. 2023 against complex steps, as printed and corrected."""

from __future__ import annotations

import cmath
from typing import TYPE_CHECKING, Final

import numpy as np

from research.papers.xia2023_fits import CASES, NOISE, record
from research.papers.xia2023_printed import printed_objective
from trainid_lab.resistance.trajectory.derivatives import first_derivatives, objective
from trainid_lab.resistance.trajectory.stages import Coefficients, Stages

if TYPE_CHECKING:
    from numpy.typing import NDArray

_COUNT: Final = 300
_POINTS: Final = 20
_SCALE: Final = np.array([1.0, 0.02, 0.001])
_STEP: Final = 1e-30
_DIFFERENCE: Final = 1e-4


def derivative_errors() -> dict[str, float]:
    """Return the largest relative error of each set of derivatives, columns scaled by the size of a, b and c."""
    given, rng = record('full', 0, 'scheme'), np.random.default_rng(5000)
    stages = Stages(given.stages().lam[:_COUNT], given.stages().drive[:_COUNT])
    start = float(given.speed[0])
    seen = given.speed[1 : _COUNT + 1] + NOISE * rng.standard_normal(_COUNT)
    errors: dict[str, list[float]] = {}
    for _ in range(_POINTS):
        theta = np.array(CASES[0]) * (1.0 + 0.05 * rng.uniform(-1.0, 1.0, 3))
        J = np.array([complex_speeds(stages, theta, start, k) for k in range(3)])
        v = stages.speeds(theta, start)
        ours = first_derivatives(Coefficients.along(stages, theta, v), v)[:3]
        errors.setdefault('Jacobian (13)-(15), corrected', []).append(_relative(ours, J))
        H = _differenced(stages, seen, theta, start)
        scale = np.outer(_SCALE, _SCALE)
        right, wrong = objective(stages, seen, theta, start), printed_objective(stages, seen, theta, start)
        errors.setdefault('Hessian (16)-(23), corrected', []).append(_relative(right.H * scale, H * scale))
        errors.setdefault('gradient (11), (14) as printed', []).append(_relative(wrong.g * _SCALE, right.g * _SCALE))
        errors.setdefault('Hessian as printed', []).append(_relative(wrong.H * scale, H * scale))
    return {name: max(values) for name, values in errors.items()}


def complex_speeds(stages: Stages, theta: NDArray[np.float64], start: float, k: int) -> NDArray[np.float64]:
    """Return dv_i/dtheta_k by a complex step, shape (I,)."""
    a, b, c = (complex(x, _STEP if i == k else 0.0) for i, x in enumerate(theta.tolist()))
    v, out = complex(start), []
    for lam, drive in zip(stages.lam.tolist(), stages.drive.tolist(), strict=True):
        v = cmath.sqrt(v * v + 2.0 * lam * (drive - a - v * (b + c * v)))
        out.append(v.imag / _STEP)
    return np.array(out)


def _differenced(
    stages: Stages, seen: NDArray[np.float64], theta: NDArray[np.float64], start: float
) -> NDArray[np.float64]:
    """Return the Hessian from central differences of the exact gradient with one Richardson extrapolation."""

    def gradient(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return objective(stages, seen, x, start).g

    columns = []
    for k in range(3):
        unit = np.where(np.arange(3) == k, _SCALE, 0.0) * _DIFFERENCE
        near = (gradient(theta + unit) - gradient(theta - unit)) / (2.0 * unit[k])
        far = (gradient(theta + 2.0 * unit) - gradient(theta - 2.0 * unit)) / (4.0 * unit[k])
        columns.append((4.0 * near - far) / 3.0)
    return np.array(columns).T


def _relative(found: NDArray[np.float64], right: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(found - right)) / np.max(np.abs(right)))
