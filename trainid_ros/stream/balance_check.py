# SPDX-License-Identifier: Apache-2.0
"""Residual of the balance of forces: sudden ones, and its mean over a longer time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# Memory of sudden residuals [blocks], and their limit at the start [N/kN].
SUDDEN_MEMORY: Final = 4.0
_FIRST_LIMIT: Final = 10.0
# Mean residual over a longer time that no resistance explains [N/kN], share of the resistance added [1], and memory
# [blocks].
_MEAN: Final = 6.0
_MEAN_SHARE: Final = 1.0
_MEMORY: Final = 60.0
# Share of that limit beyond which the mean is suspected [1].
_SUSPECTED: Final = 0.5
# Distance of the mean from the offset, which follows more slowly, that map, wind and tunnels do not reach [N/kN], and
# share of the resistance added [1]: beyond it the force drifts. A map may be off by so many of its standard deviations
# [1].
_DRIFT: Final = 2.0
_DRIFT_SHARE: Final = 0.16
_MAP_SIGMAS: Final = 2.5
# Shares of it within which a drift is over, and beyond which the offset has followed it [1].
_OVER: Final = 0.8
_FOLLOWED: Final = 0.5


@dataclass(slots=True)
class BalanceCheck:
    """Residuals y - x of the balance of forces [N/kN].

    Attributes:
        finding: What is wrong, empty if nothing is.
        residual: Mean of the last residuals.
        limit: Mean of the largest ones that a resistance explains.
        mean: Mean residual where no brake acts, over a longer time.
        resistance: Mean of w(v) over the same time.
        drift: Mean residual less the offset that has been learned.
        is_drifting: True while that is more than map, wind and tunnels explain.
        has_stayed: True if the last drift ended because the offset has followed.
        before: Offset when it began.

    """

    finding: str = ''
    residual: float = 0.0
    limit: float = _FIRST_LIMIT
    mean: float = 0.0
    resistance: float = 0.0
    drift: float = 0.0
    is_drifting: bool = False
    has_stayed: bool = False
    before: float = 0.0

    @property
    def is_sudden(self) -> bool:
        """True if the last residuals are larger than any resistance."""
        return abs(self.residual) > self.limit

    @property
    def is_suspected(self) -> bool:
        """True while the last residuals, or their mean, are hardly to be explained by a resistance."""
        return self.is_sudden or self.is_drifting or abs(self.mean) > _SUSPECTED * self.mean_limit

    @property
    def mean_limit(self) -> float:
        """Largest mean residual over a longer time [N/kN]."""
        return _MEAN + _MEAN_SHARE * self.resistance

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

    def add_released(
        self, residual: float, offset: float, resistance: float, map_std: float, *, named: bool = True
    ) -> None:
        """Add a block where no brake acts.

        Args:
            residual: Its residual by the gain that has been learned [N/kN].
            offset: The offset that has been learned [N/kN].
            resistance: w(v) [N/kN].
            map_std: Standard deviation of the gradients of the map [per mille].
            named: Whether a mean that is too large is named already, as no error that grows with the traction.

        """
        self.mean += (residual - self.mean) / _MEMORY
        self.resistance += (resistance - self.resistance) / _MEMORY
        self._follow_drift(offset, map_std)
        if abs(self.mean) > self.mean_limit:
            if not (named or self.finding):
                return
            self.finding = f'forces do not balance by {-self.mean:+.0f} N/kN: ato/force or ato/gradient is off'
        elif abs(self.mean) < _SUSPECTED * self.mean_limit:
            self.finding = ''

    def _follow_drift(self, offset: float, map_std: float) -> None:
        """Begin or end a drift away from the offset that has been learned [N/kN]."""
        self.drift = self.mean - offset
        limit = max(_DRIFT, _MAP_SIGMAS * map_std) + _DRIFT_SHARE * self.resistance
        if not self.is_drifting:
            self.is_drifting = abs(self.drift) > limit
            self.before = offset
        elif abs(self.drift) < _OVER * limit:
            self.is_drifting, self.has_stayed = False, abs(offset - self.before) > _FOLLOWED * limit
