# SPDX-License-Identifier: Apache-2.0
"""What was measured in the last second: where the train was when it felt the force that is reported now."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

_KEPT: Final = 6


@dataclass(frozen=True, slots=True)
class RecentValues:
    """A measured quantity, newest value first, and the time from each to the one after it [s]."""

    values: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()

    def add(self, value: float, dt: float) -> RecentValues:
        """Return it with one more value, ``dt`` [s] after the last; NaN = after a gap."""
        if math.isnan(dt) or not self.values:
            return RecentValues((value,), ())
        return RecentValues((value, *self.values)[:_KEPT], (dt, *self.steps)[: _KEPT - 1])

    def is_valid(self) -> bool:
        """True if there is a step between each two values, as there may not be when restored."""
        number = len(self.values)
        return number <= _KEPT and len(self.steps) == max(number - 1, 0) and min(self.steps, default=0.0) >= 0.0

    def before(self, delay: float) -> float:
        """Return the value a time ago [s], interpolated; the newest or the oldest where there is none."""
        left = delay
        for newer, older, step in zip(self.values, self.values[1:], self.steps, strict=False):
            if left <= step:
                return newer + (older - newer) * max(left, 0.0) / step if step > 0.0 else newer
            left -= step
        return self.values[-1]
