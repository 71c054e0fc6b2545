# SPDX-License-Identifier: Apache-2.0
"""Speed over distance, stage by stage: eq. (7) of Xia et al. 2023, corrected.

``v_i^2 = v_{i-1}^2 + 2 lambda_i [1000 F_i/(M g) - w_add,i - a - b v_{i-1} - c v_{i-1}^2]`` with
``lambda_i = g ds_i / (1000 (1 + gamma))``. Differences from the paper: all resistances are specific (the paper
divides G [kN] by 1000 once more), v is in m/s for every printed theta, and F and w_add may be means over the stage
instead of their values at its start. Sampling them at the start is the only significant error of the scheme; holding
w(v) constant over a stage has a negligible effect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.train.forces import G

if TYPE_CHECKING:
    from numpy.typing import NDArray

STALL_SPEED: Final = 1.0
"""Lower limit of the modelled speed [m/s]: for parameters far from the truth (7) has no real root."""


def reach(steps: NDArray[np.float64], gamma: float) -> NDArray[np.float64]:
    """Return lambda [m^2/s^2 per N/kN] of stages of given lengths [m]; gamma is the share of rotating masses [1]."""
    lam: NDArray[np.float64] = steps * (G / (1000.0 * (1.0 + gamma)))
    return lam


@dataclass(frozen=True, slots=True)
class Stages:
    """Known quantities of I stages.

    Attributes:
        lam: lambda [m^2/s^2 per N/kN], shape (I,).
        drive: Traction minus additional resistance, 1000 F/(M g) - w_add [N/kN], shape (I,).

    """

    lam: NDArray[np.float64]
    drive: NDArray[np.float64]

    def speeds(self, theta: NDArray[np.float64], start: float) -> NDArray[np.float64]:
        """Return v_0 to v_I of (7) [m/s], shape (I + 1,), from an initial speed; never below the stall speed."""
        a, b, c = (float(x) for x in theta)
        v, floor = start, STALL_SPEED * STALL_SPEED
        path, sqrt = [v], math.sqrt
        for lam, drive in zip(self.lam.tolist(), self.drive.tolist(), strict=True):
            # (7)
            square = v * v + 2.0 * lam * (drive - a - v * (b + c * v))
            v = sqrt(square) if square > floor else STALL_SPEED
            path.append(v)
        return np.array(path)


@dataclass(frozen=True, slots=True)
class Coefficients:
    """k, p, q, u below (13) and (18), each of shape (I,); zero in a stage that stalls."""

    k: NDArray[np.float64]
    p: NDArray[np.float64]
    q: NDArray[np.float64]
    u: NDArray[np.float64]

    @classmethod
    def along(cls, stages: Stages, theta: NDArray[np.float64], v: NDArray[np.float64]) -> Coefficients:
        """Return the coefficients along speeds v [m/s], shape (I + 1,)."""
        _, b, c = theta
        u = np.where(v[1:] > STALL_SPEED, 1.0 / v[1:], 0.0)
        # Brackets added that are missing in the text below (13).
        k = (v[:-1] - stages.lam * (b + 2.0 * c * v[:-1])) * u
        return cls(k=k, p=stages.lam * u, q=(1.0 - 2.0 * c * stages.lam) * u, u=u)
