# SPDX-License-Identifier: Apache-2.0
"""Kernels on the auxiliary output x_a and theta together: [x_a, a1, a2, b1, d0] and their covariance.

Algorithm (7) of Yuan et al. 2017 takes phi(n) for the gradient of x_a(n) with respect to theta. It is not: x_a(n-1)
depends on theta too. The true gradient obeys psi(n) = phi(n) + f psi(n-1), f = 2 a1 x + a2 = 1 - 1e-4, and
carrying the covariance of x_a and theta is carrying it, weighed by what was measured since. Without it the loop of
x_a error and d0 error is all but undamped, so (7) must forget fast or drift.

Pure arithmetic on tuples: floats for one train, arrays of equal shape for many at once. A ``Moments`` is
x, a1, a2, b1, d0, then var(x), cov(x, theta) (4) and the upper triangle of cov(theta) (10).
"""

from __future__ import annotations

from typing import TypeAlias

from trainid_ros.estimators.speed_model.parameters import Symmetric, Theta

Moments: TypeAlias = tuple[
    float, float, float, float, float, float, float, float, float, float,
    float, float, float, float, float, float, float, float, float, float,
]  # fmt: skip


def moments(x: float, variance: float, theta: Theta, S: Symmetric) -> Moments:
    """Return x with its variance, theta with covariance S, uncorrelated."""
    return (x, *theta, variance, 0.0, 0.0, 0.0, 0.0, *S)


def predict(m: Moments, u: float, scale: float, noise: float, drift: float) -> Moments:
    """Step the auxiliary model, x(n) = phi(n)' theta, and the covariance with its gradient.

    Args:
        m: Moments at the sample before.
        u: Specific force over the step [N/kN].
        scale: Duration of the step over the sample period.
        noise: Variance that x gains in one sample period [(m/s)^2].
        drift: Variance that d0 gains in one sample period [(m/s)^2].

    """
    x, a1, a2, b1, d0, pxx, p1, p2, p3, p4, s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = m
    s44 = s44 + drift * scale
    phi2, phi3 = scale * x, scale * u
    phi1 = phi2 * x
    f = 1.0 + scale * (2.0 * a1 * x + a2 - 1.0)
    # cov(x, theta): f p + S phi
    q1 = f * p1 + s11 * phi1 + s12 * phi2 + s13 * phi3 + s14 * scale
    q2 = f * p2 + s12 * phi1 + s22 * phi2 + s23 * phi3 + s24 * scale
    q3 = f * p3 + s13 * phi1 + s23 * phi2 + s33 * phi3 + s34 * scale
    q4 = f * p4 + s14 * phi1 + s24 * phi2 + s34 * phi3 + s44 * scale
    # var(x): f^2 var(x) + 2 f phi'p + phi'S phi
    pxx = (
        f * (f * pxx + p1 * phi1 + p2 * phi2 + p3 * phi3 + p4 * scale)
        + (q1 * phi1 + q2 * phi2 + q3 * phi3 + q4 * scale)
        + noise * scale
    )
    x = x + a1 * phi1 + (a2 - 1.0) * phi2 + b1 * phi3 + d0 * scale
    return x, a1, a2, b1, d0, pxx, q1, q2, q3, q4, s11, s12, s13, s14, s22, s23, s24, s33, s34, s44


def correct(m: Moments, error: float, variance: float) -> Moments:
    """Take in a measurement of x that differs by ``error`` from the prediction [m/s], noise variance [(m/s)^2]."""
    x, a1, a2, b1, d0, pxx, p1, p2, p3, p4, s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = m
    r = 1.0 / (pxx + variance)
    k1, k2, k3, k4 = p1 * r, p2 * r, p3 * r, p4 * r
    kept = variance * r
    return (
        x + pxx * r * error, a1 + k1 * error, a2 + k2 * error, b1 + k3 * error, d0 + k4 * error,
        pxx * kept, p1 * kept, p2 * kept, p3 * kept, p4 * kept,
        s11 - k1 * p1, s12 - k1 * p2, s13 - k1 * p3, s14 - k1 * p4,
        s22 - k2 * p2, s23 - k2 * p3, s24 - k2 * p4, s33 - k3 * p3, s34 - k3 * p4, s44 - k4 * p4,
    )  # fmt: skip


def anchor(m: Moments, x: float, variance: float) -> Moments:
    """Start x anew from a measurement and forget how it hung together with theta, which stands."""
    zero = 0.0 * variance
    return (x, *m[1:5], variance, zero, zero, zero, zero, *m[10:])


def doubt_load(m: Moments, variance: float) -> Moments:
    """Allow for another load: widen b1."""
    return (*m[:17], m[17] + variance, *m[18:])


def forget(m: Moments, factor: float, floor: tuple[Theta, ...]) -> Moments:
    """Forget all that was learned of theta by ``factor``, down to the information of the prior and never below.

    The information becomes lambda S^-1 + (1 - lambda) P0^-1: a direction in which nothing is learned ends at the
    prior, so nothing winds up. S is divided by lambda, then the prior is taken in with the weight
    1 - lambda as four observations in which nothing new was seen.

    Args:
        m: Moments.
        factor: lambda in (0, 1].
        floor: Four vectors h with sum h h' = P0^-1.

    """
    x, a1, a2, b1, d0, pxx, p1, p2, p3, p4, s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = m
    wider = 1.0 / factor
    s11, s12, s13, s14, s22 = s11 * wider, s12 * wider, s13 * wider, s14 * wider, s22 * wider
    s23, s24, s33, s34, s44 = s23 * wider, s24 * wider, s33 * wider, s34 * wider, s44 * wider
    weight = 1.0 - factor
    for h1, h2, h3, h4 in floor:
        w1 = s11 * h1 + s12 * h2 + s13 * h3 + s14 * h4
        w2 = s12 * h1 + s22 * h2 + s23 * h3 + s24 * h4
        w3 = s13 * h1 + s23 * h2 + s33 * h3 + s34 * h4
        w4 = s14 * h1 + s24 * h2 + s34 * h3 + s44 * h4
        w = p1 * h1 + p2 * h2 + p3 * h3 + p4 * h4
        r = weight / (1.0 + weight * (w1 * h1 + w2 * h2 + w3 * h3 + w4 * h4))
        pxx = pxx - r * w * w
        p1, p2, p3, p4 = p1 - r * w * w1, p2 - r * w * w2, p3 - r * w * w3, p4 - r * w * w4
        s11, s12, s13, s14 = s11 - r * w1 * w1, s12 - r * w1 * w2, s13 - r * w1 * w3, s14 - r * w1 * w4
        s22, s23, s24 = s22 - r * w2 * w2, s23 - r * w2 * w3, s24 - r * w2 * w4
        s33, s34, s44 = s33 - r * w3 * w3, s34 - r * w3 * w4, s44 - r * w4 * w4
    return x, a1, a2, b1, d0, pxx, p1, p2, p3, p4, s11, s12, s13, s14, s22, s23, s24, s33, s34, s44
