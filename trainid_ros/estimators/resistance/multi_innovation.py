# SPDX-License-Identifier: Apache-2.0
"""Multi-innovation least squares on a Gaussian belief (Liu et al. 2018, section 3; Ding et al. 2010)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.estimators.resistance.speed_window import WindowResult


@dataclass(frozen=True, slots=True)
class Belief:
    """Mean and covariance of the Davis parameters (a, b, c); P is row-major."""

    theta: tuple[float, ...]
    P: tuple[float, ...]

    @classmethod
    def of(cls, theta: NDArray[np.float64], P: NDArray[np.float64]) -> Belief:
        """Return the belief of arrays, shapes (3,) and (3, 3)."""
        return cls(tuple(map(float, theta)), tuple(map(float, P.ravel())))

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return theta, shape (3,), and P, shape (3, 3)."""
        return np.array(self.theta), np.array(self.P).reshape(3, 3)

    def widen(self, covariance: NDArray[np.float64]) -> Belief:
        """Return the belief with doubt added."""
        theta, P = self.arrays()
        return Belief.of(theta, P + covariance)

    def drifted(self, rates: tuple[float, float, float], elapsed_s: float, most: tuple[float, float, float]) -> Belief:
        """Return the belief after a random walk of the parameters.

        Args:
            rates: Growth of the three variances per second.
            elapsed_s: Time passed [s].
            most: Variances that doubt does not exceed; where it would, correlations stay.

        """
        P = list(self.P)
        for i in range(3):
            P[4 * i] += rates[i] * elapsed_s
        if all(P[4 * i] <= most[i] for i in range(3)):
            return Belief(self.theta, tuple(P))
        shrink = [min(1.0, math.sqrt(most[i] / P[4 * i])) for i in range(3)]
        return Belief(self.theta, tuple(P[k] * shrink[k // 3] * shrink[k % 3] for k in range(9)))

    def resistance_variance(self, v: float) -> float:
        """Return phi' P phi, the variance of w(v) [(N/kN)^2] at a speed [m/s]; floats are fastest for 3x3."""
        P = self.P
        return max(0.0, P[0] + v * (2.0 * P[1] + v * (2.0 * P[2] + P[4] + v * (2.0 * P[5] + v * P[8]))))

    def is_finite(self) -> bool:
        """True for three and nine finite numbers."""
        sized = len(self.theta) == 3 and len(self.P) == 9
        return sized and bool(np.isfinite(self.theta).all() and np.isfinite(self.P).all())


def multi_innovation_step(belief: Belief, stack: Sequence[WindowResult], variances: Sequence[float]) -> Belief:
    """One step of MILS with the p observations of the stack, each with its own noise variance.

    The paper's innovations have unit variance, which makes P shrink p-fold where observations are used
    p times; given p times their variance, all uses of an observation together weigh exactly once.
    """
    theta, P = belief.arrays()
    Phi = np.array([item.phi for item in stack]).T  # (3, p)
    Y = np.array([item.y for item in stack])
    R = np.diag(variances)
    # L = P Phi [R + Phi' P Phi]^-1;  theta += L [Y - Phi' theta];  P = (I - L Phi') P
    L = np.linalg.solve(R + Phi.T @ P @ Phi, Phi.T @ P).T
    A = np.eye(3) - L @ Phi.T
    # Joseph form: keeps P symmetric and positive under rounding.
    return Belief.of(theta + L @ (Y - Phi.T @ theta), A @ P @ A.T + L @ R @ L.T)
