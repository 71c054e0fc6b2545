# SPDX-License-Identifier: Apache-2.0
"""Parameters of the speed model, their physical meaning and their prior.

Yuan et al. 2017, eq. (2): x(n) = a1 x(n-1)^2 + a2 x(n-1) + b1 u(n-1) + d0, by forward Euler of (1):

    a1 = -T k c,   a2 = 1 - T k b,   b1 = T k,   d0 = -T k a

with the Davis resistance a + b v + c v^2 [N/kN] and the acceleration coefficient k [m/s^2 per N/kN]. Resistance and
gradient are forces per actual weight, so their k is k0 = g / (1000 (1 + gamma)), which depends on the rotating masses
only. The reported traction is per weighed or assumed weight and has a gain error: b1 = T k0 kappa with the force scale
kappa = (1 + gamma) / mass_factor, the same as in the resistance estimators.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from trainid_ros.estimators.prior import prior_variances
from trainid_ros.stream.samples import SAMPLE_PERIOD

if TYPE_CHECKING:
    from trainid_ros.speed_model.speed_model_settings import SpeedModelConfig

Theta: TypeAlias = tuple[float, float, float, float]
"""a1 [s/m], a2 [1], b1 [m/s per N/kN], d0 [m/s]."""
Symmetric: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""Upper triangle of a symmetric 4x4 matrix, row by row; stored this way it cannot lose its symmetry."""

# Lower limit of the relative std of mass and force, because forgetting divides by the variance of b1.
_LEAST_MASS_STD: Final = 1e-4


def to_speed_model(davis: tuple[float, float, float], k: float) -> Theta:
    """Map Davis a [N/kN], b [N/kN per m/s], c [N/kN per (m/s)^2] and k [m/s^2 per N/kN] to (a1, a2, b1, d0)."""
    a, b, c = davis
    scale = SAMPLE_PERIOD * k
    # Eq. (2).
    return -scale * c, 1.0 - scale * b, scale, -scale * a


def to_physical(theta: Theta, k: float) -> tuple[float, float, float, float]:
    """Map (a1, a2, b1 > 0, d0) to Davis (a, b, c) and the force scale [1]; k = k0 [m/s^2 per N/kN]."""
    a1, a2, b1, d0 = theta
    scale = SAMPLE_PERIOD * k
    return -d0 / scale, (1.0 - a2) / scale, -a1 / scale, b1 / scale


def prior(
    davis: tuple[float, float, float], k: float, config: SpeedModelConfig, mass_std: float
) -> tuple[Theta, Symmetric]:
    """Return theta(0) and its covariance.

    Args:
        davis: Davis a [N/kN], b [N/kN per m/s], c [N/kN per (m/s)^2].
        k: k0 [m/s^2 per N/kN].
        config: Settings.
        mass_std: Relative standard deviation of mass and force together [1].

    """
    a, b, c = prior_variances(davis, config)
    scale = (SAMPLE_PERIOD * k) ** 2
    return to_speed_model(davis, k), (
        scale * c, 0.0, 0.0, 0.0, scale * b, 0.0, 0.0, scale * max(mass_std, _LEAST_MASS_STD) ** 2, 0.0, scale * a
    )  # fmt: skip


def full(S: Symmetric) -> tuple[float, ...]:
    """Return all 16 elements, row by row."""
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = S
    return s11, s12, s13, s14, s12, s22, s23, s24, s13, s23, s33, s34, s14, s24, s34, s44


def resistance_variance(S: Symmetric, v: float, k: float) -> float:
    """Return the variance of w(v) [(N/kN)^2] at v [m/s] from the covariance S of theta; k = k0 [m/s^2 per N/kN]."""
    s11, s12, _, s14, s22, _, s24, _, _, s44 = S
    # w = -(a1 v^2 + (a2 - 1) v + d0) / (T k)
    square = v * v
    total = square * (s11 * square + 2.0 * (s12 * v + s14)) + v * (s22 * v + 2.0 * s24) + s44
    return total / (SAMPLE_PERIOD * k) ** 2
