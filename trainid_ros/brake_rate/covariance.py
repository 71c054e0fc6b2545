# SPDX-License-Identifier: Apache-2.0
"""The covariance of x = [v, a, b, e], one for all particles.

f affects only the mean of x, so all particles share one covariance, whatever their present and past values of f: one
Riccati equation for all (Zheng et al. 2015, eqs. (14), (16), (20), (21) use one for each particle).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.brake_rate.posterior import ERRORS, STATES
from trainid_ros.vectors import vec

if TYPE_CHECKING:
    from trainid_ros.brake_rate.posterior import Errors, Start, Transition

_E: Final = 3


class Covariance:
    """Covariance of x.

    Attributes:
        P: Its rows, one after another, shape (n, n).
        K: Gain of the last measured speed, eq. (20), shape (n,).

    """

    def __init__(self) -> None:
        self.P, self.K = vec[float]([0.0] * (STATES * STATES)), vec[float]([0.0] * STATES)
        # Row v of Phi, and the diagonal of the others.
        self._gains, self._left = vec[float]([1.0] * STATES), vec[float]([1.0] * STATES)

    def reset(self, stds: Errors) -> None:
        """Set uncertainty in the errors only."""
        for k in range(STATES * STATES):
            self.P[k] = 0.0
        for j, std in enumerate(stds):
            self.P[(_E + j) * (STATES + 1)] = std * std

    def anchor(self, start: Start) -> None:
        """Restart v, a and b."""
        P, decay_e, n = self.P, start.decay_e, STATES
        for k in range(_E * n):
            P[k] = 0.0
        for i in range(ERRORS):
            row = (_E + i) * n
            P[row] = P[row + 1] = P[row + 2] = 0.0
            for j in range(ERRORS):
                P[row + _E + j] *= decay_e[i] * decay_e[j]
            P[row + _E + i] += start.q_e[i]
        P[0], P[n + 1], P[2 * (n + 1)] = start.variances

    def predict(self, step: Transition) -> None:
        """Predict over an interval, P = Phi P Phi' + Q, eq. (14); only v takes from other states."""
        P, gains, left, n = self.P, self._gains, self._left, STATES
        gains[1], gains[2], left[1], left[2] = step.reach, step.dt, step.decay, step.rho
        for j in range(ERRORS):
            gains[_E + j], left[_E + j] = step.gain_e[j], step.decay_e[j]
        variance = 0.0
        for j in range(n):
            with_v = 0.0
            for i in range(n):
                with_v += gains[i] * P[i * n + j]
            variance += gains[j] * with_v
            P[j] = left[j] * with_v
            for i in range(1, n):
                P[i * n + j] *= left[i] * left[j]
        for j in range(1, n):
            P[j * n] = P[j]
        P[0] = variance + step.q_v
        P[2 * (n + 1)] += step.q_b
        for j in range(ERRORS):
            P[(_E + j) * (n + 1)] += step.q_e[j]

    def error_variance(self, share: vec[float]) -> float:
        """Return the variance of share e, shape (8,), given f."""
        variance = 0.0
        for i in range(ERRORS):
            for j in range(ERRORS):
                variance += share[i] * self.P[(_E + i) * STATES + _E + j] * share[j]
        return variance

    def correct(self, r: float) -> float:
        """Set the gain of a measured speed of variance r [(m/s)^2], eq. (20), and update P, eq. (21).

        Returns:
            The variance of the innovation, eq. (16) [(m/s)^2].

        """
        P, K, n = self.P, self.K, STATES
        S = P[0] + r
        for i in range(n):
            K[i] = P[i] / S
        # From below, because the first row is that of before.
        for i in range(n - 1, -1, -1):
            for j in range(i + 1):
                P[i * n + j] -= K[i] * P[j]
        for i in range(1, n):
            for j in range(i):
                P[j * n + i] = P[i * n + j]
        return S
