# SPDX-License-Identifier: Apache-2.0
"""Sliding windows of fixed duration over the latest samples, independent of the sample rate."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.records import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.resistance.speed_window import Tick

# A line fit through fewer samples cannot detect outliers; at low sample rates the windows are longer.
_MIN_SAMPLES: Final = 8


@dataclass(frozen=True, slots=True)
class Cut:
    """Samples of a window, and the time from one window to the next [s]."""

    ticks: list[Tick]
    hop: float

    @property
    def samples(self) -> int:
        """Samples from one window to the next."""
        duration = (self.ticks[-1].stamp_ns - self.ticks[0].stamp_ns) / NS_PER_S
        return max(1, round(self.hop * (len(self.ticks) - 1) / duration))


class SlidingWindow:
    """Window of the latest ``length`` seconds every ``hop`` seconds, both to half a sample period.

    At rates with fewer than 8 samples in a window, the window grows to 8 samples and the hop in proportion.
    """

    def __init__(self, length: float, hop: float) -> None:
        self._length, self._hop = length, hop
        self.clear()

    def clear(self) -> None:
        """Remove all samples."""
        self.ticks: deque[Tick] = deque()
        self.fresh_s = 0.0

    def restore(self, ticks: Iterable[Tick], fresh_s: float) -> None:
        """Restore samples and the time since the last window [s]."""
        self.ticks, self.fresh_s = deque(ticks), fresh_s

    def push(self, tick: Tick) -> Cut | None:
        """Add one sample; return a window if the sample completes one that is due."""
        ticks = self.ticks
        ticks.append(tick)
        self.fresh_s += tick.dt
        if len(ticks) < _MIN_SAMPLES:
            return None
        half = 0.5 * self._span(0) / (len(ticks) - 1)
        while len(ticks) > _MIN_SAMPLES and self._span(1) > self._length - half:
            ticks.popleft()
        span = self._span(0)
        hop = self._hop * max(1.0, span / self._length) if len(ticks) == _MIN_SAMPLES else self._hop
        if span < self._length - half or self.fresh_s < hop - half:
            return None
        self.fresh_s = 0.0
        return Cut(list(ticks), hop)

    def _span(self, first: int) -> float:
        return (self.ticks[-1].stamp_ns - self.ticks[first].stamp_ns) / NS_PER_S
