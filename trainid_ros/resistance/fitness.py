# SPDX-License-Identifier: Apache-2.0
"""Test whether a resistance is fit to use: known well enough over the observed speeds, with hysteresis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.resistance.davis_posterior import DavisPosterior, predict

# An estimate that is fit stays so up to this multiple of the limit, so that the status does not flicker.
_HYSTERESIS: Final = 1.5


def representative_speeds(slowest: float, fastest: float) -> tuple[float, float, float]:
    """Return the speeds at which :func:`is_fit` needs the variance of the resistance [m/s]."""
    return slowest, 0.5 * (slowest + fastest), fastest


def is_fit(variances: tuple[float, float, float], valid_std: float, *, was_fit: bool) -> bool:
    """Return whether the standard deviation of w, in root mean square over the observed speeds, is small enough.

    Args:
        variances: Variance of the resistance at the :func:`representative_speeds` [(N/kN)^2].
        valid_std: Largest standard deviation of a resistance that is fit to use [N/kN].
        was_fit: Whether it was fit so far.

    """
    at_slowest, between, at_fastest = variances
    rms = math.sqrt((at_slowest + between + at_fastest) / 3.0)
    return rms < valid_std * (_HYSTERESIS if was_fit else 1.0)


@dataclass(slots=True)
class DrivenSpeeds:
    """Moments of all speeds used for estimation.

    Attributes:
        count: Number of speeds.
        slowest: Slowest speed [m/s], 0 before the first.
        fastest: Fastest speed [m/s].
        m1: Mean of v [m/s].
        m2: Mean of v^2 [(m/s)^2].
        m3: Mean of v^3 [(m/s)^3].
        m4: Mean of v^4 [(m/s)^4].

    """

    count: int = 0
    slowest: float = 0.0
    fastest: float = 0.0
    m1: float = 0.0
    m2: float = 0.0
    m3: float = 0.0
    m4: float = 0.0

    def add(self, v: float) -> None:
        """Add one speed [m/s]."""
        self.add_mean(v, v, v)

    def add_mean(self, v: float, slowest: float, fastest: float) -> None:
        """Add the mean of speeds from slowest to fastest [m/s]."""
        self.slowest = min(self.slowest, slowest) if self.count else slowest
        self.fastest = max(self.fastest, fastest)
        self.count += 1
        square = v * v
        share = 1.0 / self.count
        self.m1 += share * (v - self.m1)
        self.m2 += share * (square - self.m2)
        self.m3 += share * (square * v - self.m3)
        self.m4 += share * (square * square - self.m4)

    def is_valid(self) -> bool:
        """Return whether the numbers are possible moments of speeds."""
        return (
            self.count >= 0 and 0.0 <= self.slowest <= self.fastest and min(self.m1, self.m2, self.m3, self.m4) >= 0.0
        )


def is_fit_where_driven(
    posterior: DavisPosterior, driven: DrivenSpeeds, valid_std: float, valid_share: float, *, was_fit: bool
) -> bool:
    """Return whether the standard deviation of w, in root mean square over the driven speeds, is small enough.

    Each speed counts as often as it was driven.

    Args:
        posterior: Posterior of a, b, c.
        driven: Moments of the driven speeds.
        valid_std: Largest standard deviation of a resistance that is fit to use [N/kN].
        valid_share: Largest standard deviation as a share of the resistance [1]; both limits add in squares.
        was_fit: Whether it was fit so far.

    """
    if not driven.count:
        return False
    a, b, c, A, B, C, D, E, F = posterior
    m1, m2, m3, m4 = driven.m1, driven.m2, driven.m3, driven.m4
    # Means of phi' P phi and of w^2 = (phi' theta)^2 with phi = (1, v, v^2).
    variance = A + 2.0 * B * m1 + (2.0 * C + D) * m2 + 2.0 * E * m3 + F * m4
    square = a * a + 2.0 * a * b * m1 + (2.0 * a * c + b * b) * m2 + 2.0 * b * c * m3 + c * c * m4
    limit = valid_std * valid_std + valid_share * valid_share * square
    return variance < limit * (_HYSTERESIS * _HYSTERESIS if was_fit else 1.0)


def is_fit_at(speed: float, posterior: DavisPosterior, valid_std: float, valid_share: float) -> bool:
    """Return whether the standard deviation of w at one speed [m/s] is small enough; limits as for driven speeds."""
    w, variance = predict(posterior, speed, speed * speed)
    return variance < valid_std * valid_std + valid_share * valid_share * w * w
