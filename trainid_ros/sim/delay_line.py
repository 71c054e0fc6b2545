# SPDX-License-Identifier: Apache-2.0
"""Recent history of a quantity."""

from __future__ import annotations

from bisect import bisect_right
from typing import Final

from trainid_ros.records import NS_PER_S

MAX_DELAY_S: Final = 12.0
"""Length of the history [s]; no effect looks back further."""


class DelayLine:
    """Bounded history of values over time; 0 before the first one."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._values: list[float] = []

    def add(self, stamp_ns: int, value: float) -> None:
        """Append a value; stamps [ns] must increase."""
        self._stamps.append(stamp_ns)
        self._values.append(value)
        oldest_ns = stamp_ns - round(MAX_DELAY_S * NS_PER_S)
        # Old values are deleted in batches, which is cheaper than one by one.
        if self._stamps[0] < oldest_ns - round(MAX_DELAY_S * NS_PER_S):
            count = bisect_right(self._stamps, oldest_ns) - 1
            del self._stamps[:count], self._values[:count]

    def before(self, seconds: float) -> float:
        """Return the interpolated value a number of seconds before the newest one; the newest one if negative."""
        if not self._stamps or seconds <= 0.0:
            return self._values[-1] if self._values else 0.0
        at_ns = self._stamps[-1] - round(seconds * NS_PER_S)
        right = bisect_right(self._stamps, at_ns)
        if right == 0:
            return 0.0
        left_ns, left = self._stamps[right - 1], self._values[right - 1]
        return left + (self._values[right] - left) * (at_ns - left_ns) / (self._stamps[right] - left_ns)
