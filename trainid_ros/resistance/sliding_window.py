# SPDX-License-Identifier: Apache-2.0
"""The latest samples as windows of fixed duration, whatever the rate of the samples."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.core.records import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.resistance.speed_window import Tick

# A line through fewer samples cannot tell outliers; where samples are rare, windows are longer.
_FEWEST: Final = 8


@dataclass(frozen=True, slots=True)
class Cut:
    """A window, and the time from one window to the next [s]."""

    ticks: list[Tick]
    hop: float

    @property
    def samples(self) -> int:
        """Samples from one window to the next."""
        duration = (self.ticks[-1].stamp_ns - self.ticks[0].stamp_ns) / NS_PER_S
        return max(1, round(self.hop * (len(self.ticks) - 1) / duration))


class SlidingWindow:
    """Gives the window of the latest ``length`` seconds every ``hop`` seconds, both to half a sample.

    At rates that leave fewer than 8 samples in it, the window grows to 8 samples and the hop in proportion.
    """

    def __init__(self, length: float, hop: float) -> None:
        self._length, self._hop = length, hop
        self.clear()

    def clear(self) -> None:
        """Begin anew."""
        self.ticks: deque[Tick] = deque()
        self.fresh_s = 0.0

    def restore(self, ticks: Iterable[Tick], fresh_s: float) -> None:
        """Take over samples and the time since the last window [s]."""
        self.ticks, self.fresh_s = deque(ticks), fresh_s

    def push(self, tick: Tick) -> Cut | None:
        """Take in one sample; return a window if it completes one that is due."""
        ticks = self.ticks
        ticks.append(tick)
        self.fresh_s += tick.dt
        if len(ticks) < _FEWEST:
            return None
        half = 0.5 * self._span(0) / (len(ticks) - 1)
        while len(ticks) > _FEWEST and self._span(1) > self._length - half:
            ticks.popleft()
        span = self._span(0)
        hop = self._hop * max(1.0, span / self._length) if len(ticks) == _FEWEST else self._hop
        if span < self._length - half or self.fresh_s < hop - half:
            return None
        self.fresh_s = 0.0
        return Cut(list(ticks), hop)

    def _span(self, first: int) -> float:
        return (self.ticks[-1].stamp_ns - self.ticks[first].stamp_ns) / NS_PER_S
