# SPDX-License-Identifier: Apache-2.0
"""Long-run variance of innovations, from squared sums over batches.

The noise of neighbouring observations is correlated (gusts, map errors, overlapping windows). Sums of innovations over
batches longer than the correlation time include that: if the predicted variances are correct, the expected squared
sum over a batch equals the sum of the variances. Any excess is unmodelled error: :class:`Inflation` is the factor on
the published covariance, :class:`SlowNoise` the one on the noise variance in the mean of many observations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

# Driving time of a batch [s], several times the correlation time of gusts.
_BATCH_S: Final = 48.0
# One batch determines a variance only to a factor 1.4, so several are averaged and each ratio is limited.
_INFLATION_MEMORY: Final = 8.0
_MAX_INFLATION: Final = 9.0
# Observations in a batch of the slow noise, and how many batches are averaged, fewer at first.
_BATCH: Final = 20
_SLOW_MEMORY: Final = 25.0
_FIRST_SLOW_MEMORY: Final = 12.0
# The ratio of one batch is limited, since a parameter step is not noise. Steps still count until they are detected;
# otherwise gusts that look like steps would never be learned.
_MAX_SLOW_RATIO: Final = 6.0


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

    def foreseen(self, duration_s: float) -> float:
        """Return the mean factor after a driving time [s] that the model describes [1]."""
        # The ratio of a batch is chi-square of one degree of freedom: mean 1, variance 2.
        kept = math.exp(-duration_s / (_BATCH_S * _INFLATION_MEMORY))
        excess, variance = (self.ratio - 1.0) * kept, 2.0 / (2.0 * _INFLATION_MEMORY - 1.0) * (1.0 - kept * kept)
        # E max(0, x) of a normal x
        z = excess / math.sqrt(variance)
        above = 0.5 * (1.0 + math.erf(z / math.sqrt(2.0)))
        return 1.0 + excess * above + math.sqrt(variance / (2.0 * math.pi)) * math.exp(-0.5 * z * z)

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
        found = min(self.total * self.total / self.variance, _MAX_INFLATION)
        self.ratio += (found - self.ratio) / _INFLATION_MEMORY
        self.total = self.variance = self.length = 0.0


@dataclass(slots=True)
class SlowNoise:
    """Learned factor on the noise variance in the mean of many observations, and the current batch."""

    factor: float = 1.0
    total: float = 0.0
    variance: float = 0.0
    known: float = 0.0
    count: int = 0
    memory: float = _FIRST_SLOW_MEMORY

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
        ratio = min(self.total * self.total / self.variance, _MAX_SLOW_RATIO)
        # If the parameter uncertainty dominates the variance, the batch carries little information on the noise.
        gain = self.known / self.variance / self.memory
        self.memory = min(self.memory + 1.0, _SLOW_MEMORY)
        self.factor = min(max(self.factor * (1.0 + gain * (ratio - 1.0)), bounds[0]), bounds[1])
        self.total = self.variance = self.known = 0.0
        self.count = 0
