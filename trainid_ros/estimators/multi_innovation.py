# SPDX-License-Identifier: Apache-2.0
"""Multi-innovation least squares on a Gaussian belief (Liu et al. 2018, section 3; Ding et al. 2010)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.estimators.speed_window import WindowResult


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

    def capped(self, most: NDArray[np.float64]) -> Belief:
        """Return the belief with no variance above that of ``most``; correlations stay."""
        theta, P = self.arrays()
        shrink = np.sqrt(np.minimum(1.0, np.diag(most) / np.diag(P)))
        return self if shrink.min() == 1.0 else Belief.of(theta, P * np.outer(shrink, shrink))

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
