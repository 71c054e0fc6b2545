# SPDX-License-Identifier: Apache-2.0
"""Alignment: topics with stamps of their own become one sample per period, by stamp alone.

A sample has the stamp of a speed record. Force, gradient and curvature are interpolated to that stamp; a brake command
holds from its stamp on. A sample is released as soon as every required topic has reached its stamp, or when the newest
stamp of any topic is ``max_gap + max_lag`` later: records farther apart are not interpolated, and nearer ones have
arrived. No timer or clock is used, so the same records give the same samples, live and off line, as long as no topic
lags behind the others by more than ``max_lag``.

Topics may have any rate from 1 Hz on, each its own. The limits in the settings suit 4 Hz and more; a slower topic may
lose one record in a row: its limits are 2.5 of its own intervals. The interval is learned from records that samples
have passed, in the order of stamps, so the order of arrival does not matter. Where commands come slowly, a change
between two of them counts from the middle on, since its time is unknown.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass
from operator import attrgetter
from typing import Final, NamedTuple, TypeAlias

from trainid_ros.record_validation import find_fault
from trainid_ros.records import BRAKE, FORCE, GRADIENT, MASS, NS_PER_S, SPEED, Record, row_of
from trainid_ros.results import Reason, Rejection
from trainid_ros.settings import setting
from trainid_ros.stream.intervals import LearnedInterval
from trainid_ros.stream.samples import SAMPLE_PERIOD, STANDING, BrakeCommandChange, Sample

_CONFIRMATIONS: Final = 3
_THINNING_SHARE: Final = 0.4
# Farther than odometer noise, shorter than any run between stops.
_TURNING_DISTANCE: Final = 5.0
# In intervals of the topic: one record lost in a row, none lost, each with half an interval for jitter.
ONE_LOST: Final = 2.5
_NONE_LOST: Final = 1.5
# What a change of the command at an unknown time may do to the speed [m/s]; more would be taken for the brake's doing.
_MAX_UNCERTAIN: Final = 0.25


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
    max_jump: float = setting(
        10.0, 'longest time without any message that is not taken for a jump of the clock', 's', 1.0, 3600.0
    )
    max_jump_back: float = setting(2.0, 'step of the stamps that one topic alone cannot make', 's', 0.5, 3600.0)


@dataclass(frozen=True, slots=True)
class TimeJump:
    """The stamps moved to another time base; ``step_s`` is negative for a jump back."""

    stamp_ns: int
    step_s: float


AlignmentEvent: TypeAlias = Sample | Rejection | TimeJump


class _Track:
    """Records of one topic in stamp order, bounded, as columns; and the interval between them."""

    __slots__ = ('flags', 'interval', 'stamps', 'x', 'y')

    capacity: Final = 4096

    def __init__(self, longest_interval_ns: int) -> None:
        self.interval = LearnedInterval(longest_interval_ns)
        self.stamps: list[int] = []
        self.x: list[float] = []
        self.y: list[float] = []
        self.flags: list[bool] = []

    @property
    def last_ns(self) -> int:
        """Newest stamp; 0 without records."""
        return self.stamps[-1] if self.stamps else 0

    def insert(self, stamp_ns: int, x: float, y: float, flag: bool) -> bool:
        """Insert by stamp, also a late record (it improves later interpolation); False if the stamp is taken."""
        stamps = self.stamps
        at = len(stamps)
        while at > 0 and stamps[at - 1] >= stamp_ns:
            at -= 1
        if at < len(stamps) and stamps[at] == stamp_ns:
            return False
        stamps.insert(at, stamp_ns)
        self.x.insert(at, x)
        self.y.insert(at, y)
        self.flags.insert(at, flag)
        if len(stamps) > self.capacity:
            self._forget(1)
        return True

    def _forget(self, count: int) -> None:
        del self.stamps[:count], self.x[:count], self.y[:count], self.flags[:count]

    def prune(self, before_ns: int) -> None:
        """Drop the records before the last one at or before ``before_ns``."""
        keep = bisect_right(self.stamps, before_ns) - 1
        if keep > 0:
            self.interval.see(self.stamps[:keep])
            self._forget(keep)

    def clear(self) -> None:
        """Forget everything."""
        self._forget(len(self.stamps))
        self.interval.clear()

    def value(self, column: list[float], at_ns: int, max_gap_ns: int) -> float:
        """Interpolate a column to a stamp; NaN where the neighbours are missing or too far apart."""
        stamps = self.stamps
        right = bisect_left(stamps, at_ns)
        if right == len(stamps):
            return math.nan
        after_ns = stamps[right]
        if after_ns == at_ns:
            return column[right]
        if right == 0:
            return math.nan
        before_ns = stamps[right - 1]
        if self._is_gap(after_ns - before_ns, max_gap_ns):
            return math.nan
        share = (at_ns - before_ns) / (after_ns - before_ns)
        return column[right - 1] + share * (column[right] - column[right - 1])

    def mean(self, column: list[float], start_ns: int, end_ns: int, max_gap_ns: int) -> float:
        """Return the mean of an interpolated column over an interval: trapezoids through the records inside it."""
        last = self.value(column, end_ns, max_gap_ns)
        if start_ns == end_ns:
            return last
        stamps = self.stamps
        stamp_ns, value, area, longest_ns = start_ns, self.value(column, start_ns, max_gap_ns), 0.0, 0
        for k in range(bisect_right(stamps, start_ns), bisect_left(stamps, end_ns)):
            span_ns = stamps[k] - stamp_ns
            longest_ns = max(longest_ns, span_ns)
            area += 0.5 * (value + column[k]) * span_ns
            stamp_ns, value = stamps[k], column[k]
        span_ns = end_ns - stamp_ns
        if self._is_gap(max(longest_ns, span_ns), max_gap_ns):
            return math.nan
        return (area + 0.5 * (value + last) * span_ns) / (end_ns - start_ns)

    def _is_gap(self, span_ns: int, max_gap_ns: int) -> bool:
        """Return whether two records are too far apart to interpolate between."""
        return span_ns > max_gap_ns and span_ns > ONE_LOST * self.interval.ns

    def interval_around(self, at_ns: int) -> float:
        """Return the time between the last record before a stamp and the first one from it on [s], else 0."""
        right = bisect_left(self.stamps, at_ns)
        return 0.0 if right == 0 else (self.stamps[right] - self.stamps[right - 1]) / NS_PER_S


class _Pending(NamedTuple):
    """A speed record that no sample has been made of yet."""

    stamp_ns: int
    speed: float
    position: float


class _Suspect(NamedTuple):
    """A record whose stamp does not fit those before."""

    topic: int
    stamp_ns: int
    x: float
    y: float
    flag: bool


class _Command(NamedTuple):
    """A brake command: stamp, target acceleration [m/s^2] and emergency flag."""

    stamp_ns: int
    target: float
    emergency: bool


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
        self._required = (self._force, self._gradient, self._brake)
        self._speed_interval = LearnedInterval(longest_ns)
        self.reset()

    def reset(self) -> None:
        """Forget all records and the time base."""
        for track in (self._force, self._gradient, self._brake, self._mass):
            track.clear()
        self._speed_interval.clear()
        self._pending: list[_Pending] = []
        self._newest_ns = 0
        self._speed_ns = 0
        self._agreeing: set[int] = set()
        self._released_ns = 0
        self._sample_ns = 0
        self._due_ns = 0
        self._command: _Command | None = None
        self._direction = 1
        self._turning_position = math.nan
        self._moving, self._stop_ns = False, 0
        self._suspects: list[_Suspect] = []

    @property
    def newest_ns(self) -> int:
        """Newest stamp taken in on any topic; 0 before the first."""
        return self._newest_ns

    @property
    def complete_ns(self) -> int:
        """Newest stamp that every required topic has reached; 0 while one has not begun."""
        return min(self._speed_ns, self._force.last_ns, self._gradient.last_ns, self._brake.last_ns)

    def interval_ns(self, topic: int) -> int:
        """Return the interval between records of a slow required topic; 0 for a fast one and while it is not known."""
        intervals = {track: item.interval for track, item in zip((FORCE, GRADIENT, BRAKE), self._required, strict=True)}
        return (self._speed_interval if topic == SPEED else intervals[topic]).ns

    def is_behind(self, limit_ns: int) -> bool:
        """Return whether a required topic is behind the others by more than a limit, and than its rate explains."""
        topics = [(track.last_ns, track.interval) for track in self._required]
        return any(
            self._newest_ns - stamp_ns > max(limit_ns, ONE_LOST * interval.ns + self._lag_ns)
            for stamp_ns, interval in (*topics, (self._speed_ns, self._speed_interval))
        )

    def push(self, record: Record) -> list[AlignmentEvent]:
        """Take in one record; return the samples it completes, or why it was rejected."""
        return self.push_row(*row_of(record))

    def push_row(self, topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> list[AlignmentEvent]:
        """Take in one record as a row of numbers, see :data:`~trainid_ros.records.Row`."""
        if (fault := find_fault(topic, stamp_ns, x, y)) is not None:
            return [fault]
        if self._newest_ns and abs(stamp_ns - self._newest_ns) > self._max_jump_back_ns:
            return self._suspect(_Suspect(topic, stamp_ns, x, y, flag))
        if not self._suspects:
            return self._admit(topic, stamp_ns, x, y, flag)
        rejected = [self._reject_jump(suspect) for suspect in self._suspects]
        self._suspects.clear()
        return [*rejected, *self._admit(topic, stamp_ns, x, y, flag)]

    def _admit(self, topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> list[AlignmentEvent]:
        rejection = self._store_speed(stamp_ns, x, y) if topic == SPEED else self._store(topic, stamp_ns, x, y, flag)
        if rejection is not None:
            return [rejection]
        self._newest_ns = max(self._newest_ns, stamp_ns)
        self._agreeing.add(topic)
        return self._release()

    def _suspect(self, suspect: _Suspect) -> list[AlignmentEvent]:
        """Follow a step of the stamps only when several records in a row, of more than one topic, agree on it."""
        rejected: list[AlignmentEvent] = []
        if self._suspects and abs(suspect.stamp_ns - self._suspects[-1].stamp_ns) > self._max_jump_back_ns:
            rejected = [self._reject_jump(item) for item in self._suspects]
            self._suspects.clear()
        self._suspects.append(suspect)
        if len(self._suspects) > _CONFIRMATIONS:
            rejected.append(self._reject_jump(self._suspects.pop(0)))
        agreed = len(self._suspects) == _CONFIRMATIONS and len({item.topic for item in self._suspects}) > 1
        return [*rejected, *self._follow_step()] if agreed else rejected

    def _follow_step(self) -> list[AlignmentEvent]:
        """Follow a step of all topics: forward after a time without messages, or to another time base."""
        suspects, self._suspects = self._suspects, []
        step_ns = suspects[-1].stamp_ns - self._newest_ns
        # A time base that only one topic has shown may itself have been the wrong one.
        if step_ns < 0 and self._reject_jump_back and len(self._agreeing) > 1:
            return [self._reject_jump(suspect) for suspect in suspects]
        events: list[AlignmentEvent] = []
        if not 0 < step_ns <= self._max_jump_ns:
            events = [*self._release(everything=True), TimeJump(suspects[-1].stamp_ns, step_ns / NS_PER_S)]
            self.reset()
        for suspect in suspects:
            events += self._admit(*suspect)
        return events

    def _reject_jump(self, suspect: _Suspect) -> Rejection:
        step_s = (suspect.stamp_ns - self._newest_ns) / NS_PER_S
        return Rejection(suspect.stamp_ns, Reason.STAMP_JUMP, step_s, math.copysign(self.config.max_jump_back, step_s))

    def _store(self, topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> Rejection | None:
        track = self._mass if topic == MASS else self._required[topic - FORCE]
        if topic == GRADIENT:
            y = 1.0 / y if y > 0.0 else 0.0  # curvature, which can be averaged
        if not track.insert(stamp_ns, x, y, flag):
            return Rejection(stamp_ns, Reason.DUPLICATE, stamp_ns / NS_PER_S, 0.0)
        # Samples do not wait for the mass, but use one that arrives a little late.
        limit_ns = self._released_ns - (self._lag_ns if topic == MASS else 0)
        if stamp_ns <= limit_ns:
            return Rejection(stamp_ns, Reason.LATE, (stamp_ns - limit_ns) / NS_PER_S, 0.0)
        return None

    def _store_speed(self, stamp_ns: int, speed: float, position: float) -> Rejection | None:
        if stamp_ns == self._released_ns or any(stamp_ns == item.stamp_ns for item in self._pending):
            return Rejection(stamp_ns, Reason.DUPLICATE, stamp_ns / NS_PER_S, 0.0)
        if stamp_ns < self._released_ns:
            return Rejection(stamp_ns, Reason.LATE, (stamp_ns - self._released_ns) / NS_PER_S, 0.0)
        insort(self._pending, _Pending(stamp_ns, speed, position), key=attrgetter('stamp_ns'))
        self._speed_ns = max(self._speed_ns, stamp_ns)
        return None

    def _release(self, *, everything: bool = False) -> list[AlignmentEvent]:
        events: list[AlignmentEvent] = []
        while self._pending and (everything or self._is_complete(self._pending[0].stamp_ns)):
            record = self._pending.pop(0)
            stamp_ns = record.stamp_ns
            self._released_ns = stamp_ns
            self._speed_interval.see((stamp_ns,))
            if self._due_ns and stamp_ns < self._due_ns - _THINNING_SHARE * self._period_ns:
                since_s = (stamp_ns - self._sample_ns) / NS_PER_S
                events.append(Rejection(stamp_ns, Reason.THINNED, since_s, self.config.period))
                continue
            events.append(self._sample(record))
        return events

    def _is_complete(self, stamp_ns: int) -> bool:
        if self._newest_ns > stamp_ns + self._patience_ns and not self._may_still_come(stamp_ns):
            return True
        return all(track.last_ns >= stamp_ns for track in self._required)

    def _may_still_come(self, stamp_ns: int) -> bool:
        """Return whether a slow topic may still bring a record to interpolate to."""
        slowest_ns = max(self._force.interval.ns, self._gradient.interval.ns)
        return self._newest_ns <= stamp_ns + ONE_LOST * slowest_ns + self._lag_ns

    def _sample(self, speed: _Pending) -> Sample:
        now, before, max_gap_ns = speed.stamp_ns, self._sample_ns, self._max_gap_ns
        dt = (now - before) / NS_PER_S
        if before == 0 or (dt > self.config.max_dt and now - before > ONE_LOST * self._speed_interval.ns):
            dt = math.nan
        start = now if math.isnan(dt) else before
        changes, missed = self._commands(before, now)
        command, emergency = self._command_at(now)
        curvature, tunnel = self._track_at(now)
        mass, weighed_ns = self._latest_mass(now - self._lag_ns)
        forces, gradients = self._force, self._gradient
        force = forces.value(forces.x, now, max_gap_ns)
        sample = Sample(
            stamp_ns=now,
            dt=dt,
            speed=speed.speed,
            position=speed.position,
            direction=self._follow_direction(speed.position),
            force=force,
            force_mean=forces.mean(forces.x, start, now, max_gap_ns),
            gradient=gradients.value(gradients.x, now, max_gap_ns),
            gradient_mean=gradients.mean(gradients.x, start, now, max_gap_ns),
            curve_radius=1.0 / curvature if curvature > 0.0 else 0.0,
            tunnel=tunnel,
            mass=mass,
            brake_command=command,
            brake_changes=changes,
            brake_gap=missed,
            emergency=emergency,
            curvature_mean=gradients.mean(gradients.y, start, now, max_gap_ns),
            force_interval=0.0 if math.isnan(force) else forces.interval_around(now),
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

    def _track_at(self, at_ns: int) -> tuple[float, bool]:
        """Return curvature [1/m], interpolated, and the tunnel flag of the record before."""
        stamps, curvatures, tunnels = self._gradient.stamps, self._gradient.y, self._gradient.flags
        if not stamps:
            return 0.0, False
        last = bisect_left(stamps, at_ns)
        first, last = max(last - 1, 0), min(last, len(stamps) - 1)
        span_ns = stamps[last] - stamps[first]
        share = min(max((at_ns - stamps[first]) / span_ns, 0.0), 1.0) if span_ns else 0.0
        curvature = (1.0 - share) * curvatures[first] + share * curvatures[last]
        return curvature, tunnels[last if stamps[last] <= at_ns else first]

    def _commands(self, after_ns: int, now_ns: int) -> tuple[tuple[BrakeCommandChange, ...], bool]:
        """Return the changes of the command in (after, now], and whether one may have been missed."""
        changes: list[BrakeCommandChange] = []
        missed = False
        track = self._brake
        begin, end = bisect_right(track.stamps, after_ns), bisect_right(track.stamps, now_ns)
        # A command after now may have changed before: then it holds already.
        for k in range(begin, min(end + 1, len(track.stamps))):
            before, command = self._command, _Command(track.stamps[k], track.x[k], track.flags[k])
            stamp_ns, unseen = self._change(before, command, after_ns)
            if stamp_ns > now_ns:
                break
            self._command = command
            if before is None or before.target != command.target:
                changes.append(BrakeCommandChange(stamp_ns, command.target))
                missed |= unseen
        return tuple(changes), missed

    def _change(self, before: _Command | None, command: _Command, after_ns: int) -> tuple[int, bool]:
        """Return the stamp of the change to a command, after a stamp, and whether it is too uncertain to be used."""
        if before is None:
            return command.stamp_ns, command.target < 0.0
        span_ns, step = command.stamp_ns - before.stamp_ns, abs(command.target - before.target)
        if step == 0.0 or span_ns <= self._command_gap_ns:
            return command.stamp_ns, False
        if span_ns > _NONE_LOST * self._brake.interval.ns:
            return command.stamp_ns, True
        # The topic is slow and nothing was lost: the change lies anywhere between the two.
        middle_ns = command.stamp_ns - span_ns // 2
        uncertain = step * span_ns > _MAX_UNCERTAIN * NS_PER_S
        return (middle_ns if middle_ns > after_ns else command.stamp_ns), uncertain

    def _command_at(self, now_ns: int) -> tuple[float, bool]:
        """Return the command in force, NaN if it is not known any more, and the emergency flag."""
        latest = self._command
        if latest is None:
            return math.nan, False
        age_ns = now_ns - latest.stamp_ns
        if age_ns > self.config.command_timeout * NS_PER_S and age_ns > ONE_LOST * self._brake.interval.ns:
            return math.nan, False
        return latest.target, latest.emergency

    def _latest_mass(self, at_ns: int) -> tuple[float, int]:
        """Return the mass at a stamp that even a lagging mass has reached, and its own: samples do not wait for it."""
        end = bisect_right(self._mass.stamps, at_ns)
        return (self._mass.x[end - 1], self._mass.stamps[end - 1]) if end else (math.nan, 0)

    def _last_stop(self, now_ns: int, speed: float) -> int:
        """Return when the train last came to a stop [ns]; 0 if it has not, also where records begin at rest."""
        if self._moving and speed < STANDING:
            self._stop_ns = now_ns
        self._moving = speed >= STANDING
        return self._stop_ns
