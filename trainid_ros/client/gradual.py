# SPDX-License-Identifier: Apache-2.0
"""Values that never jump: a normal distribution that moves to each new one at a bounded rate.

On its way from (m0, P0) to (m, P), with the share g of the way done, d = m - m0 and q = (1 - g)^2,

    mean = m0 + g d,        covariance = P + q (d d' + R),        R = positive part of P0 - P - d d'.

So the standard deviation covers what is left of the way in every direction. It rises at once by what it must cover,
and then falls gradually. The positive part is taken in units of the train file's standard deviations.

A move that must end within a stated time is one to the train file, which is less certain: the covariance goes straight
from P0 to P then, so that no bound is beyond both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MOST_RATE: Final = 0.25
"""Largest rate of change towards a live value, in standard deviations of the train file's value per second."""

ABSURD: Final = 1e6
"""Larger magnitudes are treated as invalid."""
# A train file may state a value without any uncertainty: its moves are measured in this share of it [1].
_LEAST_SHARE: Final = 0.01
_TINY: Final = 1e-9
# A correlation may be wrong by this much [1].
_ROUNDING: Final = 1e-6


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
        """Return whether no number is absurd, NaN included, and no weighted sum has a negative variance."""
        n = len(self.mean)
        numbers = all(abs(x) < ABSURD for x in (*self.mean, *self.covariance))
        return numbers and len(self.covariance) == n * n and _is_covariance(np.reshape(self.covariance, (n, n)))


def _is_covariance(P: NDArray[np.float64]) -> bool:
    """Return whether a matrix is symmetric and positive semidefinite, but for rounding."""
    variances = np.diag(P)
    if variances.min() < 0.0:
        return False
    stds = np.sqrt(variances)
    most = np.outer(stds, stds)
    if np.any(np.abs(P) > (1.0 + _ROUNDING) * most) or np.any(np.abs(P - P.T) > _ROUNDING * most):
        return False
    units = np.where(most > 0.0, most, 1.0)
    return bool(np.linalg.eigvalsh(P / units)[0] >= -_ROUNDING)


def _product(x: float, y: float) -> float:
    return x * y


def _difference(x: float, y: float) -> float:
    return x - y


def _difference_of(start: Normal, target: Normal) -> tuple[float, ...]:
    return tuple(map(_difference, start.covariance, target.covariance))


class Gradual:
    """Follows the newest distribution.

    Args:
        start: Distribution of the train file, until there is another.
        probes: Directions in which a move is measured: its duration is that of the slowest.

    """

    def __init__(self, start: Normal, probes: Sequence[Sequence[float]]) -> None:
        self._file, self._to = start, start
        self._probes = probes
        self._way: tuple[float, ...] = ()
        self._excess: tuple[float, ...] = ()
        self._power = 2
        self._begin_s, self._duration_s = 0.0, 0.0
        self._unit = np.sqrt(np.array(start.covariance[:: len(start.mean) + 1])) + _TINY

    def left_s(self, time_s: float) -> float:
        """Return the time from a time [s] until the newest distribution is reached [s]."""
        return max(0.0, self._begin_s + self._duration_s - time_s)

    def go_to(self, target: Normal, time_s: float, longest_s: float = math.inf) -> None:
        """Move to a distribution from a time [s] on, within ``longest_s`` [s]."""
        start = self.at(time_s)
        self._to, self._begin_s = target, time_s
        self._duration_s = min(self._longest_way(start, target) / MOST_RATE, longest_s)
        self._way = tuple(map(_difference, target.mean, start.mean))
        self._power = 2 if math.isinf(longest_s) else 1
        if self._duration_s > 0.0:
            self._excess = self._uncovered(start) if self._power == 2 else _difference_of(start, target)

    def at(self, time_s: float) -> Normal:
        """Return the distribution at a time [s], which is not before the last :meth:`go_to`."""
        left = self.left_s(time_s) / self._duration_s if self._duration_s > 0.0 else 0.0
        if left <= 0.0:
            return self._to
        left = min(left, 1.0)
        mean = tuple(map(lambda value, step: value - left * step, self._to.mean, self._way))
        q = left**self._power
        return Normal(mean, tuple(map(lambda P, X: P + q * X, self._to.covariance, self._excess)))

    def _uncovered(self, start: Normal) -> tuple[float, ...]:
        """Return d d' + R, row-major."""
        d, n = np.array(self._way), len(self._way)
        square = np.outer(d, d)
        more = np.reshape(start.covariance, (n, n)) - np.reshape(self._to.covariance, (n, n)) - square
        values, vectors = np.linalg.eigh(more / np.outer(self._unit, self._unit))
        root = self._unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return tuple((square + root @ root.T).ravel().tolist())

    def _longest_way(self, start: Normal, target: Normal) -> float:
        """Return the longest way of a value, or down of its standard deviation, in those of the train file."""
        longest = 0.0
        for probe in self._probes:
            (before, old), (after, new), unit = (x.along(probe) for x in (start, target, self._file))
            change = max(abs(after - before), math.sqrt(old) - math.sqrt(new))
            longest = max(longest, change / max(math.sqrt(unit[1]), _LEAST_SHARE * abs(unit[0]), _TINY))
        return longest
