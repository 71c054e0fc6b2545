# SPDX-License-Identifier: Apache-2.0
"""Values that never jump: a normal distribution that moves to each new one at a bounded rate.

On its way from (m0, P0) to (m, P), with the share g of the way done, d = m - m0 and q = (1 - g)^2,

    mean = m0 + g d,        covariance = s (q P0 + (1 - q) P).

s >= 1 is the least factor with which the standard deviation also covers what is left of the way, P + q d d'. So it
rises at once by what it must cover, and then falls gradually.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

MOST_RATE: Final = 0.25
"""Largest rate of change towards a live value, in standard deviations of the train file's value per second."""

# No parameter of a train has a magnitude like this.
_ABSURD: Final = 1e6


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal distribution of n parameters.

    Attributes:
        mean: Shape (n,).
        covariance: Shape (n, n), row-major.

    """

    mean: tuple[float, ...]
    covariance: tuple[float, ...]

    def along(self, direction: Sequence[float]) -> tuple[float, float]:
        """Return mean and variance of the parameters' sum with these weights, shape (n,)."""
        n = len(self.mean)
        mean = math.fsum(map(_product, direction, self.mean))
        row = (math.fsum(map(_product, self.covariance[n * i : n * i + n], direction)) for i in range(n))
        return mean, max(0.0, math.fsum(map(_product, row, direction)))

    def is_possible(self) -> bool:
        """Return whether no number is absurd, NaN included, and no variance is negative."""
        n = len(self.mean)
        numbers = all(abs(x) < _ABSURD for x in (*self.mean, *self.covariance))
        return numbers and len(self.covariance) == n * n and min(self.covariance[:: n + 1]) >= 0.0


def _product(x: float, y: float) -> float:
    return x * y


class Gradual:
    """Follows the newest distribution.

    Args:
        start: Distribution of the train file, until there is another.
        probes: Directions in which a move is measured: its duration is that of the slowest.

    """

    def __init__(self, start: Normal, probes: Sequence[Sequence[float]]) -> None:
        self._file, self._from, self._to = start, start, start
        self._probes = probes
        self._begin_s, self._duration_s = 0.0, 0.0

    def left_s(self, time_s: float) -> float:
        """Return the time from a time [s] until the newest distribution is reached [s]."""
        return max(0.0, self._begin_s + self._duration_s - time_s)

    def go_to(self, target: Normal, time_s: float, longest_s: float = math.inf) -> None:
        """Move to a distribution from a time [s] on, within ``longest_s`` [s]."""
        self._from = self.at(time_s)
        self._to, self._begin_s = target, time_s
        self._duration_s = min(self._way() / MOST_RATE, longest_s)

    def at(self, time_s: float) -> Normal:
        """Return the distribution at a time [s], which is not before the last :meth:`go_to`."""
        if self.left_s(time_s) <= 0.0:
            return self._to
        g = min(max(0.0, (time_s - self._begin_s) / self._duration_s), 1.0)
        d = [after - before for before, after in zip(self._from.mean, self._to.mean, strict=True)]
        mean = tuple(before + g * step for before, step in zip(self._from.mean, d, strict=True))
        q = (1.0 - g) * (1.0 - g)
        mixed = Normal(
            mean, tuple(map(lambda P0, P: q * P0 + (1.0 - q) * P, self._from.covariance, self._to.covariance))
        )
        scale = 1.0
        for probe in self._probes:
            left = math.fsum(map(_product, probe, d))
            covered, stated = self._to.along(probe)[1] + q * left * left, mixed.along(probe)[1]
            scale = max(scale, covered / stated) if stated > 0.0 else scale
        return Normal(mean, tuple(scale * x for x in mixed.covariance))

    def _way(self) -> float:
        """Return the longest way of value or standard deviation, in standard deviations of the train file."""
        longest = 0.0
        for probe in self._probes:
            (before, old), (after, new), unit = (x.along(probe) for x in (self._from, self._to, self._file))
            change = max(abs(after - before), abs(math.sqrt(new) - math.sqrt(old)))
            longest = max(longest, change / math.sqrt(unit[1]))
        return longest
