# SPDX-License-Identifier: Apache-2.0
"""Alignment: topics with stamps of their own become one sample per period, by stamp alone.

A sample stands at the stamp of a speed record. Force, gradient and curvature are interpolated to that
stamp, the brake command holds from its stamp on. A sample is released as soon as every required topic
has reached its stamp, or when the newest stamp on any topic is the longest gap + ``max_lag`` past it: what lies
farther off would not be interpolated to, and what lies nearer has arrived. No timer and no clock take
part, so the same records give the same samples, live and off line, as long as no topic lags behind the
others by more than ``max_lag``.

Topics may come at any rate from 1 Hz on, each at its own. The limits of the settings suit 4 Hz and more; a
slower topic may lose one record in a row: its limits are 2.5 of its own intervals. The interval is learned from
records that samples have passed, in the order of stamps, so the order of arrival does not matter to it either.
Where commands come slowly, a change between two of them counts from the middle on: when it was made is not known.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, TypeAlias

from trainid_ros.core.intervals import LearnedInterval
from trainid_ros.core.record_validation import find_fault
from trainid_ros.core.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.core.results import Reason, Rejection
from trainid_ros.core.samples import SAMPLE_PERIOD, STANDING, BrakeCommandChange, Sample
from trainid_ros.core.settings import setting

if TYPE_CHECKING:
    from collections.abc import Callable

_CONFIRMATIONS: Final = 3
_THINNING_SHARE: Final = 0.4
# Farther than odometer noise, shorter than any run between stops.
_TURNING_DISTANCE: Final = 5.0
# In intervals of the topic: one record lost in a row, none lost, each with half an interval for jitter.
ONE_LOST: Final = 2.5
_NONE_LOST: Final = 1.5
# What a change of the command at an unknown time may do to the speed [m/s]; more would be taken for the brake's doing.
_MOST_UNCERTAIN: Final = 0.25


@dataclass(frozen=True, slots=True)
class AlignmentConfig:
    """How records become samples."""

    period: float = setting(SAMPLE_PERIOD, 'sample period', 's', 0.02, 5.0)
    max_lag: float = setting(0.3, 'how far a topic may lag behind the others, in stamps', 's', 0.0, 10.0)
    max_gap: float = setting(0.7, 'longest gap of force and gradient to interpolate over', 's', 0.05, 10.0)
    max_dt: float = setting(1.0, 'longest time between samples of one uninterrupted drive', 's', 0.1, 10.0)
    command_timeout: float = setting(2.0, 'age at which a brake command is no longer known', 's', 0.2, 60.0)
    command_gap: float = setting(0.35, 'a command that changed over a longer gap changed unseen', 's', 0.05, 10.0)
    max_interval: float = setting(
        1.25, 'slowest topic that these limits grow with: 2.5 of its intervals, command_gap 1.5', 's', 0.02, 10.0
    )
    max_jump: float = setting(10.0, 'longest silence of all topics that is no jump of the clock', 's', 1.0, 3600.0)
    max_jump_back: float = setting(2.0, 'step of the stamps that one topic alone cannot make', 's', 0.5, 3600.0)


@dataclass(frozen=True, slots=True)
class TimeJump:
    """The stamps moved to another time base; ``step_s`` is negative for a jump back."""

    stamp_ns: int
    step_s: float


AlignmentEvent: TypeAlias = Sample | Rejection | TimeJump


class _Track:
    """Records of one topic in stamp order, bounded, and the interval between them."""

    __slots__ = ('interval', 'records', 'stamps')

    capacity: Final = 4096

    def __init__(self, longest_interval_ns: int) -> None:
        self.interval = LearnedInterval(longest_interval_ns)
        self.stamps: list[int] = []
        self.records: list[Record] = []

    def insert(self, record: Record) -> bool:
        """Insert by stamp, also a late record (it mends later interpolation); False if the stamp is there already."""
        at = bisect_left(self.stamps, record.stamp_ns)
        if at < len(self.stamps) and self.stamps[at] == record.stamp_ns:
            return False
        self.stamps.insert(at, record.stamp_ns)
        self.records.insert(at, record)
        if len(self.stamps) > self.capacity:
            del self.stamps[0], self.records[0]
        return True

    def prune(self, before_ns: int) -> None:
        """Forget what lies before the last record at or before ``before_ns``."""
        keep = bisect_right(self.stamps, before_ns) - 1
        if keep > 0:
            self.interval.see(self.stamps[:keep])
            del self.stamps[:keep], self.records[:keep]

    def clear(self) -> None:
        """Forget everything."""
        self.stamps.clear()
        self.records.clear()
        self.interval.clear()


class Aligner:
    """Turn records, in any order of topics, into samples in stamp order."""

    def __init__(self, config: AlignmentConfig, *, reject_jump_back: bool = False) -> None:
        self.config = config
        self._reject_jump_back = reject_jump_back
        self._max_gap_ns = round(config.max_gap * NS_PER_S)
        self._lag_ns = round(config.max_lag * NS_PER_S)
        self._patience_ns = self._max_gap_ns + self._lag_ns
        self._max_jump_ns = round(config.max_jump * NS_PER_S)
        self._max_jump_back_ns = round(config.max_jump_back * NS_PER_S)
        self._command_gap_ns = round(config.command_gap * NS_PER_S)
        self._period_ns = round(config.period * NS_PER_S)
        longest_ns = round(config.max_interval * NS_PER_S)
        self._force, self._gradient, self._brake, self._mass = (_Track(longest_ns) for _ in range(4))
        self._speed_interval = LearnedInterval(longest_ns)
        self.reset()

    def reset(self) -> None:
        """Forget all records and the time base."""
        for track in (self._force, self._gradient, self._brake, self._mass):
            track.clear()
        self._speed_interval.clear()
        self._pending: list[tuple[int, SpeedRecord]] = []
        self._newest_ns = 0
        self._speed_ns = 0
        self._agreeing: set[type[Record]] = set()
        self._released_ns = 0
        self._sample_ns = 0
        self._due_ns = 0
        self._command: BrakeRecord | None = None
        self._direction = 1
        self._turning_position = math.nan
        self._moving, self._stop_ns = False, 0
        self._suspects: list[Record] = []

    @property
    def newest_ns(self) -> int:
        """Newest stamp taken in on any topic; 0 before the first."""
        return self._newest_ns

    @property
    def complete_ns(self) -> int:
        """Newest stamp that every required topic has reached; 0 while one has not begun."""
        tracks = (self._force, self._gradient, self._brake)
        return min(self._speed_ns, *(track.stamps[-1] if track.stamps else 0 for track in tracks))

    def interval_ns(self, kind: type[Record]) -> int:
        """Return the interval between records of a slow required topic; 0 for a fast one and while it is not known."""
        tracks = {ForceRecord: self._force, GradientRecord: self._gradient, BrakeRecord: self._brake}
        return (self._speed_interval if kind is SpeedRecord else tracks[kind].interval).ns

    def is_behind(self, limit_ns: int) -> bool:
        """Return whether a required topic is behind the others by more than a limit, and than its rate explains."""
        tracks = (self._force, self._gradient, self._brake)
        topics = [(track.stamps[-1] if track.stamps else 0, track.interval) for track in tracks]
        return any(
            self._newest_ns - stamp_ns > max(limit_ns, ONE_LOST * interval.ns + self._lag_ns)
            for stamp_ns, interval in (*topics, (self._speed_ns, self._speed_interval))
        )

    def push(self, record: Record) -> list[AlignmentEvent]:
        """Take one record in; return the samples it completes, or why it was refused."""
        if (fault := find_fault(record)) is not None:
            return [fault]
        if self._newest_ns and abs(record.stamp_ns - self._newest_ns) > self._max_jump_back_ns:
            return self._suspect(record)
        astray = [self._reject_jump(suspect) for suspect in self._suspects]
        self._suspects.clear()
        return [*astray, *self._admit(record)]

    def _admit(self, record: Record) -> list[AlignmentEvent]:
        if (rejection := self._store(record)) is not None:
            return [rejection]
        self._newest_ns = max(self._newest_ns, record.stamp_ns)
        self._agreeing.add(type(record))
        return [*self._release()]

    def _suspect(self, record: Record) -> list[AlignmentEvent]:
        """Believe a step of the stamps only when several records in a row, of more than one topic, agree on it."""
        astray: list[AlignmentEvent] = []
        if self._suspects and abs(record.stamp_ns - self._suspects[-1].stamp_ns) > self._max_jump_back_ns:
            astray = [self._reject_jump(suspect) for suspect in self._suspects]
            self._suspects.clear()
        self._suspects.append(record)
        if len(self._suspects) > _CONFIRMATIONS:
            astray.append(self._reject_jump(self._suspects.pop(0)))
        agreed = len(self._suspects) == _CONFIRMATIONS and len({type(item) for item in self._suspects}) > 1
        return [*astray, *self._follow_step()] if agreed else astray

    def _follow_step(self) -> list[AlignmentEvent]:
        """All topics have stepped: forward after a silence, or to another time base."""
        suspects, self._suspects = self._suspects, []
        step_ns = suspects[-1].stamp_ns - self._newest_ns
        # A base that rests on one topic alone may have been the one astray.
        if step_ns < 0 and self._reject_jump_back and len(self._agreeing) > 1:
            return [self._reject_jump(suspect) for suspect in suspects]
        events: list[AlignmentEvent] = []
        if not 0 < step_ns <= self._max_jump_ns:
            events = [*self._release(everything=True), TimeJump(suspects[-1].stamp_ns, step_ns / NS_PER_S)]
            self.reset()
        for suspect in suspects:
            events += self._admit(suspect)
        return events

    def _reject_jump(self, record: Record) -> Rejection:
        step_s = (record.stamp_ns - self._newest_ns) / NS_PER_S
        return Rejection(record.stamp_ns, Reason.STAMP_JUMP, step_s, math.copysign(self.config.max_jump_back, step_s))

    def _store(self, record: Record) -> Rejection | None:
        stamp = record.stamp_ns
        if isinstance(record, SpeedRecord):
            return self._store_speed(record)
        if isinstance(record, ForceRecord):
            track = self._force
        elif isinstance(record, GradientRecord):
            track = self._gradient
        elif isinstance(record, BrakeRecord):
            track = self._brake
        else:
            track = self._mass
        if not track.insert(record):
            return Rejection(stamp, Reason.DUPLICATE, stamp / NS_PER_S, 0.0)
        # Samples do not wait for the mass, but reach back for it.
        limit_ns = self._released_ns - (self._lag_ns if track is self._mass else 0)
        if stamp <= limit_ns:
            return Rejection(stamp, Reason.LATE, (stamp - limit_ns) / NS_PER_S, 0.0)
        return None

    def _store_speed(self, record: SpeedRecord) -> Rejection | None:
        stamp = record.stamp_ns
        if stamp == self._released_ns or any(stamp == waiting for waiting, _ in self._pending):
            return Rejection(stamp, Reason.DUPLICATE, stamp / NS_PER_S, 0.0)
        if stamp < self._released_ns:
            return Rejection(stamp, Reason.LATE, (stamp - self._released_ns) / NS_PER_S, 0.0)
        insort(self._pending, (stamp, record), key=lambda item: item[0])
        self._speed_ns = max(self._speed_ns, stamp)
        return None

    def _release(self, *, everything: bool = False) -> list[AlignmentEvent]:
        events: list[AlignmentEvent] = []
        while self._pending and (everything or self._is_complete(self._pending[0][0])):
            stamp, record = self._pending.pop(0)
            self._released_ns = stamp
            self._speed_interval.see((stamp,))
            if self._due_ns and stamp < self._due_ns - _THINNING_SHARE * self._period_ns:
                events.append(
                    Rejection(stamp, Reason.THINNED, (stamp - self._sample_ns) / NS_PER_S, self.config.period)
                )
                continue
            events.append(self._sample(record))
        return events

    def _is_complete(self, stamp_ns: int) -> bool:
        if self._newest_ns > stamp_ns + self._patience_ns and not self._may_still_come(stamp_ns):
            return True
        required = (self._force, self._gradient, self._brake)
        return all(track.stamps and track.stamps[-1] >= stamp_ns for track in required)

    def _may_still_come(self, stamp_ns: int) -> bool:
        """Return whether a slow topic may still bring a record to interpolate to."""
        slowest_ns = max(self._force.interval.ns, self._gradient.interval.ns)
        return self._newest_ns <= stamp_ns + ONE_LOST * slowest_ns + self._lag_ns

    def _sample(self, speed: SpeedRecord) -> Sample:
        now, before = speed.stamp_ns, self._sample_ns
        dt = (now - before) / NS_PER_S
        if before == 0 or (dt > self.config.max_dt and now - before > ONE_LOST * self._speed_interval.ns):
            dt = math.nan
        start = now if math.isnan(dt) else before
        changes, missed = self._commands(before, now)
        command, emergency = self._command_at(now)
        curvature, tunnel = self._track_at(now)
        mass, weighed_ns = self._latest_mass(now - self._lag_ns)
        force = self._value(self._force, now, _scalar)
        sample = Sample(
            stamp_ns=now,
            dt=dt,
            speed=speed.speed,
            position=speed.position,
            direction=self._follow_direction(speed.position),
            force=force,
            force_mean=self._mean(self._force, start, now, _scalar),
            gradient=self._value(self._gradient, now, _scalar),
            gradient_mean=self._mean(self._gradient, start, now, _scalar),
            curve_radius=1.0 / curvature if curvature > 0.0 else 0.0,
            tunnel=tunnel,
            mass=mass,
            brake_command=command,
            brake_changes=changes,
            brake_gap=missed,
            emergency=emergency,
            curvature_mean=self._mean(self._gradient, start, now, _curvature),
            force_interval=0.0 if math.isnan(force) else _interval_around(self._force, now),
            stood_since_weighing=weighed_ns < self._last_stop(now, speed.speed),
        )
        self._sample_ns = now
        # Keep phase with the period, so that faster speed topics are thinned to it evenly.
        in_phase = self._due_ns and abs(now - self._due_ns) <= self._period_ns // 2
        self._due_ns = (self._due_ns if in_phase else now) + self._period_ns
        for track in (self._force, self._gradient, self._brake, self._mass):
            track.prune(now - self._max_gap_ns)
        return sample

    def _follow_direction(self, position: float) -> int:
        """Return +1 or -1 as positions rise or fall, kept until the train has clearly moved."""
        moved = position - self._turning_position
        if math.isnan(moved):
            self._turning_position = position if math.isnan(self._turning_position) else self._turning_position
        elif abs(moved) > _TURNING_DISTANCE:
            self._direction = 1 if moved > 0.0 else -1
            self._turning_position = position
        return self._direction

    def _is_gap(self, track: _Track, span_ns: int) -> bool:
        """Return whether two records of a topic are too far apart to interpolate between."""
        return span_ns > self._max_gap_ns and span_ns > ONE_LOST * track.interval.ns

    def _value(self, track: _Track, at_ns: int, read: Callable[[Record], float]) -> float:
        """Interpolate to a stamp; NaN where the neighbours are missing or too far apart."""
        right = bisect_left(track.stamps, at_ns)
        if right == len(track.stamps):
            return math.nan
        if track.stamps[right] == at_ns:
            return read(track.records[right])
        if right == 0 or self._is_gap(track, track.stamps[right] - track.stamps[right - 1]):
            return math.nan
        share = (at_ns - track.stamps[right - 1]) / (track.stamps[right] - track.stamps[right - 1])
        left_value, right_value = read(track.records[right - 1]), read(track.records[right])
        return left_value + share * (right_value - left_value)

    def _mean(self, track: _Track, start_ns: int, end_ns: int, read: Callable[[Record], float]) -> float:
        """Mean of the interpolated value over an interval (trapezoids through the records inside it)."""
        if start_ns == end_ns:
            return self._value(track, end_ns, read)
        inside = range(bisect_right(track.stamps, start_ns), bisect_left(track.stamps, end_ns))
        stamps = [start_ns, *(track.stamps[k] for k in inside), end_ns]
        values = [
            self._value(track, start_ns, read),
            *(read(track.records[k]) for k in inside),
            self._value(track, end_ns, read),
        ]
        if self._is_gap(track, max(b - a for a, b in pairwise(stamps))):
            return math.nan
        area = 0.0
        for k in range(1, len(stamps)):
            area += 0.5 * (values[k - 1] + values[k]) * (stamps[k] - stamps[k - 1])
        return area / (end_ns - start_ns)

    def _track_at(self, at_ns: int) -> tuple[float, bool]:
        """Return curvature [1/m], interpolated, and the tunnel flag of the record before."""
        right = bisect_left(self._gradient.stamps, at_ns)
        neighbours = [self._gradient.records[k] for k in (right - 1, right) if 0 <= k < len(self._gradient.records)]
        records = [record for record in neighbours if isinstance(record, GradientRecord)]
        if not records:
            return 0.0, False
        first, last = records[0], records[-1]
        span = last.stamp_ns - first.stamp_ns
        share = min(max((at_ns - first.stamp_ns) / span, 0.0), 1.0) if span else 0.0
        curvature = (1.0 - share) * _curvature(first) + share * _curvature(last)
        return curvature, (last if last.stamp_ns <= at_ns else first).tunnel

    def _commands(self, after_ns: int, now_ns: int) -> tuple[tuple[BrakeCommandChange, ...], bool]:
        """Return the changes of the command in (after, now], and whether one may have been missed."""
        changes: list[BrakeCommandChange] = []
        missed = False
        begin, end = bisect_right(self._brake.stamps, after_ns), bisect_right(self._brake.stamps, now_ns)
        # A command after now may have changed before: then it is in force already.
        for record in self._brake.records[begin : end + 1]:
            if not isinstance(record, BrakeRecord):
                continue
            before = self._command
            stamp_ns, unseen = self._change(before, record, after_ns)
            if stamp_ns > now_ns:
                break
            self._command = record
            if before is None or before.target_acceleration != record.target_acceleration:
                changes.append(BrakeCommandChange(stamp_ns, record.target_acceleration))
                missed |= unseen
        return tuple(changes), missed

    def _change(self, before: BrakeRecord | None, record: BrakeRecord, after_ns: int) -> tuple[int, bool]:
        """Return the stamp of the change to a command, after a stamp, and whether it is too uncertain to be used."""
        if before is None:
            return record.stamp_ns, record.target_acceleration < 0.0
        span_ns, step = record.stamp_ns - before.stamp_ns, abs(record.target_acceleration - before.target_acceleration)
        if step == 0.0 or span_ns <= self._command_gap_ns:
            return record.stamp_ns, False
        if span_ns > _NONE_LOST * self._brake.interval.ns:
            return record.stamp_ns, True
        # The topic is slow and nothing was lost: the change lies anywhere between the two.
        middle_ns = record.stamp_ns - span_ns // 2
        uncertain = step * span_ns > _MOST_UNCERTAIN * NS_PER_S
        return (middle_ns if middle_ns > after_ns else record.stamp_ns), uncertain

    def _command_at(self, now_ns: int) -> tuple[float, bool]:
        """Return the command in force, NaN if it is not known any more, and the emergency flag."""
        latest = self._command
        if latest is None:
            return math.nan, False
        age_ns = now_ns - latest.stamp_ns
        if age_ns > self.config.command_timeout * NS_PER_S and age_ns > ONE_LOST * self._brake.interval.ns:
            return math.nan, False
        return latest.target_acceleration, latest.emergency

    def _latest_mass(self, at_ns: int) -> tuple[float, int]:
        """Return the mass at a stamp that even a lagging mass has reached, and its own: samples do not wait for it."""
        end = bisect_right(self._mass.stamps, at_ns)
        latest = self._mass.records[end - 1] if end else None
        return (latest.mass, latest.stamp_ns) if isinstance(latest, MassRecord) else (math.nan, 0)

    def _last_stop(self, now_ns: int, speed: float) -> int:
        """Return when the train last came to a stop [ns]; 0 if it has not, also where records begin at rest."""
        if self._moving and speed < STANDING:
            self._stop_ns = now_ns
        self._moving = speed >= STANDING
        return self._stop_ns


def _interval_around(track: _Track, at_ns: int) -> float:
    """Return the time between the last record before a stamp and the first one from it on [s], else 0."""
    right = bisect_left(track.stamps, at_ns)
    return 0.0 if right == 0 else (track.stamps[right] - track.stamps[right - 1]) / NS_PER_S


def _scalar(record: Record) -> float:
    if isinstance(record, ForceRecord):
        return record.force
    return record.gradient if isinstance(record, GradientRecord) else math.nan


def _curvature(record: Record) -> float:
    return 1.0 / record.curve_radius if isinstance(record, GradientRecord) and record.curve_radius > 0.0 else 0.0
