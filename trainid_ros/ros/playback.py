# SPDX-License-Identifier: Apache-2.0
"""Playback timing: a recorded timeline mapped to a steady clock without drift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from trainid_ros.records import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from trainid_ros.records import Record

# /clock also ticks through gaps, so that nodes on simulated time detect dropouts.
_TICK_NS: Final = NS_PER_S // 20
# Catching up on more than this at once could overflow the queues of the subscribers.
_LONGEST_BURST_NS: Final = NS_PER_S


class TimedRecord(NamedTuple):
    """A record and its log time [ns]; without a record only the clock advances."""

    time_ns: int
    record: Record | None


@dataclass(frozen=True, slots=True)
class Timeline:
    """Records by time, which can be iterated any number of times.

    Attributes:
        first_ns: Start time [ns].
        last_ns: End time [ns].
        entries: Returns an iterator over the records from the start.

    """

    first_ns: int
    last_ns: int
    entries: Callable[[], Iterator[TimedRecord]]

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return (self.last_ns - self.first_ns) / NS_PER_S


def with_ticks(timeline: Timeline, start_s: float, duration_s: float) -> Iterator[TimedRecord]:
    """Yield a part of a timeline with clock ticks in its gaps; start and duration in [s], a duration of 0 means all."""
    begin = timeline.first_ns + round(start_s * NS_PER_S)
    end = begin + round(duration_s * NS_PER_S) if duration_s > 0.0 else timeline.last_ns
    clock = begin
    for entry in timeline.entries():
        if entry.time_ns < begin:
            continue
        if entry.time_ns > end:
            break
        while entry.time_ns - clock > _TICK_NS:
            clock += _TICK_NS
            yield TimedRecord(clock, None)
        clock = entry.time_ns
        yield entry
    yield TimedRecord(end, None)


class Pacer:
    """Maps recorded time to steady time.

    Args:
        rate: Recorded seconds per second [1].

    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._anchor: tuple[int, int] | None = None

    def release(self) -> None:
        """Drop the anchor: the next entry is due at once."""
        self._anchor = None

    def due_ns(self, time_ns: int, steady_ns: int) -> int:
        """Return when an entry is due by the steady clock [ns], which now reads ``steady_ns``."""
        if self._anchor is None:
            self._anchor = (time_ns, steady_ns)
        due = self._anchor[1] + round((time_ns - self._anchor[0]) / self._rate)
        if (steady_ns - due) * self._rate > _LONGEST_BURST_NS * max(self._rate, 1.0):
            self._anchor = (time_ns, steady_ns)
            return steady_ns
        return due
