# SPDX-License-Identifier: Apache-2.0
"""Noise of the measured speed, estimated from the measurements alone.

Tachometers of trains differ by a factor of ten. Second differences of equally spaced speeds contain the noise (with
variance 6 sigma^2) and almost none of the motion, whose jerk is small. The error that coarse rounding hides from them
is added by :mod:`trainid_ros.estimators.rounding`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from trainid_ros.estimators.rounding import EXACT, Rounding

_MEMORY: Final = 0.01
# The learned standard deviation stays within these multiples of the declared one.
_RANGE: Final = (0.3, 10.0)
# A measurement counts for at most this many learned standard deviations: slip and outliers are not noise.
_GROWTH: Final = 3.0
_POINTS: Final = 3
# Steps that differ by a larger share are not equally spaced.
_SPACING: Final = 0.1


@dataclass(frozen=True, slots=True)
class SpeedNoise:
    """Noise of one speed measurement.

    Attributes:
        declared_std: Declared standard deviation [m/s].
        learned: Variance learned from second differences [(m/s)^2].
        last: Last speed [m/s].
        before: Speed before the last [m/s].
        dt: Time between the two [s].
        count: Number of speeds since the last gap.
        rounding: Coarse rounding of the speed.

    """

    declared_std: float
    learned: float
    last: float = 0.0
    before: float = 0.0
    dt: float = 0.0
    count: int = 0
    rounding: Rounding = EXACT

    @classmethod
    def declared(cls, std: float) -> SpeedNoise:
        """Return the noise with the declared standard deviation [m/s], nothing learned yet."""
        return cls(std, std * std)

    @property
    def variance(self) -> float:
        """Variance of one speed measurement [(m/s)^2]."""
        return max(self.learned, self.rounding.variance)

    @property
    def std(self) -> float:
        """Standard deviation of one speed measurement [m/s]."""
        return math.sqrt(self.variance)

    def is_valid(self) -> bool:
        """Return True if the values are possible; those of a restored state may not be."""
        return min(self.declared_std, self.learned) > 0.0 and self.count >= 0 and self.rounding.is_valid()

    def add(self, speed: float, dt: float) -> SpeedNoise:
        """Return the noise after one more speed [m/s], measured ``dt`` [s] after the last one; NaN after a gap."""
        count = 1 if math.isnan(dt) else self.count + 1
        rounding = self.rounding.add(speed, self.last) if count > 1 else self.rounding
        updated = replace(self, last=speed, before=self.last, dt=dt, count=count, rounding=rounding)
        if count < _POINTS or abs(dt - self.dt) > _SPACING * dt:
            return updated
        second = speed - 2.0 * self.last + self.before
        low, high = (factor * self.declared_std for factor in _RANGE)
        sample = min(second * second / 6.0, _GROWTH**2 * self.learned)
        return replace(updated, learned=min(max(self.learned + _MEMORY * (sample - self.learned), low**2), high**2))
