# SPDX-License-Identifier: Apache-2.0
"""Measurements of the last second, to look up the value at the time to which a delayed force belongs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

_KEPT: Final = 6


@dataclass(frozen=True, slots=True)
class RecentValues:
    """Measured values, newest first, and the time between consecutive ones [s]."""

    values: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()

    def add(self, value: float, dt: float) -> RecentValues:
        """Add a value ``dt`` [s] after the last one; NaN after a gap, which discards the older values."""
        if math.isnan(dt) or not self.values:
            return RecentValues((value,), ())
        return RecentValues((value, *self.values)[:_KEPT], (dt, *self.steps)[: _KEPT - 1])

    def is_valid(self) -> bool:
        """Return whether a restored object has one non-negative step between each two values."""
        number = len(self.values)
        return number <= _KEPT and len(self.steps) == max(number - 1, 0) and min(self.steps, default=0.0) >= 0.0

    def before(self, delay: float) -> float:
        """Return the value ``delay`` [s] ago, interpolated; beyond the ends the newest or the oldest value."""
        remaining = delay
        for newer, older, step in zip(self.values, self.values[1:], self.steps, strict=False):
            if remaining <= step:
                return newer + (older - newer) * max(remaining, 0.0) / step if step > 0.0 else newer
            remaining -= step
        return self.values[-1]
