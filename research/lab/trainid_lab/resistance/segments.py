# SPDX-License-Identifier: Apache-2.0
"""Observed resistance from pieces of recorded speed (Liu et al. 2018, section 2.2 and Fig. 2).

The difference of two neighbouring speeds (6) is mostly noise, so a line is fitted through a piece of the record.

* :class:`Segments` are those of Fig. 2: a piece ends once the measured speed has changed by ``change``, and the
  next one starts from its middle (by index; the paper does not define it). A piece that ends where noise first
  carries the speed over a limit is too steep on average, so the observed resistance is too high: by 0.04 N/kN at
  25 km/h and 0.2 N/kN at 75 km/h with a tachometer resolution of 0.1 km/h. Its noise also grows with speed.
* :class:`Windows` have a fixed number of samples and no such bias.

The resistance of a piece is ``w0 = 1000 F/(M g) - 1000 (1 + gamma) alpha/g - i``. The paper's (5), -100 alpha - i,
omits the rotating masses and uses g = 10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.train.forces import specific_inertia

Array = NDArray[np.float64]
# Rounded speeds differ by whole quanta; without this tolerance, 62.3 - 61.8 falls short of 0.5.
_ROUNDING = 1e-9


class HasSpeed(Protocol):
    """Anything with a measured speed."""

    @property
    def speed(self) -> float:
        """Measured speed, in the unit of the record."""


Item = TypeVar('Item', bound=HasSpeed)


class Cutter(Protocol):
    """A rule that cuts a stream into pieces."""

    def ends(self, piece: Sequence[HasSpeed]) -> bool:
        """Return whether a piece is complete with its last item."""

    def next_start(self, length: int) -> int:
        """Return the offset of the next piece from the start of a piece of that length, in items."""

    @property
    def longest(self) -> int:
        """Maximum number of pending items."""


@dataclass(frozen=True, slots=True)
class Segments:
    """Segments of Fig. 2: a piece ends when the measured speed differs from its first by ``change``.

    ``change`` is in the unit of the speeds. At most ``longest`` samples are kept while the speed hardly changes.
    """

    change: float
    longest: int = 250

    def ends(self, piece: Sequence[HasSpeed]) -> bool:
        """Return whether the last speed differs from the first by at least ``change``."""
        return abs(piece[-1].speed - piece[0].speed) >= self.change - _ROUNDING

    def next_start(self, length: int) -> int:
        """Return the middle."""
        return max(1, (length - 1) // 2)


@dataclass(frozen=True, slots=True)
class Windows:
    """A piece ends with its ``length``-th sample; the next one starts ``hop`` samples after it did."""

    length: int
    hop: int

    @property
    def longest(self) -> int:
        """The length."""
        return self.length

    def __post_init__(self) -> None:
        """Raise InputError if the hop is not within [1, length]."""
        if not 1 <= self.hop <= self.length:
            raise InputError(f'hop = {self.hop} must lie in [1, window = {self.length}]')

    def ends(self, piece: Sequence[HasSpeed]) -> bool:
        """Return whether the piece has all its samples."""
        return len(piece) >= self.length

    def next_start(self, length: int) -> int:
        """Return the hop."""
        return min(self.hop, length)


def cut(pending: tuple[Item, ...], item: Item, cutter: Cutter) -> tuple[tuple[Item, ...], tuple[Item, ...]]:
    """Add one item of a stream.

    Returns:
        The items pending now, and the piece that the item completes, empty if none.

    """
    piece = (*pending, item)[-cutter.longest :]
    if len(piece) < 2 or not cutter.ends(piece):
        return piece, ()
    return piece[cutter.next_start(len(piece)) :], piece


@dataclass(frozen=True, slots=True)
class Observations:
    """Observed resistance of pieces; arrays of shape (pieces,)."""

    v: Array  # Mean speed, in the unit of the record
    y: Array  # Observed resistance [N/kN]
    # S_tt, sum of squared times from the middle of the piece [s^2]; the variance of y due to white speed noise is
    # inversely proportional to it.
    weight: Array

    def regressors(self) -> Array:
        """Return [1, v, v^2] of (2), shape (pieces, 3)."""
        return np.stack([np.ones_like(self.v), self.v, self.v**2], axis=1)


def bounds(speed: Array, cutter: Cutter) -> list[tuple[int, int]]:
    """Return start and end (exclusive) indices of all complete pieces of one record of shape (samples,)."""
    if isinstance(cutter, Windows):
        return [(i, i + cutter.length) for i in range(0, len(speed) - cutter.length + 1, cutter.hop)]
    items = [_Speed(float(value)) for value in speed]
    found, pending = [], tuple[_Speed, ...]()
    for end, item in enumerate(items, 1):
        pending, piece = cut(pending, item, cutter)
        if piece:
            found.append((end - len(piece), end))
    return found


def observe(
    records: Sequence[Array] | Array,
    cutter: Cutter,
    *,
    period: float,
    rotary_mass: float,
    speed_unit: float = 1.0,
    gradient: float = 0.0,
) -> Observations:
    """Return the resistance of a coasting train observed in records of its speed, one for each coasting run.

    Args:
        records: Speeds, each of shape (samples,), in any unit.
        cutter: Rule that cuts them into pieces.
        period: Time between samples [s].
        rotary_mass: Share of the rotating masses, gamma [1].
        speed_unit: Unit of the speeds [m/s], 1/3.6 for km/h.
        gradient: Gradient i [per mille].

    """
    pieces = [speed[start:end] for speed in records for start, end in bounds(speed, cutter)]
    rows = np.array([_slope(piece, period) for piece in pieces]).reshape(-1, 3)
    v, slope, S_tt = rows.T
    acceleration = speed_unit * slope
    # (5), corrected
    y = -specific_inertia(1.0, rotary_mass) * acceleration - gradient
    return Observations(v, y, S_tt)


def difference(
    records: Sequence[Array] | Array, *, period: float, rotary_mass: float, speed_unit: float = 1.0
) -> Observations:
    """Return the resistance observed in the differences of neighbouring speeds, (6); see :func:`observe`."""
    pairs = Windows(length=2, hop=1)
    return observe(records, pairs, period=period, rotary_mass=rotary_mass, speed_unit=speed_unit)


def _slope(piece: Array, period: float) -> tuple[float, float, float]:
    """Return mean, least-squares slope and S_tt of a piece."""
    time = period * (np.arange(len(piece)) - 0.5 * (len(piece) - 1))
    S_tt = float(time @ time)
    return float(piece.mean()), float(time @ piece) / S_tt, S_tt


@dataclass(frozen=True, slots=True)
class _Speed:
    speed: float
