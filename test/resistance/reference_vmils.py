# SPDX-License-Identifier: Apache-2.0
"""V-MILS in plain numpy, the steps [n] at the head of :mod:`trainid_ros.resistance.vmils`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
OUTLIER_WIDTH = 40.0


def observation(dt: Array, v: Array, force: Array, m: float) -> tuple[float, Array]:
    """Return y and [1, v, v^2] of a window.

    Args:
        dt: Times from each sample to the next [s], shape (n - 1,).
        v: Speeds [m/s], shape (n,).
        force: Mean known specific forces between the samples [N/kN], shape (n - 1,).
        m: Specific inertia 1000 (1 + gamma) / g [N/kN per m/s^2].
    """
    t = np.concatenate([[0.0], np.cumsum(dt)])
    v_u = np.concatenate([[0.0], np.cumsum(force * dt)]) / m
    weights = (t - t.mean()) / np.sum((t - t.mean()) ** 2)  # of the least-squares slope
    slope = weights @ (v - v_u)  # [3] (6), over a segment of Fig. 2
    # A constant force in an interval shifts all later speeds: its share in the slope.
    share = dt * np.cumsum(weights[::-1])[::-1][1:]
    v0, v1 = v[:-1], v[1:]
    phi = [share.sum(), share @ (v0 + v1) / 2.0, share @ (v0 * v0 + v0 * v1 + v1 * v1) / 3.0]
    return float(-m * slope), np.array(phi)  # [4] (3)-(5), [5] (2)


class VMils:
    """Multi-innovation least squares with the innovation length p and a share eps of outliers, section 4.2."""

    def __init__(self, theta0: Array, P0: Array, p: int, eps: float) -> None:
        self.theta, self.P, self.p, self.eps = theta0, P0, p, eps  # [1] (7): lambda I = P(0)^-1
        self.latest: list[tuple[Array, float, float]] = []

    def update(self, phi: Array, y: float, R: float, slow: float) -> float:
        """Update with y = phi' theta + noise of variance R; return the weight of y."""
        e, S = y - phi @ self.theta, phi @ self.P @ phi + R  # [7] (9), (16)
        good = (1.0 - self.eps) * math.exp(-0.5 * e * e / S) / math.sqrt(2.0 * math.pi * S)
        w = good / (good + self.eps / (OUTLIER_WIDTH * math.sqrt(R)))  # [8]
        self.latest = [*self.latest, (phi, y, w / (self.p * slow * R))][-self.p :]
        # [9] Phi(p, t_s), Y(p, t_s): bad observations are left out.
        Phi = np.array([row for row, _, d in self.latest if d > 1e-12]).reshape(-1, len(phi)).T
        Y, D = np.array([(value, d) for _, value, d in self.latest if d > 1e-12]).reshape(-1, 2).T
        L = self.P @ Phi @ np.linalg.inv(np.diag(1.0 / D) + Phi.T @ self.P @ Phi)  # [10] with 1/D for I_p
        self.theta = self.theta + L @ (Y - Phi.T @ self.theta)
        self.P = self.P - L @ Phi.T @ self.P
        return w
