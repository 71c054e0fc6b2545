# SPDX-License-Identifier: Apache-2.0
"""Recursive least squares with a soft gate: outliers fade out instead of being cut off.

An observation is good with probability 1 - eps; otherwise it may be anything within a width of
``OUTLIER_WIDTH`` standard deviations. The posterior probability that it is good is its weight. A hard gate has no
way back from a wrong belief; this one keeps score of how well a belief predicts, outliers included.

A belief is a tuple of nine floats: a, b, c, then the upper triangle of their covariance, row by row. The
regressor is [1, v, s] with s the mean of v^2. Floats, since arrays of three cost more than the arithmetic.
"""

from __future__ import annotations

import math
from typing import Final

Belief = tuple[float, ...]

OUTLIER_WIDTH: Final = 40.0
_ROOT_2PI: Final = math.sqrt(2.0 * math.pi)
# Beyond 37 standard deviations the density of a good observation underflows.
_MOST_NIS: Final = 1400.0
_LEAST_WEIGHT: Final = 1e-9


def weigh(nu: float, S: float, R: float, eps: float) -> tuple[float, float]:
    """Return the weight of an observation and the logarithm of its likelihood.

    Args:
        nu: Innovation [N/kN].
        S: Its variance if the observation is good.
        R: Variance of the observation itself, which sets the width of outliers.
        eps: Share of outliers.

    """
    nis = nu * nu / S
    good = (1.0 - eps) / (_ROOT_2PI * math.sqrt(S)) * math.exp(-0.5 * nis) if nis < _MOST_NIS else 0.0
    likelihood = good + eps / (OUTLIER_WIDTH * math.sqrt(R)) + 1e-300
    return good / likelihood, math.log(likelihood)


def soft_update(
    belief: Belief, v: float, s: float, y: float, R: float, slow: float, eps: float
) -> tuple[Belief, float, float]:
    """Return the belief after one observation y = a + b v + c s + noise, its weight and its log likelihood.

    Args:
        belief: What is believed.
        v: Speed in the observation [m/s].
        s: Mean square of the speed in it.
        y: Observed resistance [N/kN].
        R: Variance of its noise.
        slow: How many times R an observation counts in the mean of many, since noise may hang together; 1 if white.
        eps: Share of outliers, 0 for plain least squares.

    """
    a, b, c, A, B, C, D, E, F = belief
    # g = P phi;  S = phi' P phi + R
    g0, g1, g2 = A + B * v + C * s, B + D * v + E * s, C + E * v + F * s
    doubt = g0 + v * g1 + s * g2
    nu = y - a - b * v - c * s
    weight, log_likelihood = weigh(nu, doubt + R, R, eps)
    if weight < _LEAST_WEIGHT:
        return belief, weight, log_likelihood
    # theta += K nu, P -= g g' / (phi' P phi + R / weight): the weight divides the noise
    k = 1.0 / (doubt + slow * R / weight)
    step = k * nu
    k0, k1, k2 = k * g0, k * g1, k * g2
    return (
        (
            a + step * g0,
            b + step * g1,
            c + step * g2,
            A - k0 * g0,
            B - k0 * g1,
            C - k0 * g2,
            D - k1 * g1,
            E - k1 * g2,
            F - k2 * g2,
        ),
        weight,
        log_likelihood,
    )


def gate(eps: float) -> float:
    """Return how many standard deviations off an observation is as likely good as not."""
    return math.sqrt(2.0 * math.log((1.0 - eps) * OUTLIER_WIDTH / (eps * _ROOT_2PI))) if eps > 0.0 else math.inf


def widened(belief: Belief, variances: tuple[float, float, float]) -> Belief:
    """Return a belief with doubt added to each parameter."""
    a, b, c, A, B, C, D, E, F = belief
    return a, b, c, A + variances[0], B, C, D + variances[1], E, F + variances[2]


def drifted(
    belief: Belief, rates: tuple[float, float, float], elapsed_s: float, most: tuple[float, float, float]
) -> Belief:
    """Return a belief after a random walk of the parameters.

    Args:
        belief: What was believed.
        rates: Growth of the three variances per second.
        elapsed_s: Time passed [s].
        most: Variances that doubt does not exceed; where it would, correlations stay.

    """
    a, b, c, A, B, C, D, E, F = belief
    A, D, F = A + rates[0] * elapsed_s, D + rates[1] * elapsed_s, F + rates[2] * elapsed_s
    if most[0] >= A and most[1] >= D and most[2] >= F:
        return a, b, c, A, B, C, D, E, F
    r0, r1, r2 = (min(1.0, math.sqrt(limit / P)) for limit, P in zip(most, (A, D, F), strict=True))
    return a, b, c, A * r0 * r0, B * r0 * r1, C * r0 * r2, D * r1 * r1, E * r1 * r2, F * r2 * r2


def predict(belief: Belief, v: float, s: float) -> tuple[float, float]:
    """Return mean and variance of a + b v + c s."""
    a, b, c, A, B, C, D, E, F = belief
    variance = A + v * (2.0 * (B + E * s) + D * v) + s * (2.0 * C + F * s)
    return a + b * v + c * s, max(variance, 0.0)


def mixed(beliefs: list[Belief], weights: list[float]) -> Belief:
    """Return the belief with mean and covariance of a mixture; weights need not add up to one."""
    total = math.fsum(weights)
    means = [math.fsum(w * h[i] for w, h in zip(weights, beliefs, strict=True)) / total for i in range(3)]
    covariance = [0.0] * 6
    for weight, belief in zip(weights, beliefs, strict=True):
        d0, d1, d2 = (belief[i] - means[i] for i in range(3))
        spread = (d0 * d0, d0 * d1, d0 * d2, d1 * d1, d1 * d2, d2 * d2)
        for i in range(6):
            covariance[i] += weight / total * (belief[3 + i] + spread[i])
    return *means, *covariance
