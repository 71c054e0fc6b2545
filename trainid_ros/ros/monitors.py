# SPDX-License-Identifier: Apache-2.0
"""Input statistics and step times for the diagnostics."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.records import NS_PER_S

if TYPE_CHECKING:
    from trainid_ros.records import InputTopic

_WINDOW_NS: Final = 5 * NS_PER_S
_STEPS_KEPT: Final = 3000
OVERRUN_S: Final = 0.2


class InputMonitor:
    """Arrivals on one input topic, timed with the node's clock.

    Attributes:
        topic: The topic.
        longest_s: Longest time between messages that the estimators can bridge at any rate [s].
        slowest_s: Longest acceptable interval between messages [s].
        optional: True if the estimators can run without it.
        count: Messages received.
        newest_ns: Stamp of the last message [ns], 0 before the first.

    """

    def __init__(self, topic: InputTopic, longest_s: float, slowest_s: float, *, optional: bool) -> None:
        self.topic = topic
        self.longest_s = longest_s
        self.slowest_s = max(longest_s, slowest_s)
        self.optional = optional
        self.count = 0
        self.newest_ns = 0
        self._last_ns = 0
        self._arrivals: deque[int] = deque(maxlen=4096)

    def arrived(self, stamp_ns: int, now_ns: int) -> None:
        """Record a message with this stamp [ns] that arrived now [ns]."""
        self.count += 1
        self.newest_ns = stamp_ns
        if self._arrivals and now_ns < self._arrivals[-1]:
            self._arrivals.clear()
        self._arrivals.append(now_ns)
        self._last_ns = now_ns

    def rate(self, now_ns: int) -> float:
        """Return the message rate over the last seconds [Hz]; NaN while unknown."""
        while self._arrivals and self._arrivals[0] < now_ns - _WINDOW_NS:
            self._arrivals.popleft()
        if len(self._arrivals) < 2:
            return float('nan')
        span = max(self._arrivals[-1] - self._arrivals[0], 1)
        return (len(self._arrivals) - 1) * NS_PER_S / span

    def missing_for_s(self, now_ns: int) -> float:
        """Return the time since the last message [s], infinite before the first."""
        if not self.count:
            return float('inf')
        return max(now_ns - self._last_ns, 0) / NS_PER_S


@dataclass(frozen=True, slots=True)
class StepTimeSummary:
    """Quantiles of the recent step times, the longest since the start [s], and the number of overruns since then."""

    p50: float
    p99: float
    longest: float
    overruns: int


class StepTimes:
    """Computing time of the estimator per sample."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_STEPS_KEPT)
        self._longest = 0.0
        self._overruns = 0

    def add(self, seconds: float) -> None:
        """Record the time of one step [s]."""
        self._recent.append(seconds)
        self._longest = max(self._longest, seconds)
        self._overruns += seconds > OVERRUN_S

    def summary(self) -> StepTimeSummary:
        """Return the summary; zeros before the first step."""
        if not self._recent:
            return StepTimeSummary(0.0, 0.0, 0.0, 0)
        p50, p99 = np.percentile(self._recent, (50.0, 99.0))
        return StepTimeSummary(float(p50), float(p99), self._longest, self._overruns)
