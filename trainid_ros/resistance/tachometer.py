# SPDX-License-Identifier: Apache-2.0
"""Robust estimate of the noise of measured speed from the measurements alone.

Second differences of equally spaced speeds contain the noise (with variance 6 sigma^2) and almost none of the motion,
whose jerk is small. One gross error affects three of them, so each square is capped at its expectation (Huber's
proposal 2): with 5 % gross errors the noise is overestimated by 15 %, not tenfold. The rounding error that coarse
quantisation hides from differences is added by :mod:`trainid_ros.estimators.rounding`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.estimators.rounding import EXACT, Rounding

_MEMORY: Final = 0.01
# Limits of the learned noise, as multiples of the declared noise.
_RANGE: Final = (0.3, 10.0)
# E min(z^2, 1) of a standard normal z.
_CAPPED_MEAN: Final = 0.51606
_POINTS: Final = 3
# Time steps that differ by more than this share are not equally spaced.
_SPACING: Final = 0.1


@dataclass(slots=True)
class Tachometer:
    """Learned noise of one speed measurement.

    Attributes:
        declared_std: Declared standard deviation [m/s].
        learned: Learned variance [(m/s)^2].
        last: Last speed [m/s].
        before: Speed before the last [m/s].
        dt: Time between the two [s].
        count: Number of speeds since the last gap.
        rounding: Rounding of the speeds.

    """

    declared_std: float
    learned: float
    last: float = 0.0
    before: float = 0.0
    dt: float = 0.0
    count: int = 0
    rounding: Rounding = EXACT

    @property
    def variance(self) -> float:
        """Variance of one speed measurement [(m/s)^2]."""
        return max(self.learned, self.rounding.variance)

    @property
    def std(self) -> float:
        """Standard deviation of one speed measurement [m/s]."""
        return math.sqrt(self.variance)

    def is_valid(self) -> bool:
        """Return whether a restored state is possible: positive noise, valid rounding, no negative count."""
        return min(self.declared_std, self.learned) > 0.0 and self.count >= 0 and self.rounding.is_valid()

    def add(self, speed: float, dt: float) -> None:
        """Add one speed [m/s], measured ``dt`` [s] after the last; NaN = after a gap."""
        before, last, last_dt = self.before, self.last, self.dt
        self.before, self.last, self.dt = last, speed, dt
        self.count = 1 if math.isnan(dt) else self.count + 1
        if self.count > 1:
            self.rounding = self.rounding.add(speed, last)
        if self.count < _POINTS or abs(dt - last_dt) > _SPACING * dt:
            return
        second = speed - 2.0 * last + before
        sample = min(second * second / 6.0, self.learned) / _CAPPED_MEAN
        low, high = (factor * self.declared_std for factor in _RANGE)
        self.learned = min(max(self.learned + _MEMORY * (sample - self.learned), low * low), high * high)
