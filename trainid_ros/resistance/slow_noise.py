# SPDX-License-Identifier: Apache-2.0
"""Long-run noise variance of many observations, whose noise (gusts, map errors, overlapping windows) is correlated.

The squared sum of a batch of innovations, compared with the sum of their variances, gives it without a model of the
correlation, provided that a batch is longer than the correlation time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_BATCH: Final = 20
# One batch determines a variance only roughly, so this many are averaged, fewer at first.
_MEMORY: Final = 25.0
_FIRST_MEMORY: Final = 12.0
# The ratio of one batch is limited, since a parameter step is not noise. Steps still count until they are detected;
# otherwise gusts that look like steps would never be learned.
_MAX_RATIO: Final = 6.0


@dataclass(slots=True)
class SlowNoise:
    """Learned factor on the noise variance in the mean of many observations, and the current batch."""

    factor: float = 1.0
    total: float = 0.0
    variance: float = 0.0
    known: float = 0.0
    count: int = 0
    memory: float = _FIRST_MEMORY

    def is_valid(self) -> bool:
        """Return whether no variance is negative and factor and memory are positive."""
        return self.factor > 0.0 and self.memory > 0.0 and self.known >= 0.0 and self.variance >= 0.0

    def add(self, nu: float, prediction: float, variance: float, bounds: tuple[float, float]) -> None:
        """Add one innovation.

        Args:
            nu: Innovation times its outlier weight [N/kN].
            prediction: Variance of its prediction due to the parameter uncertainty [(N/kN)^2].
            variance: Variance of its noise in the mean of many, including the factor [(N/kN)^2].
            bounds: Limits of the factor [1].

        """
        self.total += nu
        self.variance += prediction + variance
        self.known += variance
        self.count += 1
        if self.count < _BATCH:
            return
        ratio = min(self.total * self.total / self.variance, _MAX_RATIO)
        # If the parameter uncertainty dominates the variance, the batch carries little information on the noise.
        gain = self.known / self.variance / self.memory
        self.memory = min(self.memory + 1.0, _MEMORY)
        self.factor = min(max(self.factor * (1.0 + gain * (ratio - 1.0)), bounds[0]), bounds[1])
        self.total = self.variance = self.known = 0.0
        self.count = 0
