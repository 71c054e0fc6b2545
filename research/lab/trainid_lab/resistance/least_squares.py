# SPDX-License-Identifier: Apache-2.0
"""Least squares for the three Davis parameters: batch fits, and normal equations updated by one observation.

The regularised form is (7) of Liu et al. 2018. It minimises ``SSE + lambda |theta|^2``; the paper prints lambda/2,
whose minimiser is (7) with half the lambda. The penalty lambda |theta|^2 depends on the units: with v in km/h it acts
almost only on ``a``; with v in m/s the same lambda gives another curve. :func:`ridge` can scale the penalty by the
mean square of each regressor, and :func:`fit_with_prior` takes a Gaussian prior; neither depends on units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_lab.resistance.recursive import Factors, Symmetric, Vector, covariance
from trainid_ros.interface.errors import NoAnswerError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

# Smallest share of a regressor not explained by the other two; below it the parameter is not determined.
_MIN_PIVOT: Final = 1e-11


@dataclass(frozen=True, slots=True)
class Fit:
    """Result of a batch fit."""

    theta: Array  # a [N/kN], b and c [N/kN over the unit of v and of v^2], shape (3,)
    # Covariance of theta, shape (3, 3), for the noise variance of the residuals; the bias caused by a penalty is not
    # included.
    covariance: Array
    variance: float  # Noise variance [(N/kN)^2], weighted sum of squared residuals over degrees of freedom


@dataclass(frozen=True, slots=True)
class Prior:
    """Gaussian prior."""

    theta: Array  # Mean, in the units of :class:`Fit`, shape (3,)
    covariance: Array  # Covariance, shape (3, 3), in units of the noise variance


def least_squares(Phi: Array, y: Array, weights: Array | None = None) -> Fit:
    """Return the least-squares fit.

    Args:
        Phi: Regressors [1, v, v^2], shape (n, 3).
        y: Observed resistance [N/kN], shape (n,).
        weights: Weight of each squared residual, shape (n,); None = equal weights.

    Raises:
        NoAnswerError: The observations do not determine three parameters.

    """
    return _fit(Phi, y, weights, np.zeros((3, 3)), np.zeros(3))


def ridge(Phi: Array, y: Array, penalty: float, weights: Array | None = None, *, scaled: bool = False) -> Fit:
    """Return the regularised fit (7), the minimiser of SSE + penalty |theta|^2.

    Args:
        Phi: Regressors [1, v, v^2], shape (n, 3).
        y: Observed resistance [N/kN], shape (n,).
        penalty: lambda.
        weights: Weight of each squared residual, shape (n,); None = equal weights.
        scaled: True multiplies the penalty of each parameter by the mean square of its regressor, so that units do
            not matter.

    Raises:
        NoAnswerError: Data and penalty do not determine three parameters.

    """
    scale = np.diag(Phi.T @ Phi) / len(Phi) if scaled else np.ones(3)
    return _fit(Phi, y, weights, penalty * np.diag(scale), np.zeros(3))


def fit_with_prior(Phi: Array, y: Array, prior: Prior, weights: Array | None = None) -> Fit:
    """Return the regularised fit whose penalty is (theta - prior)' covariance^-1 (theta - prior).

    Raises:
        NoAnswerError: Data and prior do not determine three parameters.

    """
    precision = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
    return _fit(Phi, y, weights, precision, prior.theta)


def _fit(Phi: Array, y: Array, weights: Array | None, penalty: Array, centre: Array) -> Fit:
    w = np.ones(len(y)) if weights is None else weights
    information = (Phi * w[:, None]).T @ Phi
    solved = solve(_packed(information + penalty), _vector((Phi * w[:, None]).T @ y + penalty @ centre))
    if solved is None:
        raise NoAnswerError(f'{len(y)} observations do not determine three parameters')
    theta, P = np.array(solved[0]), unpacked(covariance(solved[1]))
    residual = y - Phi @ theta
    variance = float(residual @ (w * residual)) / max(1, len(y) - 3)
    return Fit(theta, variance * (P @ information @ P), variance)


def add(information: Symmetric, moment: Vector, phi: Vector, y: float) -> tuple[Symmetric, Vector]:
    """Return the normal equations, sum phi phi' and sum phi y [N/kN], with one more observation."""
    f1, f2, f3 = phi
    M11, M12, M13, M22, M23, M33 = information
    m1, m2, m3 = moment
    return (
        (M11 + f1 * f1, M12 + f1 * f2, M13 + f1 * f3, M22 + f2 * f2, M23 + f2 * f3, M33 + f3 * f3),
        (m1 + f1 * y, m2 + f2 * y, m3 + f3 * y),
    )


def solve(information: Symmetric, moment: Vector) -> tuple[Vector, Factors] | None:
    """Return theta and the factors of P = information^-1, or None if three parameters are not determined.

    Uses the Cholesky factors of the matrix scaled to a unit diagonal, so that the rank decision does not depend on
    units.
    """
    M11, M12, M13, M22, M23, M33 = information
    if not (M11 > 0.0 and M22 > 0.0 and M33 > 0.0):
        return None
    d1, d2, d3 = 1.0 / math.sqrt(M11), 1.0 / math.sqrt(M22), 1.0 / math.sqrt(M33)
    # C = [[1, 0, 0], [C21, C22, 0], [C31, C32, C33]] with C C' = D M D
    C21, C31 = M12 * d1 * d2, M13 * d1 * d3
    pivot2 = 1.0 - C21 * C21
    if not pivot2 > _MIN_PIVOT:
        return None
    C22 = math.sqrt(pivot2)
    C32 = (M23 * d2 * d3 - C31 * C21) / C22
    pivot3 = 1.0 - C31 * C31 - C32 * C32
    if not pivot3 > _MIN_PIVOT:
        return None
    C33 = math.sqrt(pivot3)
    # K = C^-1 D, lower triangular: P = K' K, theta = K' (K m)
    K11, K22, K33 = d1, d2 / C22, d3 / C33
    K21 = -C21 * d1 / C22
    K31, K32 = -(C31 * d1 + C32 * K21) / C33, -C32 * K22 / C33
    m1, m2, m3 = moment
    z1, z2, z3 = K11 * m1, K21 * m1 + K22 * m2, K31 * m1 + K32 * m2 + K33 * m3
    theta = K11 * z1 + K21 * z2 + K31 * z3, K22 * z2 + K32 * z3, K33 * z3
    return theta, (K21 / K22, K31 / K33, K32 / K33, K11 * K11, K22 * K22, K33 * K33)


def unpacked(P: Symmetric) -> Array:
    """Return the full matrix of the six entries of a symmetric one, shape (3, 3)."""
    P11, P12, P13, P22, P23, P33 = P
    return np.array([[P11, P12, P13], [P12, P22, P23], [P13, P23, P33]])


def _packed(matrix: Array) -> Symmetric:
    M11, M12, M13, M22, M23, M33 = (float(matrix[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return M11, M12, M13, M22, M23, M33


def _vector(values: Array) -> Vector:
    m1, m2, m3 = (float(value) for value in values)
    return m1, m2, m3
