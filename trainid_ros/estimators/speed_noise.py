# SPDX-License-Identifier: Apache-2.0
"""The noise of measured speed, learned from the measurements alone.

Trains differ in their tachometers by a factor of ten. Second differences of equally spaced speeds hold
the noise (with variance 6 sigma^2) and next to nothing of the motion, whose jerk is small. What coarse rounding hides
from them is added by :mod:`trainid_ros.estimators.rounding`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from trainid_ros.estimators.rounding import EXACT, Rounding

_MEMORY: Final = 0.01
# Learned noise stays within these multiples of what is declared.
_RANGE: Final = (0.3, 10.0)
# One measurement cannot tell much more noise than is known: slip and outliers are no noise.
_GROWTH: Final = 3.0
_POINTS: Final = 3
# Steps that differ by more are no equal spacing.
_SPACING: Final = 0.1


@dataclass(frozen=True, slots=True)
class SpeedNoise:
    """Learned variance of one speed measurement [(m/s)^2]; last two speeds, step between them, number; rounding."""

    declared_std: float
    learned: float
    last: float = 0.0
    before: float = 0.0
    dt: float = 0.0
    count: int = 0
    rounding: Rounding = EXACT

    @classmethod
    def declared(cls, std: float) -> SpeedNoise:
        """Return the noise as declared [m/s], nothing learned yet."""
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
        """True if this is a noise that measurements can have, as it may not be when restored."""
        return min(self.declared_std, self.learned) > 0.0 and self.count >= 0 and self.rounding.is_valid()

    def add(self, speed: float, dt: float) -> SpeedNoise:
        """Return the noise after one more speed [m/s], measured ``dt`` [s] after the last; NaN = after a gap."""
        count = 1 if math.isnan(dt) else self.count + 1
        rounding = self.rounding.add(speed, self.last) if count > 1 else self.rounding
        moved = replace(self, last=speed, before=self.last, dt=dt, count=count, rounding=rounding)
        if count < _POINTS or abs(dt - self.dt) > _SPACING * dt:
            return moved
        second = speed - 2.0 * self.last + self.before
        low, high = (factor * self.declared_std for factor in _RANGE)
        sample = min(second * second / 6.0, _GROWTH**2 * self.learned)
        return replace(moved, learned=min(max(self.learned + _MEMORY * (sample - self.learned), low**2), high**2))
