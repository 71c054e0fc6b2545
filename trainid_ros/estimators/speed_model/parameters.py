# SPDX-License-Identifier: Apache-2.0
"""Parameters of the speed model, what they mean physically, and what is believed of them at first.

Yuan et al. 2017, eq. (2): x(n) = a1 x(n-1)^2 + a2 x(n-1) + b1 u(n-1) + d0, by forward Euler of (1):

    a1 = -T k c,   a2 = 1 - T k b,   b1 = T k,   d0 = -T k a

with the Davis resistance a + b v + c v^2 [N/kN] and the acceleration coefficient k [m/s^2 per N/kN]. Only the product
of mass and 1 + gamma can be told from k, and a constant gradient is the same as a part of a.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from trainid_ros.core.samples import SAMPLE_PERIOD
from trainid_ros.core.settings import setting
from trainid_ros.estimators.prior import prior_variances

Theta: TypeAlias = tuple[float, float, float, float]
"""a1, a2, b1, d0."""
Symmetric: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""Upper triangle of a symmetric 4x4 matrix, row by row: stored so, it cannot lose its symmetry."""

UPPER: Final = tuple((i, j) for i in range(4) for j in range(i, 4))


@dataclass(frozen=True, slots=True)
class SpeedModelConfig:
    """Settings that all estimators of the speed model share."""

    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    min_speed: float = setting(0.5, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    readmit_after: int = setting(5, 'refused samples in a row after which the measurement is believed', '', 1, 1000)
    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their believed values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of the Davis a', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of the Davis b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of the Davis c', 'N/kN per (m/s)^2', 1e-9, 1.0)
    prior_std_mass: float = setting(0.05, 'prior relative standard deviation of mass factor', '1', 1e-6, 1.0)
    valid_std: float = setting(
        0.2, 'fit to use while the std of w at the speeds seen is below this', 'N/kN', 1e-3, 100.0
    )


def to_speed_model(davis: tuple[float, float, float], k: float) -> Theta:
    """Map Davis parameters and k [m/s^2 per N/kN] to (a1, a2, b1, d0)."""
    a, b, c = davis
    scale = SAMPLE_PERIOD * k
    return -scale * c, 1.0 - scale * b, scale, -scale * a


def to_physical(theta: Theta) -> tuple[float, float, float, float]:
    """Map (a1, a2, b1 > 0, d0) back to Davis (a, b, c) and k [m/s^2 per N/kN]."""
    a1, a2, b1, d0 = theta
    return -d0 / b1, (1.0 - a2) / b1, -a1 / b1, b1 / SAMPLE_PERIOD


def prior(davis: tuple[float, float, float], k: float, config: SpeedModelConfig) -> tuple[Theta, Symmetric]:
    """Return theta(0) and its covariance: doubt about the physical parameters, through the map."""
    physical = np.diag([*prior_variances(davis, config), (config.prior_std_mass * k) ** 2])
    a, b, c = davis
    # Rows a1, a2, b1, d0; columns a, b, c, k.
    J = SAMPLE_PERIOD * np.array([[0, 0, -k, -c], [0, -k, 0, -b], [0, 0, 0, 1], [-k, 0, 0, -a]], dtype=float)
    return to_speed_model(davis, k), upper(J @ physical @ J.T)


def upper(matrix: NDArray[np.float64]) -> Symmetric:
    """Return the upper triangle of a symmetric matrix, shape (4, 4)."""
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = (float(matrix[i, j]) for i, j in UPPER)
    return s11, s12, s13, s14, s22, s23, s24, s33, s34, s44


def full(S: Symmetric) -> tuple[float, ...]:
    """Return all 16 elements, row by row."""
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = S
    return s11, s12, s13, s14, s12, s22, s23, s24, s13, s23, s33, s34, s14, s24, s34, s44


def resistance_variance(theta: Theta, S: Symmetric, v: float) -> float:
    """Return the variance of w(v) [(N/kN)^2], S the covariance of theta."""
    a1, a2, b1, d0 = theta
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = S
    # w = -(a1 v^2 + (a2 - 1) v + d0) / b1, so -b1 dw = h' dtheta.
    h1, h2, h3 = v * v, v, -(a1 * v * v + (a2 - 1.0) * v + d0) / b1
    first = h1 * (s11 * h1 + 2.0 * (s12 * h2 + s13 * h3 + s14))
    rest = h2 * (s22 * h2 + 2.0 * (s23 * h3 + s24)) + h3 * (s33 * h3 + 2.0 * s34) + s44
    return (first + rest) / (b1 * b1)
