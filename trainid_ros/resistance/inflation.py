# SPDX-License-Identifier: Apache-2.0
"""Covariance inflation from the recent ratio of actual to predicted innovation variance.

Sums of innovations over batches include their correlation: if the predicted variances are correct, the expected
squared sum over a batch equals the sum of the variances, that is, the normalised squared sum is 1. Any excess is
unmodelled error, by which the published covariance is inflated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# Driving time of a batch [s], several times the correlation time of gusts.
_BATCH_S: Final = 48.0
# One batch determines a variance only to a factor 1.4, so several are averaged and each ratio is limited.
_MEMORY: Final = 8.0
_MAX_RATIO: Final = 9.0


@dataclass(slots=True)
class Inflation:
    """Mean ratio of squared innovation sums to predicted variances, and the current batch.

    Attributes:
        ratio: Mean ratio, 1 if the model is consistent.
        total: Sum of the innovations of the batch, in any unit or normalised by their standard deviations.
        variance: Sum of their predicted variances, in the square of that unit.
        length: Driving time of the batch so far [s].

    """

    ratio: float = 1.0
    total: float = 0.0
    variance: float = 0.0
    length: float = 0.0

    @property
    def factor(self) -> float:
        """Factor on the covariance of the parameters [1], at least 1."""
        return max(1.0, self.ratio)

    def is_valid(self) -> bool:
        """Return whether the ratio is positive and no variance is negative."""
        return self.ratio > 0.0 and self.variance >= 0.0 and 0.0 <= self.length < _BATCH_S

    def add(self, nu: float, variance: float, dt: float) -> None:
        """Add one innovation times its outlier weight, its variance in the mean of many, and its driving time [s]."""
        self.total += nu
        self.variance += variance
        self.length += dt
        if self.length < _BATCH_S - 0.5 * dt:
            return
        found = min(self.total * self.total / self.variance, _MAX_RATIO)
        self.ratio += (found - self.ratio) / _MEMORY
        self.total = self.variance = self.length = 0.0
