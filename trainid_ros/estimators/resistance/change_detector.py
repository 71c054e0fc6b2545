# SPDX-License-Identifier: Apache-2.0
"""Two-sided CUSUM on normalised innovations: has a parameter stepped away?

A gate alone locks out for good after a step larger than itself (peers and papers do); small process
noise alone follows too late. The sum of innovations tells a step from noise, at any size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Cusum:
    """Sums of normalised innovations beyond the allowance, upward and downward (Page 1954)."""

    up: float = 0.0
    down: float = 0.0

    def add(self, z: float, allowance: float, clip: float) -> Cusum:
        """Return the sums after one more innovation, clipped so that no single outlier decides."""
        bounded = min(max(z, -clip), clip)
        return Cusum(max(0.0, self.up + bounded - allowance), max(0.0, self.down - bounded - allowance))

    @property
    def peak(self) -> float:
        """Larger of the two sums."""
        return max(self.up, self.down)


NO_STEP: Final = Cusum()
