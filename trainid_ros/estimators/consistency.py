# SPDX-License-Identifier: Apache-2.0
"""Online check of the published uncertainty.

It compares squared innovations with the variances stated for them. If the stated variance is correct, the
normalised innovation squared (NIS) has mean 1. Over N updates N times the mean NIS has a chi-squared distribution with
N degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001, section 5.4). Autocorrelated innovations carry less information:
with the correlation rho between neighbours, and rho^k at lag k, the mean of squares varies like that of N (1 - rho^2) /
(1 + rho^2) independent ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from statistics import NormalDist
from typing import ClassVar, Final

from trainid_ros.interface.state import State, declare, unknown
from trainid_ros.interface.vectors import vec

WINDOW: Final = 200
"""Number of updates judged: 40 s of driving at 5 Hz."""
# Updates from which on there is a verdict: the mean of fewer varies too much.
_MIN_UPDATES: Final = 30
# Normal quantile of a two-sided band of 99 % [std].
_QUANTILE: Final = NormalDist().inv_cdf(0.995)
# Limit of a single normalised innovation [std]; it also keeps the running sums accurate.
_MAX_Z: Final = 10.0


class ConsistencyVerdict(Enum):
    """Result of testing the innovations against their stated variances."""

    UNKNOWN = 'unknown'  # too few innovations
    CONSISTENT = 'consistent'  # variances are as stated
    OPTIMISTIC = 'optimistic'  # errors are larger than stated
    PESSIMISTIC = 'pessimistic'  # errors are smaller than stated


@dataclass(frozen=True, slots=True)
class Consistency:
    """Outcome of the check."""

    verdict: ConsistencyVerdict  # Optimistic means that errors are larger than stated
    # Mean of squared innovation over stated variance [1]; 1 if that is correct, NaN before the first update
    ratio: float
    low: float  # Lower end of the 99 % band of the ratio if the variances are correct [1]
    high: float  # Upper end of the band [1]
    updates: int  # Number of updates in the window
    consecutive: int  # Number of consecutive updates with the verdict optimistic

    @property
    def is_alarm(self) -> bool:
        """True if the verdict has been optimistic for a full window, which is not a chance event."""
        return self.consecutive >= WINDOW

    def __str__(self) -> str:
        """Return verdict and numbers as text."""
        if not self.updates:
            return f'{self.verdict.value} (no innovation with a stated variance)'
        band = f'99 % band {self.low:.2f} to {self.high:.2f}, {self.updates} updates'
        text = f'{self.verdict.value} (squared innovations {self.ratio:.2f} times the stated variance; {band})'
        missed = f'predictions miss by {math.sqrt(self.ratio):.2f} times the stated std'
        if self.verdict is ConsistencyVerdict.OPTIMISTIC:
            return f'{text}: {missed}, so allow for errors as much larger'
        if self.verdict is ConsistencyVerdict.PESSIMISTIC:
            return f'{text}: {missed}, so the stated one is safe, but wider than it need be'
        return text


class ConsistencyMonitor:
    """Checks the last :data:`WINDOW` updates."""

    STATE: ClassVar[State] = declare(
        '_z', '_updates', '_newest', '_squares', '_products', unknown('_innovation'), unknown('_variance'),
        '_consecutive',
    )  # fmt: skip

    def __init__(self) -> None:
        self._z = vec[float]([0.0] * WINDOW)
        self.clear()

    def clear(self) -> None:
        """Forget all updates."""
        self._updates = 0
        self._newest = 0
        self._squares = 0.0
        self._products = 0.0
        self._innovation, self._variance = 0.0, 0.0
        self._consecutive = 0

    def add(self, innovation: float, variance: float, *, used: bool) -> None:
        """Take in the innovation that an estimate reports for its last update, see ``Estimator.innovation``.

        Those of a sample that was not ``used`` do not count: outliers beyond a gate are not noise.
        """
        # Samples without an update repeat the pair of the last one.
        if innovation == self._innovation and variance == self._variance:
            return
        self._innovation, self._variance = innovation, variance
        if not (used and 0.0 < variance < math.inf and abs(innovation) < math.inf):
            return
        self._add_normalised(min(max(innovation / math.sqrt(variance), -_MAX_Z), _MAX_Z))
        optimistic = self._updates >= _MIN_UPDATES and self._ratio > self._band()[1]
        self._consecutive = self._consecutive + 1 if optimistic else 0

    def _add_normalised(self, z: float) -> None:
        """Take in a normalised innovation; the oldest of a full window gives way to it."""
        following = self._newest + 1 if self._newest + 1 < WINDOW else 0
        if self._updates:
            self._products += self._z[self._newest] * z
        oldest, self._z[following], self._newest = self._z[following], z, following
        self._squares += z * z
        if self._updates < WINDOW:
            self._updates += 1
            return
        following = following + 1 if following + 1 < WINDOW else 0
        self._squares -= oldest * oldest
        self._products -= oldest * self._z[following]

    @property
    def _ratio(self) -> float:
        return self._squares / self._updates

    def _band(self) -> tuple[float, float]:
        return band(self._updates, self._products / self._squares if self._squares > 0.0 else 0.0)

    @property
    def refuted(self) -> bool:
        """True if errors have been more than twice as large as stated for a full window: the model does not hold."""
        return self._consecutive >= WINDOW and self._ratio > 4.0

    def current(self) -> Consistency:
        """Return the current outcome."""
        if not self._updates:
            return Consistency(ConsistencyVerdict.UNKNOWN, math.nan, math.nan, math.nan, 0, 0)
        ratio, (low, high) = self._ratio, self._band()
        if self._updates < _MIN_UPDATES:
            verdict = ConsistencyVerdict.UNKNOWN
        elif self._consecutive:
            verdict = ConsistencyVerdict.OPTIMISTIC
        else:
            verdict = ConsistencyVerdict.PESSIMISTIC if ratio < low else ConsistencyVerdict.CONSISTENT
        return Consistency(verdict, ratio, low, high, self._updates, self._consecutive)


def band(count: int, correlation: float = 0.0) -> tuple[float, float]:
    """Return the 99 % band of the mean NIS of consistent updates with a correlation of neighbours [1].

    The chi-squared quantiles are approximated by Wilson and Hilferty (1931), within 1 % from ten degrees of freedom.
    The correlation of noise is below 0.9, and some degrees of freedom must remain.
    """
    rho = min(abs(correlation), 0.9)
    freedom = max(1.0, count * (1.0 - rho * rho) / (1.0 + rho * rho))
    spread = 2.0 / (9.0 * freedom)
    reach = _QUANTILE * math.sqrt(spread)
    return max(0.0, 1.0 - spread - reach) ** 3, max(0.0, 1.0 - spread + reach) ** 3
