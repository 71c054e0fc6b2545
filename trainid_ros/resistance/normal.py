# SPDX-License-Identifier: Apache-2.0
"""Normal distributions of n parameters theta, and what observations y = phi' theta + noise make of them.

Two forms: mean and covariance P; and the information [P^-1 | P^-1 theta], shape (n, n + 1), in which independent
observations add up. The gate is the soft one of :mod:`robust`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.resistance.robust import weigh

if TYPE_CHECKING:
    from collections.abc import Sequence

Array = NDArray[np.float64]

_LEAST_WEIGHT: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal distribution of the parameters.

    Attributes:
        theta: Mean, shape (n,).
        P: Covariance, shape (n, n).

    """

    theta: Array
    P: Array

    def predict(self, phi: Array) -> tuple[float, float]:
        """Return mean and variance of phi' theta for a regressor of shape (n,)."""
        return float(phi @ self.theta), max(float(phi @ self.P @ phi), 0.0)


def independent(theta: Sequence[float], variances: Sequence[float]) -> Normal:
    """Return independent parameters with these means and variances."""
    return Normal(np.array(theta, dtype=np.float64), np.diag(np.array(variances, dtype=np.float64)))


def widened(item: Normal, variances: Array, most: Array | None = None) -> Normal:
    """Return a distribution after independent random steps of the parameters.

    Args:
        item: The distribution before.
        variances: Variances of the steps, shape (n,).
        most: Limits of the variances afterwards, shape (n,); where one is reached, correlations stay.

    """
    P = item.P + np.diag(variances)
    if most is not None:
        r = np.minimum(1.0, np.sqrt(most / np.diag(P)))
        P = r[:, None] * P * r
    return Normal(item.theta, P)


def soft_update(item: Normal, phi: Array, y: float, R: float, slow: float, eps: float) -> tuple[Normal, float, float]:
    """Return the distribution after one observation, the weight of the observation and its log likelihood.

    Args:
        item: The distribution before.
        phi: Regressor, shape (n,).
        y: Observation.
        R: Variance of its noise.
        slow: How many times R it counts in the mean of many, since noise may be correlated; 1 if white.
        eps: Share of outliers, 0 for plain least squares.

    """
    g = item.P @ phi
    variance = float(phi @ g)
    nu = y - float(phi @ item.theta)
    weight, log_likelihood = weigh(nu, variance + R, R, eps)
    if weight < _LEAST_WEIGHT:
        return item, weight, log_likelihood
    # theta += K nu, P -= g g' / (phi' P phi + R / weight): the weight divides the noise
    k = 1.0 / (variance + slow * R / weight)
    return Normal(item.theta + k * nu * g, item.P - k * np.outer(g, g)), weight, log_likelihood


def mixed(items: Sequence[Normal], weights: Sequence[float]) -> Normal:
    """Return mean and covariance of a mixture; weights need not add up to one."""
    share = np.array(weights) / math.fsum(weights)
    thetas = np.array([item.theta for item in items])
    theta = share @ thetas
    d = thetas - theta
    P = np.tensordot(share, np.array([item.P for item in items]), 1) + (share[:, None] * d).T @ d
    return Normal(theta, P)


def information_of(item: Normal) -> Array:
    """Return [P^-1 | P^-1 theta], shape (n, n + 1)."""
    inverse = _inverse(item.P)
    return np.column_stack([inverse, inverse @ item.theta])


def normal_of(information: Array) -> Normal:
    """Return the distribution of [P^-1 | P^-1 theta], shape (n, n + 1)."""
    P = _inverse(information[:, :-1])
    return Normal(P @ information[:, -1], P)


def information_in(phi: Array, y: float, variance: float) -> Array:
    """Return what one observation adds to the information: phi [phi', y] / variance, shape (n, n + 1)."""
    return np.outer(phi, np.append(phi, y)) / variance


def _inverse(S: Array) -> Array:
    """Return the inverse of a covariance or an information; parameters lie decades apart, so it is scaled to 1."""
    scale = 1.0 / np.sqrt(S.diagonal())
    inverse = np.linalg.inv(scale[:, None] * S * scale)
    scaled: Array = scale[:, None] * (0.5 * (inverse + inverse.T)) * scale
    return scaled
