# SPDX-License-Identifier: Apache-2.0
"""How much larger the errors of prediction are than the model says, over the recent past.

Sums over batches of innovations count their correlation: if the stated variances are true, the squared sum over a
batch has the sum of the variances as its mean (normalised innovation squared of the sum, 1). What lies above is
error that the model does not know of, and the published covariance grows by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# Driving time of a batch [s], several times the correlation time of gusts.
_BATCH_S: Final = 48.0
# A batch knows a variance to a factor 1.4, so some are averaged; one alone counts so much at most.
_MEMORY: Final = 8.0
_MOST_RATIO: Final = 9.0


@dataclass(slots=True)
class Inflation:
    """Mean ratio of squared to stated innovations; the batch on its way.

    Attributes:
        ratio: 1 where the model is consistent.
        total: Sum of the innovations of the batch, in any unit, as over their standard deviations.
        variance: Sum of their stated variances, in the square of that unit.
        length: Driving time of the batch so far [s].

    """

    ratio: float = 1.0
    total: float = 0.0
    variance: float = 0.0
    length: float = 0.0

    @property
    def factor(self) -> float:
        """Factor on the covariance of the parameters, never below 1."""
        return max(1.0, self.ratio)

    def is_valid(self) -> bool:
        """True if the ratio is positive and no variance is negative."""
        return self.ratio > 0.0 and self.variance >= 0.0 and 0.0 <= self.length < _BATCH_S

    def add(self, nu: float, variance: float, dt: float) -> None:
        """Take in one innovation, faded out if it is an outlier, its variance in the mean of many, and its time [s]."""
        self.total += nu
        self.variance += variance
        self.length += dt
        if self.length < _BATCH_S - 0.5 * dt:
            return
        found = min(self.total * self.total / self.variance, _MOST_RATIO)
        self.ratio += (found - self.ratio) / _MEMORY
        self.total = self.variance = self.length = 0.0
