# SPDX-License-Identifier: Apache-2.0
"""Recursive least squares for three parameters, plain and regularised (Liu et al. 2018, eq. (9)-(16)).

Pure functions on floats. P is symmetric and given by its six different entries (P11, P12, P13, P22, P23, P33):
the nine of the printed P(t) = [I - L phi'] P(t-1) drift apart, and with forgetting that ends the recursion.

What the paper prints as regularised RLS, (12)-(16), is RLS with three more observations in every step: "each
parameter is 0, with variance N/lambda". Its penalty therefore grows with time and is lambda at t = N only, where
N is the length of a record that has not ended yet. RLS started from P(0) = I/lambda, theta(0) = 0 minimises
``sum (y - phi' theta)^2 + lambda |theta|^2``, that is (7), at every t; :func:`start` gives both starts.
"""

from __future__ import annotations

from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Symmetric: TypeAlias = tuple[float, float, float, float, float, float]

_UNITS: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def start(p0: float, theta0: float = 0.0) -> tuple[Vector, Symmetric]:
    """Return theta(0) with all entries alike and P(0) = p0 I.

    The paper starts from p0 = 1e6 and theta0 = 1/p0, as if nothing were known; p0 = 1/lambda and theta0 = 0
    regularise.
    """
    return (theta0, theta0, theta0), (p0, 0.0, 0.0, p0, 0.0, p0)


def rls(theta: Vector, P: Symmetric, phi: Vector, y: float, variance: float = 1.0) -> tuple[Vector, Symmetric]:
    """One step of RLS, (9)-(11).

    Args:
        theta: Estimate.
        P: Its covariance in units of the noise variance.
        phi: Regressor.
        y: Observation.
        variance: Variance of its noise, 1 in the paper.

    Returns:
        theta and P after it.

    """
    f1, f2, f3 = phi
    a, b, c = theta
    P11, P12, P13, P22, P23, P33 = P
    g1 = P11 * f1 + P12 * f2 + P13 * f3  # g = P phi
    g2 = P12 * f1 + P22 * f2 + P23 * f3
    g3 = P13 * f1 + P23 * f2 + P33 * f3
    S = variance + f1 * g1 + f2 * g2 + f3 * g3
    L1, L2, L3 = g1 / S, g2 / S, g3 / S  # (10)
    e = y - f1 * a - f2 * b - f3 * c
    # (11) as P = A P A' + variance L L' with A = I - L phi' (Joseph). From p0 = 1e6 the first observation alone takes
    # 13 decades from P along phi, and P - L phi' P would leave rounding errors as large as what remains.
    A11, A12, A13 = 1.0 - L1 * f1, -L1 * f2, -L1 * f3
    A21, A22, A23 = -L2 * f1, 1.0 - L2 * f2, -L2 * f3
    A31, A32, A33 = -L3 * f1, -L3 * f2, 1.0 - L3 * f3
    B11, B12, B13 = P11 - L1 * g1, P12 - L1 * g2, P13 - L1 * g3  # B = A P
    B21, B22, B23 = P12 - L2 * g1, P22 - L2 * g2, P23 - L2 * g3
    B31, B32, B33 = P13 - L3 * g1, P23 - L3 * g2, P33 - L3 * g3
    return (
        (a + L1 * e, b + L2 * e, c + L3 * e),  # (9)
        (
            B11 * A11 + B12 * A12 + B13 * A13 + variance * L1 * L1,
            B11 * A21 + B12 * A22 + B13 * A23 + variance * L1 * L2,
            B11 * A31 + B12 * A32 + B13 * A33 + variance * L1 * L3,
            B21 * A21 + B22 * A22 + B23 * A23 + variance * L2 * L2,
            B21 * A31 + B22 * A32 + B23 * A33 + variance * L2 * L3,
            B31 * A31 + B32 * A32 + B33 * A33 + variance * L3 * L3,
        ),
    )


def shrink(theta: Vector, P: Symmetric, rate: float) -> tuple[Vector, Symmetric]:
    """Observe each parameter to be zero with variance 1/rate.

    P becomes Q = (P^-1 + rate I)^-1, which is (14) with rate = lambda/N; without its division, so that rate = 0
    changes nothing.
    """
    if rate <= 0.0:
        return theta, P
    variance = 1.0 / rate
    for unit in _UNITS:
        theta, P = rls(theta, P, unit, 0.0, variance)
    return theta, P


def regularised_rls(theta: Vector, P: Symmetric, phi: Vector, y: float, rate: float) -> tuple[Vector, Symmetric]:
    """One step of regularised RLS as printed, (12)-(16), with rate = lambda/N.

    The printed theta(t) = theta(t-1) + L e - rate P(t) theta(t-1) is what shrinking and then observing gives:
    both are the solution of P^-1(t) theta(t) = P^-1(t-1) theta(t-1) + phi y, P^-1(t) = P^-1(t-1) + phi phi' + rate I.
    """
    theta, P = shrink(theta, P, rate)
    return rls(theta, P, phi, y)


def forget(P: Symmetric, mu: float) -> Symmetric:
    """Return P/mu: older observations weigh mu times less, and so does all that was known before."""
    P11, P12, P13, P22, P23, P33 = P
    return P11 / mu, P12 / mu, P13 / mu, P22 / mu, P23 / mu, P33 / mu
