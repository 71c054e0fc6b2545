# SPDX-License-Identifier: Apache-2.0
"""Rounding error of a speed measured in coarse steps, which differences between samples do not reveal.

While the train coasts, a speed in whole km/h stays the same for seconds and then jumps. Its error has the variance
q^2/12, but all samples between two jumps share it, so together they count as one sample. Where every sample changes
the speed the error is just as large, and differences may not have revealed it yet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# A slower train may be at rest, where a constant speed is not informative [m/s].
_MIN_SPEED: Final = 0.5
# The quantum is the smallest step seen; it is forgotten slowly, since one message may have been wrong.
_FORGETTING: Final = 1.01
# A larger step is slip or an outlier [m/s]; whole mph are 0.45 m/s.
_MAX_QUANTUM: Final = 0.5
_MEMORY: Final = 0.04
# Smallest share used: a speed constant for more than 50 samples is stuck.
_MIN_MOVING: Final = 0.02


@dataclass(frozen=True, slots=True)
class Rounding:
    """Quantum of the measured speed [m/s], and the share of samples in which it changed [1]."""

    quantum: float = 0.0
    moving: float = 1.0

    @property
    def variance(self) -> float:
        """Variance of a single sample that gives all of them together their true weight [(m/s)^2]."""
        if self.moving == 1.0:  # no speed was repeated: the steps are those of an accelerating train
            return 0.0
        return self.quantum * self.quantum / 12.0 / max(self.moving, _MIN_MOVING)

    def is_valid(self) -> bool:
        """Return True if quantum and share are possible; those of a restored state may not be."""
        return self.quantum >= 0.0 and 0.0 <= self.moving <= 1.0

    def add(self, speed: float, last: float) -> Rounding:
        """Return the rounding after one more speed [m/s]; ``last`` is the one before [m/s]."""
        if speed < _MIN_SPEED:
            return self
        step = abs(speed - last)
        if step == 0.0:
            return Rounding(self.quantum, (1.0 - _MEMORY) * self.moving)
        bound = _FORGETTING * self.quantum or _MAX_QUANTUM
        quantum = min(bound, step) if step <= _MAX_QUANTUM else self.quantum
        return Rounding(quantum, self.moving + _MEMORY * (1.0 - self.moving))


EXACT: Final = Rounding()
