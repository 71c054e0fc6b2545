# SPDX-License-Identifier: Apache-2.0
"""Numbers that come with stamps of their own, such as the forces of several motor cars, at common stamps."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from typing import Final

from trainid_ros.interface.records import NS_PER_S

# Numbers farther apart are not interpolated, and nothing waits longer for one of the series.
_LONGEST_NS: Final = NS_PER_S


class JoinedSeries:
    """The numbers of several series at the stamps of the first one; the others are interpolated linearly.

    They are ready as soon as all series have reached the stamp. One that is missing is NaN.
    """

    def __init__(self, count: int) -> None:
        """Prepare for a number of series."""
        # Stamps [ns] and numbers of each series, by stamp, over the last second.
        self._series: list[list[tuple[int, float]]] = [[] for _ in range(count)]
        self._open: list[tuple[int, float]] = []

    def add(self, index: int, stamp_ns: int, value: float) -> list[tuple[int, list[float]]]:
        """Add a number of a series; return those of all series that are ready, each with their stamp [ns]."""
        if len(self._series) == 1:
            return [(stamp_ns, [value])]
        self._follow_jump(index, stamp_ns)
        insort(self._series[index], (stamp_ns, value))
        if index == 0:
            insort(self._open, (stamp_ns, value))
        newest_ns = max(series[-1][0] for series in self._series if series)
        ready = []
        while self._open and self._is_ready(self._open[0][0], newest_ns):
            at_ns, first = self._open.pop(0)
            ready.append((at_ns, [first, *(_interpolated(series, at_ns) for series in self._series[1:])]))
        self._prune(newest_ns)
        return ready

    def _follow_jump(self, index: int, stamp_ns: int) -> None:
        """Forget everything if the stamps of a series begin anew, as in a loop, or if its last one was wrong."""
        series = self._series[index]
        if series and stamp_ns < series[-1][0] - _LONGEST_NS:
            self._series = [[] for _ in self._series]
            self._open = []

    def _is_ready(self, at_ns: int, newest_ns: int) -> bool:
        reached = all(series and series[-1][0] >= at_ns for series in self._series[1:])
        return reached or newest_ns - at_ns > _LONGEST_NS

    def _prune(self, newest_ns: int) -> None:
        needed_ns = newest_ns - _LONGEST_NS  # older ones are not open any more, and newer ones may still come
        for series in self._series:
            del series[: max(0, bisect_left(series, (needed_ns, -math.inf)) - 1)]


def _interpolated(series: list[tuple[int, float]], at_ns: int) -> float:
    """Return the number of a series at a stamp, NaN outside it or in a long gap."""
    right = bisect_left(series, (at_ns, -math.inf))
    if right < len(series) and series[right][0] == at_ns:
        return series[right][1]
    if not 0 < right < len(series):
        return math.nan
    (start_ns, before), (end_ns, after) = series[right - 1], series[right]
    if end_ns - start_ns > _LONGEST_NS:
        return math.nan
    return before + (after - before) * (at_ns - start_ns) / (end_ns - start_ns)
