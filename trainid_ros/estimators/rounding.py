# SPDX-License-Identifier: Apache-2.0
"""The error of a speed that is measured in coarse steps, which differences from sample to sample do not show.

While the train coasts, a speed in whole km/h stays the same for seconds and then jumps. Its error has the variance
q^2/12, but all samples between two jumps share it, so each of them counts for one of as many. Where every sample
moves the speed the error is still as large, and differences may not have shown it yet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# A train slower than this may stand, and a speed that stays then tells nothing.
_MIN_SPEED: Final = 0.5
# The quantum is the smallest step seen, which is forgotten slowly: one message may have been wrong.
_FORGETTING: Final = 1.01
# A greater step is slip or an outlier; whole mph are 0.45 [m/s].
_COARSEST: Final = 0.5
_MEMORY: Final = 0.04
# A speed that stays for longer than so many samples is a stuck one.
_LEAST_MOVING: Final = 0.02


@dataclass(frozen=True, slots=True)
class Rounding:
    """Quantum of the speed [m/s], and the share of samples that moved it."""

    quantum: float = 0.0
    moving: float = 1.0

    @property
    def variance(self) -> float:
        """Variance that each sample must have for all of them to weigh what they tell [(m/s)^2]."""
        if self.moving == 1.0:  # no speed has stayed: the steps are those of an accelerating train
            return 0.0
        return self.quantum * self.quantum / 12.0 / max(self.moving, _LEAST_MOVING)

    def is_valid(self) -> bool:
        """True if these are a quantum and a share, as they may not be when restored."""
        return self.quantum >= 0.0 and 0.0 <= self.moving <= 1.0

    def add(self, speed: float, last: float) -> Rounding:
        """Return the rounding after one more speed [m/s]."""
        if speed < _MIN_SPEED:
            return self
        step = abs(speed - last)
        if step == 0.0:
            return Rounding(self.quantum, (1.0 - _MEMORY) * self.moving)
        known = _FORGETTING * self.quantum or _COARSEST
        quantum = min(known, step) if step <= _COARSEST else self.quantum
        return Rounding(quantum, self.moving + _MEMORY * (1.0 - self.moving))


EXACT: Final = Rounding()
