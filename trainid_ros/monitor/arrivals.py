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
# An active node publishes at least once a second. No message for this time [s] is late, and where messages are slower
# than 2 Hz, none for this many of their usual intervals [1].
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
        if len(self._times) < 2:  # one message has no rate
            return math.nan
        begin_s = max(now_s - _WINDOW_S, self._times[0])
        recent = sum(time > begin_s for time in self._times)
        return recent / (now_s - begin_s) if now_s > begin_s else math.nan

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
