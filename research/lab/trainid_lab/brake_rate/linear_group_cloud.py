# SPDX-License-Identifier: Apache-2.0
"""A step of :mod:`trainid_ros.brake_rate.m_algorithm` for one stratum of any linear state, measured as y = H x."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_lab.brake_rate.particles import Array, distance, normal_weights, systematic

if TYPE_CHECKING:
    from trainid_lab.brake_rate.particles import Correction, LinearStep

_LOG_PRIOR: Final = np.log([[1.0 / 6.0], [4.0 / 6.0], [1.0 / 6.0]])
_OFFSETS: Final = np.array([[-1.0], [0.0], [1.0]])
_KAPPA: Final = 0.2
_SHRUNK: Final = math.sqrt(1.0 - _KAPPA**2)
_MAX_SPREAD: Final = 2.0


class LinearGroupCloud(NamedTuple):
    """Rates f [1], shape (N,), their mean and variance; means of x given f, shape (n, N), their regression on f."""

    f: Array
    x: Array
    mean: float
    variance: float
    slope: Array

    def predicted(self, step: LinearStep) -> LinearGroupCloud:
        """Predict over a step with constant f, eq. (14)."""
        return self._replace(x=step.predict(self.x, self.f), slope=step.Phi @ self.slope + step.gamma)

    def learned(
        self, step: LinearStep, fix: Correction, H: Array, y: Array, walk: float, largest: float, uniform: float
    ) -> LinearGroupCloud:
        """Branch, weigh and prune predicted particles; ``walk`` is the variance q dt [1]."""
        kernel = _KAPPA**2 * self.variance
        c = step.gamma + kernel / (walk + kernel) * (self.slope - step.gamma)
        moved = (_SHRUNK - 1.0) * (self.f - self.mean)
        off = _OFFSETS * math.sqrt(3.0 * (walk + kernel)) * np.ones(len(moved))
        f = (self.f + moved + off).ravel()
        x = np.tile(self.x + self.slope[:, None] * moved, 3) + c[:, None] * off.ravel()
        nu = y[:, None] - H @ x
        logs = (_LOG_PRIOR - 0.5 * distance(fix.W, nu).reshape(3, -1)).ravel()
        w = normal_weights(np.where((f < 0.0) | (f > largest), -np.inf, logs))
        x = x + fix.K @ nu
        # The moments before pruning are those of the survivors.
        mean, middle = float(f @ w), x @ w
        variance = float(np.square(f - mean) @ w)
        slope = (x - middle[:, None]) @ (w * (f - mean)) / variance
        order = f.argsort(kind='stable')
        kept = order[systematic(w[order], len(self.f), uniform)]
        around = f[kept] - f[kept].mean()
        matched = mean + min(math.sqrt(variance / float(np.square(around).mean())), _MAX_SPREAD) * around
        states = x[:, kept] + slope[:, None] * (matched - f[kept])
        states += (middle - states.mean(axis=1))[:, None]
        return LinearGroupCloud(matched, states, mean, variance, slope)
