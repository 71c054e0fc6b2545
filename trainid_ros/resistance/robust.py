# SPDX-License-Identifier: Apache-2.0
"""Soft outlier gate, and drift and prediction of a, b, c in plain floats.

An observation is good with probability 1 - eps; otherwise it is uniformly distributed over a width of
``OUTLIER_WIDTH`` standard deviations. Its weight is the posterior probability that it is good. A hard gate cannot
recover from a wrong estimate; this one scores how well an estimate predicts, outliers included.

A :data:`DavisPosterior` is a Gaussian estimate as a tuple of nine floats: a, b, c, then the upper triangle of their
covariance, row by row, in N/kN with v in m/s. The regressor is [1, v, s] with s the mean of v^2. Floats are used
since arrays of three cost more than the arithmetic.
"""

from __future__ import annotations

import math
from typing import Final

DavisPosterior = tuple[float, ...]

OUTLIER_WIDTH: Final = 40.0
_ROOT_2PI: Final = math.sqrt(2.0 * math.pi)
# Beyond 37 standard deviations the density of a good observation underflows.
_MAX_NIS: Final = 1400.0


def weigh(nu: float, S: float, R: float, eps: float) -> tuple[float, float]:
    """Return the weight of an observation and the logarithm of its likelihood.

    Args:
        nu: Innovation [N/kN].
        S: Its variance if the observation is good [(N/kN)^2].
        R: Variance of the observation noise, which sets the width of the outlier density [(N/kN)^2].
        eps: Share of outliers [1].

    """
    nis = nu * nu / S
    good = (1.0 - eps) / (_ROOT_2PI * math.sqrt(S)) * math.exp(-0.5 * nis) if nis < _MAX_NIS else 0.0
    likelihood = good + eps / (OUTLIER_WIDTH * math.sqrt(R)) + 1e-300
    return good / likelihood, math.log(likelihood)


def gate(eps: float) -> float:
    """Return the innovation, in standard deviations, at which an observation is good with probability 1/2."""
    return math.sqrt(2.0 * math.log((1.0 - eps) * OUTLIER_WIDTH / (eps * _ROOT_2PI))) if eps > 0.0 else math.inf


def drifted(
    estimate: DavisPosterior, rates: tuple[float, float, float], elapsed_s: float, most: tuple[float, float, float]
) -> DavisPosterior:
    """Return an estimate after a random walk of the parameters.

    Args:
        estimate: Estimate before.
        rates: Growth of the three variances per second.
        elapsed_s: Elapsed time [s].
        most: Upper limits of the variances; limiting keeps the correlations.

    """
    a, b, c, A, B, C, D, E, F = estimate
    A, D, F = A + rates[0] * elapsed_s, D + rates[1] * elapsed_s, F + rates[2] * elapsed_s
    if most[0] >= A and most[1] >= D and most[2] >= F:
        return a, b, c, A, B, C, D, E, F
    r0, r1, r2 = (min(1.0, math.sqrt(limit / P)) for limit, P in zip(most, (A, D, F), strict=True))
    return a, b, c, A * r0 * r0, B * r0 * r1, C * r0 * r2, D * r1 * r1, E * r1 * r2, F * r2 * r2


def predict(estimate: DavisPosterior, v: float, s: float) -> tuple[float, float]:
    """Return mean [N/kN] and variance [(N/kN)^2] of a + b v + c s at speed v [m/s] and mean square speed s."""
    a, b, c, A, B, C, D, E, F = estimate
    variance = A + v * (2.0 * (B + E * s) + D * v) + s * (2.0 * C + F * s)
    return a + b * v + c * s, max(variance, 0.0)
