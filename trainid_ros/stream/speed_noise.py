# SPDX-License-Identifier: Apache-2.0
"""Noise of the measured speed, estimated from the measurements alone.

Tachometers of trains differ by a factor of ten. Second differences of equally spaced speeds contain the noise (with
variance 6 sigma^2) and almost none of the motion, whose jerk is small.

They do not show the rounding error of a speed measured in coarse steps. While the train coasts, a speed in whole km/h
stays the same for seconds and then jumps. Its error has the variance q^2/12, but all samples between two jumps share
it, so together they count as one sample. Where every sample changes the speed the error is just as large, and
differences may not have revealed it yet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

_MEMORY: Final = 0.01
# The learned standard deviation stays within these multiples of the declared one.
_LOWEST: Final = 0.3
_HIGHEST: Final = 10.0
# A measurement counts for at most this many learned standard deviations: slip and outliers are not noise.
_LIMIT: Final = 3.0
# E min(z^2, 1) of a standard normal z.
_CAPPED_MEAN: Final = 0.51606
_POINTS: Final = 3
# Steps that differ by a larger share are not equally spaced.
_SPACING: Final = 0.1

# A slower train may be at rest, where a constant speed is not informative [m/s].
_MIN_SPEED: Final = 0.5
# The quantum is the smallest step seen; it is forgotten slowly, since one message may have been wrong.
_FORGETTING: Final = 1.01
# A larger step is slip or an outlier [m/s]; whole mph are 0.45 m/s.
_MAX_QUANTUM: Final = 0.5
_ROUNDING_MEMORY: Final = 0.04
# Smallest share used: a speed constant for more than 50 samples is stuck.
_LEAST_CHANGED: Final = 0.02


@dataclass(slots=True)
class SpeedNoise:
    """Noise of one speed measurement.

    Attributes:
        declared_std: Declared standard deviation [m/s].
        learned: Variance learned from second differences [(m/s)^2].
        robust: Whether each square is capped at its expectation (Huber's proposal 2) instead of at three standard
            deviations: with 5 % gross errors the noise is then overestimated by 15 %, not tenfold.
        last: Last speed [m/s].
        before: Speed before the last [m/s].
        dt: Time between the two [s].
        count: Number of speeds since the last gap.
        quantum: Step in which the speed is measured [m/s].
        changed: Share of samples in which the speed changed [1].

    """

    declared_std: float
    learned: float
    robust: bool = False
    last: float = 0.0
    before: float = 0.0
    dt: float = 0.0
    count: int = 0
    quantum: float = 0.0
    changed: float = 1.0

    @classmethod
    def declared(cls, std: float, *, robust: bool = False) -> SpeedNoise:
        """Return the noise with the declared standard deviation [m/s], nothing learned yet."""
        return cls(std, std * std, robust)

    @property
    def variance(self) -> float:
        """Variance of one speed measurement [(m/s)^2]."""
        return max(self.learned, self.rounding)

    @property
    def std(self) -> float:
        """Standard deviation of one speed measurement [m/s]."""
        return math.sqrt(self.variance)

    @property
    def is_seen(self) -> bool:
        """True if the measurements show noise, as those of an ideal simulator do not."""
        low = _LOWEST * self.declared_std
        return self.learned > 2.0 * low * low

    @property
    def rounding(self) -> float:
        """Variance of the rounding of a single sample that gives all of them together their true weight [(m/s)^2]."""
        if self.changed == 1.0:  # no speed was repeated: the steps are those of an accelerating train
            return 0.0
        return self.quantum * self.quantum / 12.0 / max(self.changed, _LEAST_CHANGED)

    def is_valid(self) -> bool:
        """Return True if the values are possible; those of a restored state may not be."""
        positive = min(self.declared_std, self.learned) > 0.0 and self.count >= 0
        return positive and self.quantum >= 0.0 and 0.0 <= self.changed <= 1.0

    def add(self, speed: float, dt: float) -> None:
        """Add one more speed [m/s], measured ``dt`` [s] after the last one; NaN after a gap."""
        before, last, last_dt = self.before, self.last, self.dt
        self.before, self.last, self.dt = last, speed, dt
        self.count = 1 if math.isnan(dt) else self.count + 1
        if self.count > 1:
            self._add_step(speed, abs(speed - last))
        if self.count < _POINTS or abs(dt - last_dt) > _SPACING * dt:
            return
        second = speed - 2.0 * last + before
        square = second * second / 6.0
        if self.robust:
            square = min(square, self.learned) / _CAPPED_MEAN
        else:
            square = min(square, _LIMIT * _LIMIT * self.learned)
        low, high = _LOWEST * self.declared_std, _HIGHEST * self.declared_std
        self.learned = min(max(self.learned + _MEMORY * (square - self.learned), low * low), high * high)

    def _add_step(self, speed: float, step: float) -> None:
        """Learn the quantum from a step [m/s] between two consecutive speeds that ends at ``speed`` [m/s]."""
        if speed < _MIN_SPEED:
            return
        if step == 0.0:
            self.changed = (1.0 - _ROUNDING_MEMORY) * self.changed
            return
        if step <= _MAX_QUANTUM:
            longest = _FORGETTING * self.quantum if self.quantum > 0.0 else _MAX_QUANTUM
            self.quantum = min(longest, step)
        self.changed += _ROUNDING_MEMORY * (1.0 - self.changed)
