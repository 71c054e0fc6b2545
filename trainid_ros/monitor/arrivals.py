# SPDX-License-Identifier: Apache-2.0
"""When messages of one topic arrived."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from statistics import median
from typing import Final

_WINDOW_S: Final = 5.0
_KEPT: Final = 512
# An active node publishes at least once a second. Its messages may come this much later than usual [s], and where
# speeds are slower than 2 Hz, after this many of their usual intervals [1].
_LATEST_S: Final = 1.4
_INTERVALS: Final = 2.5


class Arrivals:
    """Arrivals on one topic, by a clock that never jumps [s]."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_KEPT)

    def add(self, now_s: float) -> None:
        """Record a message."""
        self._times.append(now_s)

    def rate(self, now_s: float) -> float:
        """Return the messages in a second over the last seconds [Hz], NaN while unknown."""
        recent = [time for time in self._times if time >= now_s - _WINDOW_S]
        span = recent[-1] - recent[0] if recent else 0.0
        return (len(recent) - 1) / span if span > 0.0 else math.nan

    def silent_s(self, now_s: float) -> float:
        """Return the time since the last message [s], infinite before the first."""
        return now_s - self._times[-1] if self._times else math.inf

    def is_late(self, now_s: float) -> bool:
        """Return whether messages came, and another one should have come by now."""
        if not self._times:
            return False
        times = list(self._times)[-8:]
        steps = [after - before for before, after in pairwise(times)]
        return self.silent_s(now_s) > max(_LATEST_S, _INTERVALS * median(steps) if steps else 0.0)
