# SPDX-License-Identifier: Apache-2.0
"""AM-VFF-RLS in plain numpy, the steps [n] at the head of :mod:`trainid_ros.speed_model.am_vff_rls`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trainid_ros.speed_model.am_vff_rls import Tuning

Array = NDArray[np.float64]
E = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
REST, B1, MAX_ERROR = [0, 1, 2, 4], 3, 3.0


@dataclass
class AmVffRls:
    """z = [x_a, a1, a2, b1, d0] with the covariance P, running mean m of the errors, P(0) of theta, settings t."""

    z: Array
    P: Array
    P0: Array
    t: Tuning
    m: float = 0.0

    def update(self, y: float, u: float, s: float, R: float) -> float:
        """Update with a speed y [m/s] of variance R after s sample periods with the force u; return lambda."""
        t, x, a1, a2 = self.t, *self.z[:3]
        phi = s * np.array([x * x, x, u, 1.0])  # [2] (4)
        F = np.eye(5)
        F[0] = 1.0 + s * (2.0 * a1 * x + a2 - 1.0), *phi  # [3]
        self.P[4, 4] += t.drift * s
        self.P = F @ self.P @ F.T + t.noise * s * np.outer(E, E)  # [4]
        self.z[0] = x + phi @ (self.z[1:] - [0.0, 1.0, 0.0, 0.0])  # [5] (2)
        eps = y - self.z[0]  # [6] (7)
        S = self.P[0, 0] + R  # [7]
        if abs(eps) > max(t.gate * math.sqrt(S), t.gate_floor):
            return 1.0
        self.m += t.share * (float(np.clip(eps / math.sqrt(S), -MAX_ERROR, MAX_ERROR)) - self.m)  # [8]
        chi2 = self.m**2 * (2.0 - t.share) / t.share  # [9]
        lam = 1.0 if chi2 <= t.threshold else max(1.0 - (chi2 - t.threshold) / t.scale, t.low)  # [10] (6)
        if lam < 1.0:
            self.forget(lam)  # [11]
        K = self.P @ E / (self.P[0, 0] + R)  # [12] (7)
        self.z = self.z + K * eps  # [13] (7)
        self.P = self.P - np.outer(K, self.P[0])  # [14] (7)
        return lam

    def forget(self, lam: float) -> None:
        """Forget a1, a2, d0 given b1 down to their prior; x_a keeps its covariances with them."""
        c, c0 = self.P[:, B1] / self.P[B1, B1], self.P0[:, 2] / self.P0[2, 2]
        given = (self.P - np.outer(c, self.P[B1]))[np.ix_(REST, REST)]
        prior = (self.P0 - np.outer(c0, self.P0[2]))[np.ix_([0, 1, 3], [0, 1, 3])]
        given[1:, 1:] /= lam
        # In covariance form: theta(n-1) is observed with the variance P(0) / (1 - lambda).
        gain = given[:, 1:] @ np.linalg.inv(prior / (1.0 - lam) + given[1:, 1:])
        self.P[np.ix_(REST, REST)] = given - gain @ given[1:] + self.P[B1, B1] * np.outer(c, c)[np.ix_(REST, REST)]
