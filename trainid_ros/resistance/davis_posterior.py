# SPDX-License-Identifier: Apache-2.0
"""Posterior of the Davis parameters in plain floats: drift, prediction, and the published estimate.

A :data:`DavisPosterior` is a Gaussian estimate as a tuple of nine floats: a, b, c, then the upper triangle of their
covariance, row by row, in N/kN with v in m/s. The regressor is [1, v, s] with s the mean of v^2. Floats are used
since arrays of three cost more than the arithmetic.
"""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.results import ResistanceEstimate

DavisPosterior = tuple[float, ...]

_SECONDS_PER_HOUR: Final = 3600.0
# Intervals of the speeds at which the largest standard deviation is sought.
_INTERVALS: Final = 8


def drift_growth(share: float) -> float:
    """Return the growth of a variance per second as a share of the prior one [1/s]; share as in drift_rates."""
    return share**2 / _SECONDS_PER_HOUR


def drift_rates(share: float, prior: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the growth of three variances per second.

    Args:
        share: Standard deviation of the drift in one hour as a share of the prior one [1].
        prior: Prior variances.

    """
    growth = drift_growth(share)
    a, b, c = prior
    return growth * a, growth * b, growth * c


def drifted(
    estimate: DavisPosterior, rates: tuple[float, float, float], elapsed_s: float, limits: tuple[float, float, float]
) -> DavisPosterior:
    """Return an estimate after a random walk of the parameters.

    Args:
        estimate: Estimate before.
        rates: Growth of the three variances per second.
        elapsed_s: Elapsed time [s].
        limits: Upper limits of the variances; limiting keeps the correlations.

    """
    a, b, c, A, B, C, D, E, F = estimate
    A, D, F = A + rates[0] * elapsed_s, D + rates[1] * elapsed_s, F + rates[2] * elapsed_s
    if limits[0] >= A and limits[1] >= D and limits[2] >= F:
        return a, b, c, A, B, C, D, E, F
    r0, r1, r2 = (min(1.0, math.sqrt(limit / P)) for limit, P in zip(limits, (A, D, F), strict=True))
    return a, b, c, A * r0 * r0, B * r0 * r1, C * r0 * r2, D * r1 * r1, E * r1 * r2, F * r2 * r2


def predict(estimate: DavisPosterior, v: float, s: float) -> tuple[float, float]:
    """Return mean [N/kN] and variance [(N/kN)^2] of a + b v + c s at speed v [m/s] and mean square speed s."""
    a, b, c, A, B, C, D, E, F = estimate
    variance = A + v * (2.0 * (B + E * s) + D * v) + s * (2.0 * C + F * s)
    return a + b * v + c * s, max(variance, 0.0)


def largest_std(covariance: tuple[float, ...], driven: tuple[float, float], present: float) -> float:
    """Return the largest standard deviation of w [N/kN]: at nine of the speeds learned from, and now.

    Args:
        covariance: Of (a, b, c), 3x3, row-major.
        driven: Slowest and fastest speed learned from [m/s].
        present: Standard deviation at the present speed [N/kN].

    """
    A, B, C, _, D, E, _, _, F = covariance
    largest = 0.0
    for k in range(_INTERVALS + 1):
        v = driven[0] + (driven[1] - driven[0]) * k / _INTERVALS
        largest = max(largest, A + v * (2.0 * B + v * (2.0 * C + D + v * (2.0 * E + v * F))))
    return max(present, math.sqrt(largest))


def resistance_estimate(
    posterior: DavisPosterior,
    speed: float,
    innovation: tuple[float, float, float],
    driven: tuple[float, float],
    force: tuple[float, float, float, float] = (math.nan, math.nan, math.nan, math.nan),
) -> ResistanceEstimate:
    """Return what is published.

    Args:
        posterior: Posterior of a, b, c.
        speed: Present speed [m/s].
        innovation: Innovation of the last update [N/kN], its variance, and its test ratio [1].
        driven: Slowest and fastest speed learned from [m/s].
        force: Scale of the force [1], its standard deviation, delay of the force [s], its standard deviation.

    """
    a, b, c, A, B, C, D, E, F = posterior
    resistance, variance = predict(posterior, speed, speed * speed)
    nu, S, test_ratio = innovation
    slowest, fastest = driven
    scale, scale_std, delay, delay_std = force
    covariance = A, B, C, B, D, E, C, E, F
    return ResistanceEstimate(
        a=a,
        b=b,
        c=c,
        covariance=covariance,
        resistance=resistance,
        resistance_std=math.sqrt(variance),
        speed=speed,
        innovation=nu,
        innovation_variance=S,
        test_ratio=test_ratio,
        speed_min=slowest,
        speed_max=fastest,
        resistance_std_max=largest_std(covariance, driven, math.sqrt(variance)),
        force_scale=scale,
        force_scale_std=scale_std,
        force_delay=delay,
        force_delay_std=delay_std,
    )
