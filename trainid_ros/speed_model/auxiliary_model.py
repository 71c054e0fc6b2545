# SPDX-License-Identifier: Apache-2.0
"""Kernels on the joint state of auxiliary output x_a and theta, [x_a, a1, a2, b1, d0], and its covariance.

Algorithm (7) of Yuan et al. 2017 uses phi(n) as the gradient of x_a(n) with respect to theta. This neglects that
x_a(n-1) depends on theta too. The true gradient obeys psi(n) = phi(n) + f psi(n-1), f = 2 a1 x + a2 = 1 - 1e-4;
propagating the joint covariance of x_a and theta propagates this gradient, weighted by the measurements since then.
Without it the loop of x_a error and d0 error is almost undamped, so (7) must forget fast or it drifts.

Pure arithmetic on tuples: floats for one train, arrays of equal shape for many trains. ``Moments`` are
x, a1, a2, b1, d0, then var(x), cov(x, theta) (4) and the upper triangle of cov(theta) (10).
"""

from __future__ import annotations

from typing import TypeAlias

from trainid_ros.speed_model.physical_parameters import Symmetric, Theta

Moments: TypeAlias = tuple[
    float, float, float, float, float, float, float, float, float, float,
    float, float, float, float, float, float, float, float, float, float,
]  # fmt: skip

Floor: TypeAlias = tuple[float, float, float]


def moments(x: float, variance: float, theta: Theta, S: Symmetric) -> Moments:
    """Return the moments of x [m/s] with a variance [(m/s)^2] and theta with covariance S, uncorrelated."""
    return (x, *theta, variance, 0.0, 0.0, 0.0, 0.0, *S)


def predict(m: Moments, u: float, scale: float, noise: float, drift: float) -> Moments:
    """Propagate the auxiliary model over one step, x(n) = phi(n)' theta, and the covariance with its gradient.

    Args:
        m: Moments at the previous sample.
        u: Specific force over the step [N/kN].
        scale: Duration of the step over the sample period [1].
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
    # Eq. (2) for a step of ``scale`` sample periods.
    x = x + a1 * phi1 + (a2 - 1.0) * phi2 + b1 * phi3 + d0 * scale
    return x, a1, a2, b1, d0, pxx, q1, q2, q3, q4, s11, s12, s13, s14, s22, s23, s24, s33, s34, s44


def correct(m: Moments, error: float, variance: float) -> Moments:
    """Update with a measurement of x: innovation ``error`` [m/s], noise variance [(m/s)^2]."""
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
    """Restart x from a measurement [m/s] with a variance [(m/s)^2], uncorrelated with theta; theta is unchanged."""
    zero = 0.0 * variance
    return (x, *m[1:5], variance, zero, zero, zero, zero, *m[10:])


def widen_speed(m: Moments, variance: float) -> Moments:
    """Add to the variance of x [(m/s)^2], for forces that are not reported."""
    return (*m[:5], m[5] + variance, *m[6:])


def widen_load(m: Moments, variance: float) -> Moments:
    """Add to the variance of b1 [(m/s per N/kN)^2], for a change of load."""
    return (*m[:17], m[17] + variance, *m[18:])


def forget(m: Moments, factor: float, floor: Floor) -> Moments:
    """Reduce the information on the resistance by ``factor``, never below that of the prior.

    The mass changes at stops only, so b1 is kept: with c the column of b1, P - c c' / var(b1) is the covariance
    given b1. There the information matrix of a1, a2, d0 becomes lambda times itself plus (1 - lambda) times that of
    the prior: their covariance is divided by lambda, then the prior is applied as three observations of weight
    1 - lambda with zero innovation. A direction without excitation returns to its prior variance, so the covariance
    does not wind up.

    Args:
        m: Moments.
        factor: lambda in (0, 1].
        floor: Prior variances of a1, a2, d0 given b1.

    """
    x, a1, a2, b1, d0, pxx, p1, p2, p3, p4, s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = m
    var1, var2, var4 = floor
    r, wider, weight = 1.0 / s33, 1.0 / factor, 1.0 - factor
    # Given b1:
    qxx = pxx - p3 * p3 * r
    q1, q2, q4 = p1 - p3 * s13 * r, p2 - p3 * s23 * r, p4 - p3 * s34 * r
    c11, c12, c14 = (s11 - s13 * s13 * r) * wider, (s12 - s13 * s23 * r) * wider, (s14 - s13 * s34 * r) * wider
    c22, c24, c44 = (s22 - s23 * s23 * r) * wider, (s24 - s23 * s34 * r) * wider, (s44 - s34 * s34 * r) * wider
    k = weight / (var1 + weight * c11)
    qxx, q1, q2, q4, c11, c12, c14, c22, c24, c44 = (
        qxx - k * q1 * q1, q1 - k * c11 * q1, q2 - k * c12 * q1, q4 - k * c14 * q1, c11 - k * c11 * c11,
        c12 - k * c11 * c12, c14 - k * c11 * c14, c22 - k * c12 * c12, c24 - k * c12 * c14, c44 - k * c14 * c14,
    )  # fmt: skip
    k = weight / (var2 + weight * c22)
    qxx, q1, q2, q4, c11, c12, c14, c22, c24, c44 = (
        qxx - k * q2 * q2, q1 - k * c12 * q2, q2 - k * c22 * q2, q4 - k * c24 * q2, c11 - k * c12 * c12,
        c12 - k * c12 * c22, c14 - k * c12 * c24, c22 - k * c22 * c22, c24 - k * c22 * c24, c44 - k * c24 * c24,
    )  # fmt: skip
    k = weight / (var4 + weight * c44)
    qxx, q1, q2, q4, c11, c12, c14, c22, c24, c44 = (
        qxx - k * q4 * q4, q1 - k * c14 * q4, q2 - k * c24 * q4, q4 - k * c44 * q4, c11 - k * c14 * c14,
        c12 - k * c14 * c24, c14 - k * c14 * c44, c22 - k * c24 * c24, c24 - k * c24 * c44, c44 - k * c44 * c44,
    )  # fmt: skip
    return (
        x, a1, a2, b1, d0, qxx + p3 * p3 * r,
        q1 + p3 * s13 * r, q2 + p3 * s23 * r, p3, q4 + p3 * s34 * r,
        c11 + s13 * s13 * r, c12 + s13 * s23 * r, s13, c14 + s13 * s34 * r,
        c22 + s23 * s23 * r, s23, c24 + s23 * s34 * r, s33, s34, c44 + s34 * s34 * r,
    )  # fmt: skip


def prior_floor(P0: Symmetric) -> Floor:
    """Return the prior variances of a1, a2, d0 given b1, where ``forget`` ends; given b1 the prior is diagonal."""
    s11, _, s13, _, s22, s23, _, s33, s34, s44 = P0
    return s11 - s13 * s13 / s33, s22 - s23 * s23 / s33, s44 - s34 * s34 / s33
