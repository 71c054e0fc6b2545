# SPDX-License-Identifier: Apache-2.0
"""Observability of w(v) = a + b v + c v^2: how well the data determine each parameter, and over which speeds w(v).

Parameters alone can mislead: driven at one speed, w is known there while a, b and c are not. So each is judged by the
relative reduction of its prior variance, and w by its standard deviation inside and outside the range of speeds seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

_NAMES: Final = ('a', 'b', 'c')
SEEN_SHARE: Final = 0.5
"""Relative reduction of the prior variance from which a parameter counts as seen [1]."""
# A parameter is noticeable where its standard deviation changes w by this many standard deviations of w.
_NOTICEABLE: Final = 2.0
# w counts as known where its standard deviation is at most this many times the largest one over the speeds seen.
_KNOWN_FACTOR: Final = 2.0
_GRID_M_S: Final = 0.5
REACH_M_S: Final = 25.0
"""Fastest speed at which w is judged by default [m/s]."""


@dataclass(frozen=True, slots=True)
class Observability:
    """How well the data determine w(v)."""

    # Relative reductions of the prior variances of a, b, c [1], from 0 (nothing learned) to 1
    shares: tuple[float, float, float]
    std_observed: float  # Largest standard deviation of w over the speeds seen [N/kN]; NaN if there are none
    std_outside: float  # Largest standard deviation of w over all other speeds up to the reach [N/kN]
    # Range of speeds around those seen where w is known nearly as well [m/s]; NaN if there are none
    known: tuple[float, float]
    text: str  # Summary as text


def resistance_std(covariance: Sequence[float], speed: float) -> float:
    """Return the standard deviation of w [N/kN] at a speed [m/s]; ``covariance`` is 3x3, row-major."""
    phi = (1.0, speed, speed * speed)
    # Not sum(), whose rounding depends on the version of Python.
    return math.sqrt(max(0.0, math.fsum(phi[i] * phi[j] * covariance[3 * i + j] for i in range(3) for j in range(3))))


def observe(
    covariance: Sequence[float],
    prior_covariance: Sequence[float],
    speed_min: float,
    speed_max: float,
    reach: float = REACH_M_S,
) -> Observability:
    """Judge how well a, b, c and w(v) are determined.

    Args:
        covariance: Present covariance of a, b, c, 3x3, row-major.
        prior_covariance: Covariance before the first sample, likewise.
        speed_min: Slowest speed learned from [m/s].
        speed_max: Fastest speed learned from [m/s]; 0 if nothing was learned.
        reach: Fastest speed at which w is needed [m/s].
    """
    shares = tuple(_share(covariance[4 * i], prior_covariance[4 * i]) for i in range(3))
    if not speed_max > 0.0:
        nothing = 'nothing seen yet: estimates are the prior'
        return Observability((0.0, 0.0, 0.0), math.nan, math.nan, (math.nan, math.nan), nothing)
    top = max(reach, speed_max)
    speeds = [_GRID_M_S * k for k in range(int(top / _GRID_M_S) + 1)]
    seen = [speed_min, *(v for v in speeds if speed_min < v < speed_max), speed_max]
    std_observed = max(resistance_std(covariance, v) for v in seen)
    outside = [v for v in (*speeds, top) if not speed_min <= v <= speed_max]
    std_outside = max((resistance_std(covariance, v) for v in outside), default=0.0)
    known = _known_range(covariance, speeds, speed_min, speed_max, _KNOWN_FACTOR * std_observed)
    text = _summary(shares, covariance, std_observed, (speed_min, speed_max, top))
    return Observability((shares[0], shares[1], shares[2]), std_observed, std_outside, known, text)


def _share(variance: float, prior: float) -> float:
    return min(1.0, max(0.0, 1.0 - variance / prior)) if prior > 0.0 else 0.0


def _known_range(
    covariance: Sequence[float], speeds: Sequence[float], low: float, high: float, limit: float
) -> tuple[float, float]:
    """Return the range of speeds around those seen where the standard deviation of w stays within a limit [m/s]."""
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


def _summary(
    shares: Sequence[float], covariance: Sequence[float], std_observed: float, speeds: tuple[float, float, float]
) -> str:
    slowest, fastest, top = speeds
    seen = [name for name, share in zip(_NAMES, shares, strict=True) if share >= SEEN_SHARE]
    parts = [f'{_listed(seen)} seen'] if seen else []
    confounded = []
    for power, name in enumerate(_NAMES):
        if name in seen:
            continue
        # From this speed on the parameter's uncertainty would show against that of w at the speeds seen.
        std = math.sqrt(max(covariance[4 * power], 0.0))
        shows = (_NOTICEABLE * std_observed / std) ** (1.0 / power) if power and std > 0.0 else 0.0
        if shows > top:
            parts.append(f'{name} not seen up to {top:.0f} m/s')
        elif shows > fastest:
            parts.append(f'{name} not seen below {shows:.0f} m/s')
        else:
            confounded.append(name)
    if confounded:
        parts.append(f'{_listed(confounded)} not distinguishable from the others')
    return f'{", ".join(parts)}: speeds seen {slowest:.1f} to {fastest:.1f} m/s'


def _listed(names: Sequence[str]) -> str:
    return ' and '.join((', '.join(names[:-1]), names[-1])) if len(names) > 1 else names[0]
