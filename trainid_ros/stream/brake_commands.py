# SPDX-License-Identifier: Apache-2.0
"""Brake commands by stamp: which one is in force, since when, and up to when that is known.

Commands come all the time, or only when they change: then the last one holds for a declared time.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.state import State, declare, several
from trainid_ros.stream.intervals import NONE_LOST, ONE_LOST
from trainid_ros.stream.topic_track import TopicRow, TopicTrack, blank_row
from trainid_ros.train.forces import BrakeCommandChange

# What a change of the command at an unknown time may do to the speed [m/s]; more would be taken for the brake's doing.
_MAX_UNCERTAIN: Final = 0.25


class BrakeCommands:
    """The commands of one track, taken in sample by sample.

    Attributes:
        latest: The command in force, None before the first.

    Args:
        track: Rows of the commands.
        timeout_ns: Age at which a command is no longer known, where commands come all the time [ns].
        gap_ns: A command that changed over a longer gap changed unseen [ns].
        hold_ns: How long a command published only on change holds; 0 if commands come all the time [ns].
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
