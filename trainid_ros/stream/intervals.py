# SPDX-License-Identifier: Apache-2.0
"""The interval between the records of one topic, learned from their stamps."""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar, Final

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.state import State, declare

_WINDOW: Final = 16
_FEWEST: Final = 4
# Jitter makes no interval shorter than this share of the median; one lost record makes the others half of it.
_SPREAD: Final = 0.75
# 5 Hz with jitter of 50 ms; the limits of the settings suit topics as fast as this.
FAST_NS: Final = NS_PER_S // 4
ONE_LOST: Final = 2.5
"""Longest time between records when one in a row is lost, in intervals; the half is for jitter."""
NONE_LOST: Final = 1.5
"""The same when none is lost."""
_ROOM_TENTHS: Final = 18
"""Shortest time in which a record may be missing, in tenths of the shortest interval; with one in between it is 20."""


class LearnedInterval:
    """The median of the last 16 intervals of a topic, or the third shortest if that is much shorter.

    Jitter spreads intervals around their median. Lost records and dropouts only lengthen them, so where the shortest
    ones are far below the median they are right: a fast topic of which most is lost is not taken for a slow one. A
    topic that does become slower is followed after 14 records, one that becomes faster after 3.

    Args:
        longest_ns: A topic with longer intervals is too slow to be used: its interval counts as unknown.
    """

    __slots__ = ('_interval_ns', '_longest_ns', '_outdated', '_shortest_ns', '_stamps', 'room_ns')
    STATE: ClassVar[State] = declare('_stamps', '_interval_ns', '_shortest_ns', 'room_ns', '_outdated')

    def __init__(self, longest_ns: int) -> None:
        self._longest_ns = longest_ns
        self._stamps: list[int] = []
        self.clear()

    def clear(self) -> None:
        """Forget all stamps."""
        self._stamps.clear()
        self._interval_ns = 0
        self._shortest_ns = 0
        self.room_ns = 0
        """Time between two records in which a third may be missing [ns]; 0, so that any may, while it is not known."""
        self._outdated = False

    def see(self, stamp_ns: int) -> None:
        """Take in the stamp of a record, each once."""
        stamps = self._stamps
        stamps.append(stamp_ns)
        if len(stamps) > _WINDOW + 1:
            dropped_ns = stamps[1] - stamps[0]
            del stamps[0]
            added_ns = stamp_ns - stamps[-2]
            if dropped_ns <= self._shortest_ns != added_ns or added_ns < self._shortest_ns:
                self._find_shortest()
        elif len(stamps) > _FEWEST:
            self._find_shortest()
        self._outdated = True

    def _find_shortest(self) -> None:
        stamps = sorted(self._stamps)
        self._shortest_ns = stamps[1] - stamps[0]
        for before, after in pairwise(stamps):
            self._shortest_ns = min(self._shortest_ns, after - before)
        self.room_ns = self._shortest_ns * _ROOM_TENTHS // 10

    @property
    def ns(self) -> int:
        """The interval [ns]; 0 while it is not known, and where it is 0.25 s or less."""
        # Asked for only where a gap is longer than any of a fast topic: nothing is sorted before.
        if self._outdated:
            self._interval_ns = self._typical()
            self._outdated = False
        return self._interval_ns

    def _typical(self) -> int:
        # A late record may have been seen after later ones.
        intervals = sorted(after - before for before, after in pairwise(sorted(self._stamps)))
        if len(intervals) < _FEWEST:
            return 0
        short, median = intervals[len(intervals) // 8], intervals[(len(intervals) - 1) // 2]
        if short <= FAST_NS:
            return 0
        interval_ns = median if short > _SPREAD * median else short
        return interval_ns if interval_ns <= self._longest_ns else 0
