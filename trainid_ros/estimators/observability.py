# SPDX-License-Identifier: Apache-2.0
"""What of w(v) = a + b v + c v^2 the data have shown: each parameter in numbers and words, and how far w(v) reaches.

Parameters alone can mislead: driven at one speed, w is known there while a, b and c are not. So each is judged by the
share of its prior variance that is gone, and the whole by the standard deviation of w over the speeds seen and outside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

_NAMES: Final = ('a', 'b', 'c')
# A parameter counts as seen once half of its prior variance is gone.
_SEEN: Final = 0.5
# Standard deviations of w by which a parameter must move it to show.
_SHOWS: Final = 2.0
# Where w counts as known: its deviation is at most this many times that over the speeds seen.
_KNOWN: Final = 2.0
_GRID_M_S: Final = 0.5
REACH_M_S: Final = 25.0


@dataclass(frozen=True, slots=True)
class Observability:
    """What has been seen.

    Attributes:
        shares: Shares of the prior variances of a, b, c that are gone, 0 (nothing seen) to 1.
        std_seen: Largest standard deviation of w over the speeds seen [N/kN]; NaN if there are none.
        std_outside: The same over all other speeds up to the reach [N/kN].
        known: Speeds around those seen over which w is known nearly as well [m/s]; NaN if there are none.
        text: The same in words.

    """

    shares: tuple[float, float, float]
    std_seen: float
    std_outside: float
    known: tuple[float, float]
    text: str


def resistance_std(covariance: Sequence[float], speed: float) -> float:
    """Return the standard deviation of w [N/kN] at a speed [m/s]; ``covariance`` is 3x3, row-major."""
    phi = (1.0, speed, speed * speed)
    return math.sqrt(max(0.0, sum(phi[i] * phi[j] * covariance[3 * i + j] for i in range(3) for j in range(3))))


def observe(
    covariance: Sequence[float],
    prior_covariance: Sequence[float],
    speed_min: float,
    speed_max: float,
    reach: float = REACH_M_S,
) -> Observability:
    """Judge what has been seen of a, b and c.

    Args:
        covariance: Of a, b, c now, 3x3, row-major.
        prior_covariance: The same before the first sample.
        speed_min: Slowest speed learned from [m/s].
        speed_max: Fastest one; 0 if nothing was learned.
        reach: Fastest speed at which w is asked for [m/s].

    """
    shares = tuple(_share(covariance[4 * i], prior_covariance[4 * i]) for i in range(3))
    if not speed_max > 0.0:
        nothing = 'nothing seen yet: the prior holds'
        return Observability((0.0, 0.0, 0.0), math.nan, math.nan, (math.nan, math.nan), nothing)
    top = max(reach, speed_max)
    speeds = [_GRID_M_S * k for k in range(int(top / _GRID_M_S) + 1)]
    seen = [speed_min, *(v for v in speeds if speed_min < v < speed_max), speed_max]
    std_seen = max(resistance_std(covariance, v) for v in seen)
    outside = [v for v in (*speeds, top) if not speed_min <= v <= speed_max]
    std_outside = max((resistance_std(covariance, v) for v in outside), default=0.0)
    known = _known(covariance, speeds, speed_min, speed_max, _KNOWN * std_seen)
    text = _words(shares, covariance, std_seen, speed_min, speed_max)
    return Observability((shares[0], shares[1], shares[2]), std_seen, std_outside, known, text)


def _share(variance: float, prior: float) -> float:
    return min(1.0, max(0.0, 1.0 - variance / prior)) if prior > 0.0 else 0.0


def _known(
    covariance: Sequence[float], speeds: Sequence[float], low: float, high: float, limit: float
) -> tuple[float, float]:
    """Return how far around the speeds seen the standard deviation of w stays within a limit."""
    slowest, fastest = low, high
    for v in reversed([v for v in speeds if v < low]):
        if resistance_std(covariance, v) > limit:
            break
        slowest = v
    for v in (v for v in speeds if v > high):
        if resistance_std(covariance, v) > limit:
            break
        fastest = v
    return slowest, fastest


def _words(
    shares: Sequence[float], covariance: Sequence[float], std_seen: float, speed_min: float, speed_max: float
) -> str:
    seen = [name for name, share in zip(_NAMES, shares, strict=True) if share >= _SEEN]
    told = [f'{_listed(seen)} seen'] if seen else []
    apart = []
    for power, name in enumerate(_NAMES):
        if name in seen:
            continue
        # From this speed on what is doubted of the parameter would show beside the doubt of w where it is known.
        doubt = math.sqrt(max(covariance[4 * power], 0.0))
        shows = (_SHOWS * std_seen / doubt) ** (1.0 / power) if power and doubt > 0.0 else 0.0
        if shows > speed_max:
            told.append(f'{name} not seen below {shows:.0f} m/s')
        else:
            apart.append(name)
    if apart:
        told.append(f'{_listed(apart)} not told apart from the others')
    return f'{", ".join(told)}: speeds seen {speed_min:.1f} to {speed_max:.1f} m/s'


def _listed(names: Sequence[str]) -> str:
    return ' and '.join((', '.join(names[:-1]), names[-1])) if len(names) > 1 else names[0]
