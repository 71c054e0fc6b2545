# SPDX-License-Identifier: Apache-2.0
"""Test whether a resistance is fit to use: known well enough over the observed speeds, with hysteresis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# An estimate that is fit stays so up to this multiple of the limit, so that the status does not flicker.
_HYSTERESIS: Final = 1.5
_SECONDS_PER_HOUR: Final = 3600.0


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


@dataclass(frozen=True, slots=True)
class DrivenSpeeds:
    """Moments of all speeds used for estimation.

    Attributes:
        count: Number of speeds.
        slowest: Slowest speed [m/s], 0 before the first.
        fastest: Fastest speed [m/s].
        moments: Means of v, v^2, v^3 and v^4 [(m/s)^k].

    """

    count: int = 0
    slowest: float = 0.0
    fastest: float = 0.0
    moments: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def add(self, v: float, slowest: float | None = None, fastest: float | None = None) -> DrivenSpeeds:
        """Return the moments with one more speed [m/s]; v may be the mean of speeds from slowest to fastest."""
        count = self.count + 1
        low, high = v if slowest is None else slowest, v if fastest is None else fastest
        m1, m2, m3, m4 = self.moments
        square = v * v
        share = 1.0 / count
        return DrivenSpeeds(
            count,
            min(self.slowest, low) if self.count else low,
            max(self.fastest, high),
            (
                m1 + share * (v - m1),
                m2 + share * (square - m2),
                m3 + share * (square * v - m3),
                m4 + share * (square * square - m4),
            ),
        )

    def mean_outer(self) -> NDArray[np.float64]:
        """Return the mean of phi phi', phi = (1, v, v^2), shape (3, 3)."""
        m1, m2, m3, m4 = self.moments
        return np.array([[1.0, m1, m2], [m1, m2, m3], [m2, m3, m4]])

    def is_valid(self) -> bool:
        """Return whether the numbers are possible moments of speeds."""
        return self.count >= 0 and 0.0 <= self.slowest <= self.fastest and min(self.moments) >= 0.0


def is_fit_where_driven(
    theta: NDArray[np.float64],
    covariance: NDArray[np.float64],
    driven: DrivenSpeeds,
    valid_std: float,
    valid_share: float,
    *,
    was_fit: bool,
) -> bool:
    """Return whether the standard deviation of w, in root mean square over the driven speeds, is small enough.

    Each speed counts as often as it was driven.

    Args:
        theta: a, b, c [N/kN, v in m/s], shape (3,).
        covariance: Their covariance, shape (3, 3).
        driven: Moments of the driven speeds.
        valid_std: Largest standard deviation of a resistance that is fit to use [N/kN].
        valid_share: Largest standard deviation as a share of the resistance [1]; both limits add in squares.
        was_fit: Whether it was fit so far.

    """
    if not driven.count:
        return False
    M = driven.mean_outer()
    # The mean of phi' S phi is tr(S M), that of w^2 is theta' M theta.
    variance, square = float(np.sum(covariance * M)), float(theta @ M @ theta)
    limit = valid_std**2 + valid_share**2 * square
    return variance < limit * (_HYSTERESIS**2 if was_fit else 1.0)
