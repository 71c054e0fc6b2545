# SPDX-License-Identifier: Apache-2.0
"""What is due when: a recorded timeline laid over a steady clock, without drift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from trainid_ros.core.records import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from trainid_ros.core.records import Record

# Without records the clock still ticks, so that dropouts are seen by those who live on simulated time.
_TICK_NS: Final = NS_PER_S // 20
# Catching up more than this at once could overflow the queues of the subscribers.
_LONGEST_BURST_NS: Final = NS_PER_S


class TimedRecord(NamedTuple):
    """A record and when it was logged [ns]; without a record only the clock moves."""

    time_ns: int
    record: Record | None


@dataclass(frozen=True, slots=True)
class Timeline:
    """Records by time, any number of times.

    Attributes:
        first_ns: Time of the start.
        last_ns: Time of the end.
        entries: Returns the records from the start on.

    """

    first_ns: int
    last_ns: int
    entries: Callable[[], Iterator[TimedRecord]]

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return (self.last_ns - self.first_ns) / NS_PER_S


def with_ticks(timeline: Timeline, start_s: float, duration_s: float) -> Iterator[TimedRecord]:
    """Yield a part of a timeline with ticks of the clock in its gaps; a duration of 0 is all of it."""
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
        rate: Recorded seconds in one second.

    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._anchor: tuple[int, int] | None = None

    def release(self) -> None:
        """Forget the anchor: the next entry is due at once."""
        self._anchor = None

    def due_ns(self, time_ns: int, steady_ns: int) -> int:
        """Return when an entry is due by the steady clock, which now reads ``steady_ns``."""
        if self._anchor is None:
            self._anchor = (time_ns, steady_ns)
        due = self._anchor[1] + round((time_ns - self._anchor[0]) / self._rate)
        if (steady_ns - due) * self._rate > _LONGEST_BURST_NS * max(self._rate, 1.0):
            self._anchor = (time_ns, steady_ns)
            return steady_ns
        return due
