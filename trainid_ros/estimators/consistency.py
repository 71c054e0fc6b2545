# SPDX-License-Identifier: Apache-2.0
"""Is the published uncertainty true? Squared innovations against the variances stated for them, as they come.

An update whose innovation has the variance stated for it adds a squared ratio of mean 1 (NIS). Over N updates N times
their mean has a chi-squared distribution with N degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001, section 5.4).
Innovations that lean to one side for a while tell less than N: with the correlation rho of neighbours, and rho^k at a
distance of k, the mean of squares varies as that of N (1 - rho^2) / (1 + rho^2) independent ones.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from statistics import NormalDist
from typing import Final

WINDOW: Final = 200
_FEWEST: Final = 30
# The mean of a window lies in its band this often.
_CONFIDENCE: Final = 0.99
_QUANTILE: Final = NormalDist().inv_cdf(0.5 + 0.5 * _CONFIDENCE)
# One update cannot tell more than this many squared standard deviations; it also keeps running sums exact enough.
_MOST: Final = 100.0
# With errors twice as large as stated no estimate is fit to use.
_REFUTED: Final = 4.0
# Beyond this a lean is no noise; and some of the updates must be left to judge by.
_MOST_CORRELATED: Final = 0.9


class Verdict(Enum):
    """What the innovations say of the variances stated."""

    UNKNOWN = 'unknown'
    CONSISTENT = 'consistent'
    OPTIMISTIC = 'optimistic'
    PESSIMISTIC = 'pessimistic'


@dataclass(frozen=True, slots=True)
class Consistency:
    """Outcome of the check.

    Attributes:
        verdict: Optimistic means that errors are larger than stated.
        ratio: Mean of squared innovation over stated variance; 1 if that is true, NaN before the first update.
        low: Lower end of the 99 % band of the ratio if the variances are true.
        high: Its upper end.
        updates: Updates in the window.
        lasting: Updates in a row after which the verdict was optimistic.

    """

    verdict: Verdict
    ratio: float
    low: float
    high: float
    updates: int
    lasting: int

    @property
    def alarming(self) -> bool:
        """True if it has been optimistic for a whole window: no chance event."""
        return self.lasting >= WINDOW

    @property
    def refuted(self) -> bool:
        """True if errors have been more than twice as large as stated for a whole window: the model does not hold."""
        return self.alarming and self.ratio > _REFUTED

    def __str__(self) -> str:
        """Return verdict and numbers, for people."""
        if not self.updates:
            return f'{self.verdict.value} (no innovation with its variance stated)'
        band = f'99 % band {self.low:.2f} to {self.high:.2f}, {self.updates} updates'
        return f'{self.verdict.value} (squared innovations {self.ratio:.2f} times the stated variance; {band})'


_UNJUDGED: Final = Consistency(Verdict.UNKNOWN, math.nan, math.nan, math.nan, 0, 0)


class ConsistencyMonitor:
    """Running check over the last :data:`WINDOW` updates."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all updates."""
        self._z: deque[float] = deque()
        self._squares = 0.0
        self._products = 0.0
        self._last = (0.0, 0.0)
        self._current = _UNJUDGED

    def see(self, innovation: float, variance: float, *, used: bool) -> None:
        """Look at what an estimate states of its last update.

        Args:
            innovation: Measured less predicted.
            variance: Its variance as stated before the measurement came; not above 0 if none is stated.
            used: False if the sample was refused: what a gate throws out is no noise.

        """
        # Not every sample brings an update; the pair stays until the next one.
        if (innovation, variance) == self._last:
            return
        self._last = (innovation, variance)
        if not (used and variance > 0.0 and math.isfinite(variance) and math.isfinite(innovation)):
            return
        self._add(innovation / math.sqrt(variance))
        self._current = self._judged()

    def _add(self, z: float) -> None:
        limit = math.sqrt(_MOST)
        z = min(max(z, -limit), limit)
        if self._z:
            self._products += self._z[-1] * z
        self._z.append(z)
        self._squares += z * z
        if len(self._z) > WINDOW:
            oldest = self._z.popleft()
            self._squares -= oldest * oldest
            self._products -= oldest * self._z[0]

    def current(self) -> Consistency:
        """Return the outcome so far."""
        return self._current

    def _judged(self) -> Consistency:
        count = len(self._z)
        ratio = self._squares / count
        correlation = self._products / self._squares if self._squares > 0.0 else 0.0
        low, high = band(count, correlation)
        if count < _FEWEST:
            verdict = Verdict.UNKNOWN
        elif ratio > high:
            verdict = Verdict.OPTIMISTIC
        else:
            verdict = Verdict.PESSIMISTIC if ratio < low else Verdict.CONSISTENT
        lasting = self._current.lasting + 1 if verdict is Verdict.OPTIMISTIC else 0
        return Consistency(verdict, ratio, low, high, count, lasting)


def band(count: int, correlation: float = 0.0) -> tuple[float, float]:
    """Return the 99 % band of a mean of squared ratios.

    The quantiles of chi-squared are those of Wilson and Hilferty (1931), within 1 % from ten degrees of freedom on.

    Args:
        count: Updates averaged.
        correlation: Correlation of neighbours.

    """
    rho = min(abs(correlation), _MOST_CORRELATED)
    freedom = max(1.0, count * (1.0 - rho * rho) / (1.0 + rho * rho))
    spread = 2.0 / (9.0 * freedom)
    low, high = (max(0.0, 1.0 - spread + sign * _QUANTILE * math.sqrt(spread)) ** 3 for sign in (-1.0, 1.0))
    return low, high
