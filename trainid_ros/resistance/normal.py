# SPDX-License-Identifier: Apache-2.0
"""Normal distributions of n parameters theta and their update by observations y = phi' theta + noise.

There are two forms: mean and covariance P; and the information [P^-1 | P^-1 theta], shape (n, n + 1), in which
independent observations add. The gate is the soft gate of :mod:`robust`.
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

_MIN_WEIGHT: Final = 1e-9


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
        """Return mean and variance of phi' theta, in the unit of y and its square, for a regressor of shape (n,)."""
        return float(phi @ self.theta), max(float(phi @ self.P @ phi), 0.0)


def independent(theta: Sequence[float], variances: Sequence[float]) -> Normal:
    """Return the distribution of independent parameters with these means and variances."""
    return Normal(np.array(theta, dtype=np.float64), np.diag(np.array(variances, dtype=np.float64)))


def widened(item: Normal, variances: Array, most: Array | None = None) -> Normal:
    """Return the distribution after independent random steps of the parameters.

    Args:
        item: Distribution before the steps.
        variances: Variances of the steps, shape (n,).
        most: Upper limits of the variances afterwards, shape (n,); limiting keeps the correlations.

    """
    P = item.P + np.diag(variances)
    if most is not None:
        r = np.minimum(1.0, np.sqrt(most / np.diag(P)))
        P = r[:, None] * P * r
    return Normal(item.theta, P)


def soft_update(item: Normal, phi: Array, y: float, R: float, slow: float, eps: float) -> tuple[Normal, float, float]:
    """Return the distribution after one observation, the weight of the observation and its log likelihood.

    Args:
        item: Distribution before the observation.
        phi: Regressor, shape (n,).
        y: Observation.
        R: Variance of its noise.
        slow: Factor on R in the mean of many observations with correlated noise; 1 if the noise is white.
        eps: Share of outliers, 0 for plain least squares.

    """
    g = item.P @ phi
    variance = float(phi @ g)
    nu = y - float(phi @ item.theta)
    weight, log_likelihood = weigh(nu, variance + R, R, eps)
    if weight < _MIN_WEIGHT:
        return item, weight, log_likelihood
    # theta += K nu, P -= g g' / (phi' P phi + slow R / weight): the weight divides the noise variance
    k = 1.0 / (variance + slow * R / weight)
    return Normal(item.theta + k * nu * g, item.P - k * np.outer(g, g)), weight, log_likelihood


def mixed(items: Sequence[Normal], weights: Sequence[float]) -> Normal:
    """Return mean and covariance of a mixture; the weights need not sum to one."""
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
    """Return the information of one observation, phi [phi', y] / variance, shape (n, n + 1)."""
    return np.outer(phi, np.append(phi, y)) / variance


def _inverse(S: Array) -> Array:
    """Return the inverse of a covariance or information matrix.

    The matrix is scaled to a unit diagonal first, since the parameters differ by orders of magnitude.
    """
    scale = 1.0 / np.sqrt(S.diagonal())
    inverse = np.linalg.inv(scale[:, None] * S * scale)
    scaled: Array = scale[:, None] * (0.5 * (inverse + inverse.T)) * scale
    return scaled
