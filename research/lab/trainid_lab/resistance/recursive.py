# SPDX-License-Identifier: Apache-2.0
"""Recursive least squares for three parameters, plain and regularised (Liu et al. 2018, eq. (9)-(16)).

Pure functions on floats. P is stored as ``P = U D U'`` with U unit upper triangular and D diagonal (Bierman 1977),
six numbers U12, U13, U23, D1, D2, D3. Starting from p0 = 1e6 with v in km/h, the printed P(t) = [I - L phi'] P(t-1)
loses 13 decades with the first observation, hence nearly all its digits; its nine entries become asymmetric, and
with forgetting the recursion then diverges. The factored form keeps full precision, and P stays positive despite
rounding.

The printed regularised RLS, (12)-(16), is RLS with three more observations in every step: "each parameter is 0, with
variance N/lambda". Its penalty therefore grows with time and equals lambda only at t = N, where N is the length of a
record that has not ended yet. RLS started from P(0) = I/lambda, theta(0) = 0 minimises
``sum (y - phi' theta)^2 + lambda |theta|^2``, that is (7), at every t; :func:`start` gives both initial states.
"""

from __future__ import annotations

from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Symmetric: TypeAlias = tuple[float, float, float, float, float, float]
Factors: TypeAlias = tuple[float, float, float, float, float, float]

_UNITS: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def start(p0: float, theta0: float = 0.0) -> tuple[Vector, Factors]:
    """Return theta(0), all entries equal to theta0, and the factors of P(0) = p0 I.

    The paper starts from p0 = 1e6 and theta0 = 1/p0, a nearly uninformative prior; p0 = 1/lambda and theta0 = 0
    regularise.
    """
    return (theta0, theta0, theta0), (0.0, 0.0, 0.0, p0, p0, p0)


def rls(theta: Vector, UD: Factors, phi: Vector, y: float, variance: float = 1.0) -> tuple[Vector, Factors]:
    """Make one step of RLS, eqs. (9)-(11).

    Args:
        theta: Estimate.
        UD: Factors of its covariance in units of the noise variance.
        phi: Regressor.
        y: Observed resistance [N/kN].
        variance: Variance of its noise in units of the noise variance, 1 in the paper.

    Returns:
        theta and factors after the step.

    """
    f1, f2, f3 = phi
    a, b, c = theta
    U12, U13, U23, D1, D2, D3 = UD
    # h = U' phi, g = D h; s3 = variance + phi' P phi
    h1, h2, h3 = f1, f2 + U12 * f1, f3 + U13 * f1 + U23 * f2
    g1, g2, g3 = D1 * h1, D2 * h2, D3 * h3
    s1 = variance + h1 * g1
    s2 = s1 + h2 * g2
    s3 = s2 + h3 * g3
    # k = U g = P phi, column by column; (10) is L = k / s3
    p1 = g1 + U12 * g2
    k1, k2, k3 = p1 + U13 * g3, g2 + U23 * g3, g3
    e = (y - f1 * a - f2 * b - f3 * c) / s3
    after = (
        U12 - g1 * h2 / s1,
        U13 - p1 * h3 / s2,
        U23 - g2 * h3 / s2,
        D1 * (variance / s1),
        D2 * (s1 / s2),
        D3 * (s2 / s3),
    )
    # (9), (11)
    return (a + k1 * e, b + k2 * e, c + k3 * e), after


def shrink(theta: Vector, UD: Factors, rate: float) -> tuple[Vector, Factors]:
    """Update with the observation that each parameter is zero with variance 1/rate.

    P becomes Q = (P^-1 + rate I)^-1, which is (14) with rate = lambda/N; written without the division of (14), so
    that rate = 0 changes nothing.
    """
    if rate <= 0.0:
        return theta, UD
    variance = 1.0 / rate
    for unit in _UNITS:
        theta, UD = rls(theta, UD, unit, 0.0, variance)
    return theta, UD


def regularised_rls(theta: Vector, UD: Factors, phi: Vector, y: float, rate: float) -> tuple[Vector, Factors]:
    """Make one step of regularised RLS as printed, (12)-(16), with rate = lambda/N.

    The printed theta(t) = theta(t-1) + L e - rate P(t) theta(t-1) equals shrinking followed by a step of RLS:
    both solve P^-1(t) theta(t) = P^-1(t-1) theta(t-1) + phi y with P^-1(t) = P^-1(t-1) + phi phi' + rate I.
    """
    theta, UD = shrink(theta, UD, rate)
    return rls(theta, UD, phi, y)


def forget(UD: Factors, mu: float) -> Factors:
    """Return the factors of P/mu, which multiplies the weight of the prior and of all older observations by mu."""
    U12, U13, U23, D1, D2, D3 = UD
    return U12, U13, U23, D1 / mu, D2 / mu, D3 / mu


def covariance(UD: Factors) -> Symmetric:
    """Return the entries P11, P12, P13, P22, P23, P33 of P = U D U'."""
    U12, U13, U23, D1, D2, D3 = UD
    P12, P13, P23 = U12 * D2 + U13 * U23 * D3, U13 * D3, U23 * D3
    return D1 + U12 * U12 * D2 + U13 * P13, P12, P13, D2 + U23 * P23, P23, D3


def prediction_variance(UD: Factors, phi: Vector) -> float:
    """Return phi' P phi, the variance of phi' theta in units of the noise variance."""
    f1, f2, f3 = phi
    U12, U13, U23, D1, D2, D3 = UD
    h2, h3 = f2 + U12 * f1, f3 + U13 * f1 + U23 * f2
    return D1 * f1 * f1 + D2 * h2 * h2 + D3 * h3 * h3
