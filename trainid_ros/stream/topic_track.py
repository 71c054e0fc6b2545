# SPDX-License-Identifier: Apache-2.0
"""The records of one topic in stamp order: values at a stamp, means between two, and their learned interval.

Brake commands are periodic, or come only when they change: then the last one holds for a declared time.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import ClassVar, Final

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.scalars import seconds
from trainid_ros.interface.state import State, declare, several, unknown
from trainid_ros.train.forces import BrakeCommandChange

# Number of intervals whose median is taken.
_WINDOW: Final = 16
# Number of intervals from which on the median is known.
_MIN_INTERVALS: Final = 4
# Share of the median that jitter leaves of an interval [1]; one lost record makes the others half of the median.
_MIN_JITTERED: Final = 0.75
FAST_NS: Final = NS_PER_S // 4
"""Interval of 5 Hz with jitter of 50 ms [ns]; the limits of the settings suit topics as fast as this."""
ONE_LOST: Final = 2.5
"""Longest time between records when one in a row is lost, in intervals; the half is for jitter."""
NONE_LOST: Final = 1.5
"""The same when none is lost."""
# A gap of 1.8 shortest intervals or more may hide a record (exactly one missing gives 2.0); in tenths of an interval.
_MIN_GAP_WITH_LOSS_TENTHS: Final = 18
# Rows kept of each topic: 14 min at 5 Hz, should no speed come that lets them be dropped.
_CAPACITY: Final = 4096


class LearnedInterval:
    """The median of the last 16 intervals of a topic, or the third shortest if that is much shorter.

    Jitter spreads intervals around their median. Lost records and dropouts only lengthen them, so where the shortest
    ones are far below the median they are right: a fast topic of which most is lost is not taken for a slow one. A
    topic that does become slower is followed after 14 records, one that becomes faster after 3.

    Args:
        longest_ns: A topic with longer intervals is too slow to be used: its interval counts as unknown.
    """

    __slots__ = ('_interval_ns', '_longest_ns', '_outdated', '_shortest_ns', '_stamps', 'min_gap_with_loss_ns')
    STATE: ClassVar[State] = declare('_stamps', '_interval_ns', '_shortest_ns', 'min_gap_with_loss_ns', '_outdated')

    def __init__(self, longest_ns: int) -> None:
        self._longest_ns = longest_ns
        self._stamps: list[int] = []
        self.clear()

    def clear(self) -> None:
        """Forget all stamps."""
        self._stamps.clear()
        self._interval_ns = 0
        self._shortest_ns = 0
        self.min_gap_with_loss_ns = 0
        """Shortest gap between two records that may hide a third [ns]; 0 while it is not known: any gap may."""
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
        elif len(stamps) > _MIN_INTERVALS:
            self._find_shortest()
        self._outdated = True

    def _find_shortest(self) -> None:
        stamps = sorted(self._stamps)
        self._shortest_ns = stamps[1] - stamps[0]
        for before, after in pairwise(stamps):
            self._shortest_ns = min(self._shortest_ns, after - before)
        self.min_gap_with_loss_ns = self._shortest_ns * _MIN_GAP_WITH_LOSS_TENTHS // 10

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
        if len(intervals) < _MIN_INTERVALS:
            return 0
        short, median = intervals[len(intervals) // 8], intervals[(len(intervals) - 1) // 2]
        if short <= FAST_NS:
            return 0
        interval_ns = median if short > _MIN_JITTERED * median else short
        return interval_ns if interval_ns <= self._longest_ns else 0


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
        rows, min_gap_with_loss_ns = self.rows, self.interval.min_gap_with_loss_ns
        k = self.first_from(at_ns)
        if k == len(rows):
            return True
        after_ns = rows[k].stamp_ns
        while after_ns > since_ns and after_ns > settled_ns:
            k -= 1
            if k < 0 or after_ns - rows[k].stamp_ns > min_gap_with_loss_ns:
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


# Largest effect on the speed of a change of the command at an unknown time [m/s]; a larger one would be attributed to
# the brake rate.
_MAX_UNCERTAIN: Final = 0.25


class BrakeCommands:
    """The commands of one track, taken in sample by sample.

    Attributes:
        latest: The command in force, None before the first.

    Args:
        track: Rows of the commands.
        timeout_ns: Age at which a command is no longer known, where commands are periodic [ns].
        gap_ns: Longest gap after which the time of a changed command counts as known [ns].
        hold_ns: How long a command published only on change holds; 0 if commands are periodic [ns].
        lag_ns: How far a topic may lag behind the others [ns].
    """

    STATE: ClassVar[State] = declare(several('latest', blank_row))

    def __init__(self, track: TopicTrack, timeout_ns: int, gap_ns: int, hold_ns: int, lag_ns: int) -> None:
        self._track = track
        self._timeout_ns = timeout_ns
        self._gap_ns = gap_ns
        self._hold_ns = hold_ns
        self._lag_ns = lag_ns
        self.latest: TopicRow | None = None

    def clear(self) -> None:
        """Forget the command; the track is cleared by its owner."""
        self.latest = None

    def known_ns(self, newest_ns: int) -> int:
        """Return the stamp up to which all changes have arrived, by the newest stamp of any topic; 0 at first."""
        last_ns = self._track.last_ns
        if self._hold_ns == 0 or last_ns == 0:
            return last_ns
        return max(last_ns, min(newest_ns - self._lag_ns, last_ns + self._hold_ns))

    def silence_ns(self) -> int:
        """Return how long no command may come [ns]: the time it holds, or 2.5 intervals of a slow topic."""
        return self._hold_ns if self._hold_ns > 0 else round(ONE_LOST * self._track.interval.ns)

    def changes(self, after_ns: int, now_ns: int) -> tuple[tuple[BrakeCommandChange, ...], bool]:
        """Return the changes of the command in (after, now], and whether one may have been missed."""
        changes: list[BrakeCommandChange] = []
        missed = False
        rows = self._track.rows
        seen_ns = after_ns
        if self._hold_ns > 0:  # one that comes late must not be lost, since no other repeats it
            seen_ns = 0 if self.latest is None else self.latest.stamp_ns
        # A command after now may have changed before: then it holds already.
        for k in range(self._track.first_from(seen_ns + 1), len(rows)):
            before, command = self.latest, rows[k]
            stamp_ns, unseen = self._change(before, command, after_ns)
            if stamp_ns > now_ns:
                break
            self.latest = command
            if before is None or before.x != command.x:
                changes.append(BrakeCommandChange(stamp_ns, command.x))
                missed = missed or unseen
        return tuple(changes), missed

    def _change(self, before: TopicRow | None, command: TopicRow, after_ns: int) -> tuple[int, bool]:
        """Return the stamp of the change to a command, after a stamp, and whether it is too uncertain to be used."""
        if before is None:
            return max(command.stamp_ns, after_ns + 1), command.x < 0.0
        span_ns, step = command.stamp_ns - before.stamp_ns, abs(command.x - before.x)
        if self._hold_ns > 0:
            return max(command.stamp_ns, after_ns + 1), command.stamp_ns <= after_ns or span_ns > self._hold_ns
        if step == 0.0 or span_ns <= self._gap_ns:
            return command.stamp_ns, False
        if span_ns > NONE_LOST * self._track.interval.ns:
            return command.stamp_ns, True
        # The topic is slow and nothing was lost: the change lies anywhere between the two.
        middle_ns = command.stamp_ns - span_ns // 2
        uncertain = step * span_ns > _MAX_UNCERTAIN * NS_PER_S
        return (middle_ns if middle_ns > after_ns else command.stamp_ns), uncertain

    def at(self, now_ns: int) -> tuple[float, bool]:
        """Return the command in force, NaN if it is not known any more, and the emergency flag."""
        latest = self.latest
        if latest is None:
            return math.nan, False
        age_ns = now_ns - latest.stamp_ns
        if self._hold_ns > 0:
            is_known = age_ns <= self._hold_ns
        else:
            is_known = age_ns <= self._timeout_ns or age_ns <= ONE_LOST * self._track.interval.ns
        return (latest.x, latest.flag) if is_known else (math.nan, False)
