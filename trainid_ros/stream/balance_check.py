# SPDX-License-Identifier: Apache-2.0
"""Residual of the balance of forces: sudden ones, and its mean over a longer time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# Memory of sudden residuals [blocks].
SUDDEN_MEMORY: Final = 4.0
# Mean residual over a longer time that no resistance explains [N/kN], share of traction added [1], memory [blocks].
_MEAN: Final = 10.0
_MEAN_SHARE: Final = 0.3
_MEMORY: Final = 60.0


@dataclass(slots=True)
class BalanceCheck:
    """Residuals y - x of the balance of forces [N/kN].

    Attributes:
        finding: What is wrong, empty if nothing is.
        residual: Mean of the last residuals.
        limit: Mean of the largest ones that a resistance explains.
        mean: Mean residual where no brake acts, over a longer time.
        level: Mean of |traction| over the same time.

    """

    finding: str = ''
    residual: float = 0.0
    limit: float = _MEAN
    mean: float = 0.0
    level: float = 0.0

    @property
    def is_sudden(self) -> bool:
        """True if the last residuals are larger than any resistance."""
        return abs(self.residual) > self.limit

    @property
    def mean_limit(self) -> float:
        """Largest mean residual over a longer time [N/kN]."""
        return _MEAN + _MEAN_SHARE * self.level

    def add(self, residual: float, limit: float) -> None:
        """Add the residual of a block and the largest one that a resistance explains [N/kN]."""
        self.residual += (residual - self.residual) / SUDDEN_MEMORY
        self.limit += (limit - self.limit) / SUDDEN_MEMORY

    def contradict(self) -> None:
        """Take note of a sudden contradiction of another kind."""
        self.residual = 2.0 * self.limit

    def decay(self, keep: float) -> None:
        """Forget sudden residuals but for a share [1] of them, while nothing can be compared."""
        self.residual *= keep

    def add_released(self, residual: float, traction: float) -> None:
        """Add residual and traction [N/kN] of a block where no brake acts."""
        self.mean += (residual - self.mean) / _MEMORY
        self.level += (abs(traction) - self.level) / _MEMORY
        if abs(self.mean) > self.mean_limit:
            self.finding = f'forces do not balance by {-self.mean:+.0f} N/kN: ato/force or ato/gradient is off'
        elif abs(self.mean) < 0.5 * _MEAN:
            self.finding = ''
