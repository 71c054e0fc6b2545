# SPDX-License-Identifier: Apache-2.0
"""Data with sensor faults: observations (v, y) in white noise, and the speeds of coasts.

Shares refer to samples. Bursts are 5 to 15 samples long. A bad observation has an error of 4 to 20 N/kN: in ``sym`` of
random sign, in ``one`` positive, in ``burst`` positive and constant over the burst, in ``slip`` negative in the first
half of a burst and positive in the second, as by a wheel that slips and regains adhesion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from research.papers.coasts import KMH, CoastPlan, Coasts, white_observations

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
SpeedKind = Callable[[Array, float, np.random.Generator], Array]
NOISE_STD: Final = 0.75
_BURST: Final = (5, 15)
_ERROR: Final = (4.0, 20.0)
_ERROR_V: Final = (1.0, 12.0)
"""Size of a spike or slip of the speed [km/h]."""


@dataclass(frozen=True, slots=True)
class Spoil:
    """A kind of bad data with its share, and the share of missing data."""

    name: str
    kind: str = ''
    share: float = 0.0
    missing: float = 0.0
    in_bursts: bool = False


OBSERVED: Final = (
    Spoil('clean'),
    Spoil('10 % symmetric', 'sym', 0.1),
    Spoil('30 % symmetric', 'sym', 0.3),
    Spoil('30 % one-sided', 'one', 0.3),
    Spoil('30 % one-sided bursts', 'burst', 0.3),
    Spoil('30 % slip bursts', 'slip', 0.3),
    Spoil('50 % missing', missing=0.5),
    Spoil('30 % one-sided + 50 % missing', 'one', 0.3, missing=0.5),
)
SPEEDS: Final = (
    Spoil('clean'),
    Spoil('spike 30 %', 'spike', 0.3),
    Spoil('zero 20 % bursts', 'zero', 0.2),
    Spoil('hold 20 % bursts', 'hold', 0.2),
    Spoil('slip 30 %', 'slip', 0.3),
    Spoil('missing 50 % bursts', missing=0.5, in_bursts=True),
    Spoil('slip 20 % + missing 30 %', 'slip', 0.2, missing=0.3),
)


@dataclass(frozen=True, slots=True)
class Observations:
    """Speeds [m/s], observed resistances [N/kN] and which of them are good; missing ones are omitted."""

    v: Array
    y: Array
    good: Flags


def spoiled_observations(spoil: Spoil, truth: tuple[float, float, float], rng: np.random.Generator) -> Observations:
    """Return 1032 observations in white noise with faults."""
    v, y = white_observations(CoastPlan(truth), rng, NOISE_STD)
    error = np.zeros(y.size)
    if spoil.kind in ('burst', 'slip'):
        for start, stop in bursts(y.size, spoil.share, rng):
            size = rng.uniform(*_ERROR)
            middle = (start + stop) // 2
            error[start:stop] = size
            if spoil.kind == 'slip':
                error[start:middle] = -size
    elif spoil.kind:
        bad = rng.random(y.size) < spoil.share
        sign = rng.choice((-1.0, 1.0), y.size) if spoil.kind == 'sym' else 1.0
        error = np.where(bad, sign * rng.uniform(*_ERROR, y.size), 0.0)
    kept = rng.random(y.size) >= spoil.missing
    return Observations(v[kept] * KMH, (y + error)[kept], (error == 0.0)[kept])


def spoiled_speeds(spoil: Spoil, coasts: Coasts, rng: np.random.Generator) -> Array:
    """Return the measured speeds of coasts with faults [km/h]; NaN is missing."""
    rows = [_SPEED_KINDS[spoil.kind](row, spoil.share, rng) for row in coasts.speed]
    for row in rows:
        if spoil.in_bursts:
            for start, stop in bursts(row.size, spoil.missing, rng):
                row[start:stop] = math.nan
        else:
            row[rng.random(row.size) < spoil.missing] = math.nan
    return np.array(rows)


def bursts(count: int, share: float, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return start and end of bursts that cover a share of the samples; gaps are exponential."""
    low, high = _BURST
    mean_gap = 0.5 * (low + high) * (1.0 - share) / share
    found, at = [], round(rng.exponential(mean_gap))
    while at < count:
        stop = min(at + int(rng.integers(low, high + 1)), count)
        found.append((at, stop))
        at = stop + 1 + round(rng.exponential(mean_gap))
    return found


def _plain(row: Array, _share: float, _rng: np.random.Generator) -> Array:
    return row.copy()


def _spikes(row: Array, share: float, rng: np.random.Generator) -> Array:
    spike = rng.uniform(*_ERROR_V, row.size) * rng.choice((-1.0, 1.0), row.size)
    return np.where(rng.random(row.size) < share, row + spike, row)


def _in_bursts(fill: Callable[[Array, int, int, np.random.Generator], Array | float]) -> SpeedKind:
    """Return what replaces the speeds in bursts; ``fill`` gets the true speeds, start and end."""

    def spoiled(row: Array, share: float, rng: np.random.Generator) -> Array:
        bad = row.copy()
        for start, stop in bursts(row.size, share, rng):
            bad[start:stop] = fill(row, start, stop, rng)
        return bad

    return spoiled


def _slip(row: Array, start: int, stop: int, rng: np.random.Generator) -> Array:
    """Return speeds with a slip of 1 to 12 km/h that rises slowly and falls fast."""
    place = np.arange(1, stop - start + 1) / (stop - start + 1.0)
    return np.asarray(row[start:stop] + rng.uniform(*_ERROR_V) * np.interp(place, (0.0, 0.7, 1.0), (0.0, 1.0, 0.0)))


_SPEED_KINDS: Final[dict[str, SpeedKind]] = {
    '': _plain,
    'spike': _spikes,
    'zero': _in_bursts(lambda _row, _start, _stop, _rng: 0.0),
    'hold': _in_bursts(lambda row, start, _stop, _rng: row[max(start - 1, 0)]),
    'slip': _in_bursts(_slip),
}
