# SPDX-License-Identifier: Apache-2.0
"""The records of one topic in stamp order: values interpolated to a stamp, and means between two."""

from __future__ import annotations

import math
from typing import ClassVar, Final

from trainid_ros.interface.scalars import seconds
from trainid_ros.state import State, declare, several, unknown
from trainid_ros.stream.intervals import ONE_LOST, LearnedInterval

_CAPACITY: Final = 4096


class TopicRow:
    """A record as a row of numbers, see :data:`~trainid_ros.interface.records.Row`."""

    __slots__ = ('flag', 'stamp_ns', 'topic', 'x', 'y')
    STATE: ClassVar[State] = declare('topic', 'stamp_ns', 'x', unknown('y'), 'flag')

    def __init__(self, topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> None:
        self.topic = topic
        self.stamp_ns = stamp_ns
        self.x = x
        self.y = y
        self.flag = flag


def insert_row(rows: list[TopicRow], row: TopicRow) -> bool:
    """Insert a row into rows in stamp order; False if the stamp is taken."""
    at = len(rows)
    while at > 0 and rows[at - 1].stamp_ns >= row.stamp_ns:
        at -= 1
    if at < len(rows) and rows[at].stamp_ns == row.stamp_ns:
        return False
    rows.insert(at, row)
    return True


def blank_row() -> TopicRow:
    """Return a row to be restored."""
    return TopicRow(0, 0, 0.0, 0.0, False)


class TopicTrack:
    """Rows of one topic in stamp order, bounded, and the interval between them."""

    __slots__ = ('interval', 'last_ns', 'max_gap_ns', 'rows')
    STATE: ClassVar[State] = declare(several('rows', blank_row), 'last_ns', 'interval')

    def __init__(self, max_gap_ns: int, longest_interval_ns: int) -> None:
        self.max_gap_ns = max_gap_ns
        self.interval = LearnedInterval(longest_interval_ns)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.rows: list[TopicRow] = []
        self.last_ns = 0
        """Newest stamp; 0 without rows."""
        self.interval.clear()

    def insert(self, row: TopicRow) -> bool:
        """Insert by stamp, also a late row (it improves later interpolation); False if the stamp is taken."""
        if not insert_row(self.rows, row):
            return False
        self.last_ns = max(self.last_ns, row.stamp_ns)
        if len(self.rows) > _CAPACITY:
            del self.rows[0]
        return True

    def prune(self, before_ns: int) -> None:
        """Drop the rows before the last one at or before ``before_ns``."""
        while len(self.rows) > 1 and self.rows[1].stamp_ns <= before_ns:
            self.interval.see(self.rows.pop(0).stamp_ns)

    def first_from(self, at_ns: int) -> int:
        """Return the index of the first row at or after a stamp; samples lie near the newest rows."""
        k = len(self.rows)
        while k > 0 and self.rows[k - 1].stamp_ns >= at_ns:
            k -= 1
        return k

    def is_settled(self, since_ns: int, at_ns: int, settled_ns: int) -> bool:
        """Return whether no late row can belong between two stamps, or around them.

        Args:
            since_ns: First stamp.
            at_ns: Second stamp.
            settled_ns: Stamp up to which no row can come any more.
        """
        rows, room_ns = self.rows, self.interval.room_ns
        k = self.first_from(at_ns)
        if k == len(rows):
            return True
        after_ns = rows[k].stamp_ns
        while after_ns > since_ns and after_ns > settled_ns:
            k -= 1
            if k < 0 or after_ns - rows[k].stamp_ns > room_ns:
                return False
            after_ns = rows[k].stamp_ns
        return True

    def value(self, at_ns: int) -> tuple[float, float]:
        """Interpolate both numbers to a stamp; NaN where the neighbours are missing or too far apart."""
        right = self.first_from(at_ns)
        if right == len(self.rows):
            return math.nan, math.nan
        after = self.rows[right]
        if after.stamp_ns == at_ns:
            return after.x, after.y
        if right == 0:
            return math.nan, math.nan
        before = self.rows[right - 1]
        span_ns = after.stamp_ns - before.stamp_ns
        if self._is_gap(span_ns):
            return math.nan, math.nan
        share = (at_ns - before.stamp_ns) / span_ns
        return before.x + share * (after.x - before.x), before.y + share * (after.y - before.y)

    def mean(self, start_ns: int, end_ns: int, last: tuple[float, float]) -> tuple[float, float]:
        """Return the means of both numbers over an interval: trapezoids through the rows inside it.

        Args:
            start_ns: Start of the interval.
            end_ns: Its end.
            last: The numbers at the end, see :meth:`value`.
        """
        if start_ns == end_ns:
            return last
        x, y = self.value(start_ns)
        stamp_ns, area_x, area_y, longest_ns = start_ns, 0.0, 0.0, 0
        for k in range(self.first_from(start_ns + 1), len(self.rows)):
            row = self.rows[k]
            if row.stamp_ns >= end_ns:
                break
            span_ns = row.stamp_ns - stamp_ns
            longest_ns = max(longest_ns, span_ns)
            area_x += 0.5 * (x + row.x) * span_ns
            area_y += 0.5 * (y + row.y) * span_ns
            stamp_ns, x, y = row.stamp_ns, row.x, row.y
        span_ns = end_ns - stamp_ns
        if self._is_gap(max(longest_ns, span_ns)):
            return math.nan, math.nan
        last_x, last_y = last
        area_x += 0.5 * (x + last_x) * span_ns
        area_y += 0.5 * (y + last_y) * span_ns
        return area_x / (end_ns - start_ns), area_y / (end_ns - start_ns)

    def _is_gap(self, span_ns: int) -> bool:
        """Return whether two rows are too far apart to interpolate between."""
        return span_ns > self.max_gap_ns and span_ns > ONE_LOST * self.interval.ns

    def interval_around(self, at_ns: int) -> float:
        """Return the time between the last row before a stamp and the first one from it on [s], else 0."""
        right = self.first_from(at_ns)
        return 0.0 if right == 0 else seconds(self.rows[right].stamp_ns - self.rows[right - 1].stamp_ns)
