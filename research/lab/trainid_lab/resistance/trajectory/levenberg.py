# SPDX-License-Identifier: Apache-2.0
"""Solution of (9) of Xia et al. 2023 by Gauss-Newton with Levenberg's damping and a free initial speed.

* (7) is linear in a, b, c for given speeds: *integrated linear least squares* on the sums of the measured speeds
  gives a starting point as accurate as the fit itself.
* v_0 is a parameter. Using the noisy v~_0 for it, as the paper does, multiplies the normalised error by twelve.
* Parameters are scaled, the step is computed from an orthogonal factor of J (not from J'J), and the iteration stops
  on the size of the step: a limit on f stops before the minimum, or never.
* The exact Hessian has no benefit: with it the same iteration takes longer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_lab.resistance.trajectory.stages import Coefficients, Stages, first_derivatives

SCALE: Final = np.array([1.0, 0.02, 0.001, 1.0])
"""Typical sizes of a, b, c and v_0, used to scale the steps."""
_STEP_TOLERANCE: Final = 1e-9
_MAX_ITERATIONS: Final = 100
_FIRST_DAMPING: Final = 1e-3
# Factor on the damping from integrated least squares, which is near enough for almost undamped steps.
_NEAR: Final = 1e-9
# Speed error of a trial that has diverged [m/s]; its squares might overflow.
_RUNAWAY: Final = 1e6


@dataclass(frozen=True, slots=True)
class TrajectoryFit:
    """Result of a fit."""

    theta: NDArray[np.float64]  # a, b, c [N/kN, v in m/s], shape (3,)
    start: float  # v_0 [m/s]
    covariance: NDArray[np.float64]  # Covariance of a, b, c and v_0 for noise of unit variance, shape (4, 4)
    mse: float  # Objective (8) [(m/s)^2]
    iterations: int  # Number of steps tried
    converged: bool  # True if the last step was negligible


def integrated_least_squares(stages: Stages, measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a, b, c [N/kN, v in m/s] and v_0 [m/s] from sums of the measured speeds, without iteration.

    (7) summed: ``v_i^2 = v_0^2 + 2 sum lambda_j [drive_j - w(v_{j-1})]``; divided by 2 v_i its errors are those of v_i.

    Args:
        stages: Known quantities of I stages.
        measured: v~_0 to v~_I [m/s], shape (I + 1,).

    """
    powers = measured[:-1] ** np.arange(3)[:, None]
    sums = np.zeros((4, measured.size))
    sums[:3, 1:] = -np.cumsum(stages.lam * powers, axis=1)
    sums[3] = measured[0]  # v_0^2 / 2, linearised about v~_0
    energy = 0.5 * (measured * measured - measured[0] ** 2)
    energy[1:] -= np.cumsum(stages.lam * stages.drive)
    inverse = 1.0 / np.maximum(measured, 1.0)
    A = (sums * inverse).T * SCALE
    x = SCALE * np.linalg.lstsq(A, energy * inverse)[0]
    x[3] += measured[0]
    return np.asarray(x)


def levenberg(
    stages: Stages,
    measured: NDArray[np.float64],
    first_guess: NDArray[np.float64] | None = None,
    *,
    free_start: bool = True,
) -> TrajectoryFit:
    """Fit a, b, c and v_0 to measured speeds v~_0 to v~_I [m/s], shape (I + 1,).

    Args:
        stages: Known quantities of I stages.
        measured: Speeds at the boundaries of the stages [m/s].
        first_guess: Starting point a, b, c, v_0, shape (4,); from integrated least squares if None.
        free_start: False keeps v_0 fixed, as the paper does.

    """
    x = integrated_least_squares(stages, measured) if first_guess is None else np.array(first_guess, dtype=float)
    model = _Model.at(stages, measured, x, free_start)
    damping, growth, iterations, step = _FIRST_DAMPING * model.stiffness, 2.0, 0, np.inf
    if first_guess is None:
        damping *= _NEAR
    while iterations < _MAX_ITERATIONS and step > _STEP_TOLERANCE:
        iterations += 1
        delta, gain = model.damped_step(damping)
        step = float(np.max(np.abs(delta)))
        trial = _Model.at(stages, measured, x + SCALE * delta, free_start)
        if trial.cost < model.cost:
            ratio = min((model.cost - trial.cost) / gain, 1.0)
            x, model, growth = x + SCALE * delta, trial, 2.0
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)  # Nielsen's rule
        else:  # steps shrink until one reduces the cost or is negligible, at the minimum
            damping, growth = damping * growth, 2.0 * growth
    return TrajectoryFit(
        theta=x[:3],
        start=float(x[3]),
        covariance=model.covariance(),
        mse=model.cost / (measured.size - 1),
        iterations=iterations,
        converged=step <= _STEP_TOLERANCE,
    )


@dataclass(frozen=True, slots=True)
class _Model:
    """Linearised model at one point: sum of squares, factor R of the scaled Jacobian QR, and Q' e."""

    cost: float
    R: NDArray[np.float64]
    rotated: NDArray[np.float64]

    @classmethod
    def at(cls, stages: Stages, measured: NDArray[np.float64], x: NDArray[np.float64], free_start: bool) -> _Model:
        v = stages.speeds(x[:3], float(x[3]))
        error = measured - v
        if not np.max(np.abs(error)) < _RUNAWAY:
            return cls(np.inf, np.zeros((4, 4)), np.zeros(4))
        first = first_derivatives(Coefficients.along(stages, x[:3], v), v)
        A = np.zeros((v.size, 5))
        A[1:, :4] = first.T * SCALE
        A[0, 3] = SCALE[3]
        A[:, 3] *= free_start
        A[:, 4] = error
        R = np.asarray(np.linalg.qr(A, mode='r'))
        return cls(float(error @ error), R[:4, :4], R[:4, 4])

    @property
    def stiffness(self) -> float:
        """Largest diagonal element of J'J."""
        return float(np.max(np.sum(self.R * self.R, axis=0)))

    def damped_step(self, damping: float) -> tuple[NDArray[np.float64], float]:
        """Return the scaled step, shape (4,), and the predicted reduction of the cost."""
        stacked = np.vstack((self.R, np.sqrt(damping) * np.eye(4)))
        delta = np.linalg.lstsq(stacked, np.concatenate((self.rotated, np.zeros(4))))[0]
        left = self.rotated - self.R @ delta
        gain = float(self.rotated @ self.rotated - left @ left)
        return delta, max(gain, np.finfo(float).tiny)

    def covariance(self) -> NDArray[np.float64]:
        """Return S (J'J)^-1 S from R, which loses half as many digits as J'J; NaN if J is rank deficient."""
        if not np.all(np.abs(np.diag(self.R)) > 0.0):
            return np.full((4, 4), np.nan)
        factor = SCALE[:, None] * np.linalg.inv(self.R)
        C: NDArray[np.float64] = factor @ factor.T
        return C
