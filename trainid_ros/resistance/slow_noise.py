# SPDX-License-Identifier: Apache-2.0
"""How much noise stays in the mean of many observations: gusts, a bad map or overlapping windows are not white.

The squared sum of a batch of innovations, beside the sum of their variances, tells it without any model of the
correlation, provided that a batch is longer than the noise hangs together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_BATCH: Final = 20
# A batch knows a variance to a factor; so many of them are averaged, fewer at first.
_MEMORY: Final = 25.0
_FIRST_MEMORY: Final = 12.0
# One batch cannot tell much more than is known: a step of the parameters is no noise. It counts all the same until
# it is found, or gusts that look like steps would never be learned.
_MOST_RATIO: Final = 6.0


@dataclass(slots=True)
class SlowNoise:
    """Learned factor on the variance with which observations average; the batch on its way."""

    factor: float = 1.0
    total: float = 0.0
    variance: float = 0.0
    known: float = 0.0
    count: int = 0
    memory: float = _FIRST_MEMORY

    def is_valid(self) -> bool:
        """True if no variance is negative and the factor and the memory are positive."""
        return self.factor > 0.0 and self.memory > 0.0 and self.known >= 0.0 and self.variance >= 0.0

    def add(self, nu: float, prediction: float, variance: float, bounds: tuple[float, float]) -> None:
        """Take in one innovation.

        Args:
            nu: The innovation, faded out if it is an outlier [N/kN].
            prediction: Variance of its prediction, from what is not known of the parameters.
            variance: Variance of its noise in the mean of many, the factor included.
            bounds: Limits of the factor.

        """
        self.total += nu
        self.variance += prediction + variance
        self.known += variance
        self.count += 1
        if self.count < _BATCH:
            return
        ratio = min(self.total * self.total / self.variance, _MOST_RATIO)
        # What mostly stems from the prediction says little of the noise.
        gain = self.known / self.variance / self.memory
        self.memory = min(self.memory + 1.0, _MEMORY)
        self.factor = min(max(self.factor * (1.0 + gain * (ratio - 1.0)), bounds[0]), bounds[1])
        self.total = self.variance = self.known = 0.0
        self.count = 0
