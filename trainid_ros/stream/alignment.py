# SPDX-License-Identifier: Apache-2.0
"""Alignment: topics with stamps of their own become one sample per period, by stamp alone.

A sample has the stamp of a speed record. Force, gradient and curvature are interpolated to that stamp; a brake command
holds from its stamp on. A sample is released as soon as every required topic has reached its stamp, or when the newest
stamp of any topic is ``max_gap + max_lag`` later: records farther apart are not interpolated, and nearer ones have
arrived. No timer or clock is used, so the same records give the same samples, live and off line.

A record may lag by ``max_lag``: arrive after others, of any topic, whose stamps are up to this much newer.
Within it the order of arrival does not change a sample. Where two records of a topic are so far apart that a third may
still come between them, samples wait until the newest stamp is ``max_lag`` later; records in order are used at once.

Topics may have any rate from 1 Hz on, each its own. The limits in the settings suit 4 Hz and more; a slower topic may
lose one record in a row: its limits are 2.5 of its own intervals. The interval is learned from records that samples
have passed, in the order of stamps, so the order of arrival does not matter. Where commands come slowly, a change
between two of them counts from the middle on, since its time is unknown. Commands may also be published only on change:
with ``command_hold`` set, the last one holds that long, and samples wait ``max_lag`` for a change that is on its way.

A clock set wrong for some seconds and then corrected returns to its previous time base. Such a return never starts a
new drive, whatever its size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final, TypeAlias

from trainid_ros.interface.errors import setting
from trainid_ros.interface.records import BRAKE, FORCE, GRADIENT, INPUT_TOPICS, MASS, NS_PER_S, SPEED, Record
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import find_fault, seconds
from trainid_ros.interface.state import State, declare, several
from trainid_ros.stream.samples import SAMPLE_PERIOD, Sample
from trainid_ros.stream.topic_track import (
    ONE_LOST,
    BrakeCommands,
    LearnedInterval,
    TopicRow,
    TopicTrack,
    blank_row,
    insert_row,
)
from trainid_ros.train.forces import STANDING

# Distance that shows the direction of travel [m]: above odometer noise, below any run between stops.
_TURNING_DISTANCE: Final = 5.0
# More messages of the mass than a network loses in a row: of one that loses each tenth, 1e-8 [1].
_LOST_IN_A_ROW: Final = 8.0


@dataclass(slots=True)
class Travel:
    """What positions and speeds have shown so far."""

    direction: int = 1  # +1 or -1 as positions rise or fall, kept until the train has clearly moved
    turning_position: float = math.nan  # Position from which the next movement counts [m], NaN while unknown
    moving: bool = False  # Whether the train moved at the last sample
    stop_ns: int = 0  # When it last came to a stop [ns]; 0 if it has not, also where records begin at rest
    stood_ns: int = 0  # When it last stood [ns]; 0 if it has not

    def follow(self, stamp_ns: int, speed: float, position: float) -> None:
        """Take in stamp [ns], speed [m/s] and position [m] of a sample."""
        moved = position - self.turning_position
        if math.isnan(moved):
            self.turning_position = position if math.isnan(self.turning_position) else self.turning_position
        elif abs(moved) > _TURNING_DISTANCE:
            self.direction = 1 if moved > 0.0 else -1
            self.turning_position = position
        if self.moving and speed < STANDING:
            self.stop_ns = stamp_ns
        self.moving = speed >= STANDING
        if not self.moving:
            self.stood_ns = stamp_ns


RETURN_NS: Final = 60 * NS_PER_S
"""Time, by the stamps, within which a step forward is taken back [ns]."""


@dataclass(slots=True)
class PreviousTimeBase:
    """The time base before a step forward."""

    newest_ns: int = 0  # Its newest stamp [ns]; 0 if none was left
    until_ns: int = 0  # Stamp of the present time base up to which the stamps may return [ns]

    def leave(self, newest_ns: int, stamp_ns: int) -> bool:
        """Follow a step forward; return whether it leaves a time base that was right until then."""
        is_first = not self._may_return(newest_ns)
        if is_first:
            self.newest_ns = newest_ns
        self.until_ns = stamp_ns + RETURN_NS
        return is_first

    def is_return(self, newest_ns: int, stamp_ns: int, slack_ns: int) -> bool:
        """Return whether a step from the newest stamp back to another leads to this time base."""
        return self._may_return(newest_ns) and -slack_ns <= stamp_ns - self.newest_ns <= RETURN_NS

    def _may_return(self, newest_ns: int) -> bool:
        return self.newest_ns > 0 and newest_ns <= self.until_ns


# Records of one topic that show a step of the stamps, and number of records among which one topic has as many.
_CONFIRMATIONS: Final = 3
_MAX_SUSPECTS: Final = (_CONFIRMATIONS - 1) * len(INPUT_TOPICS) + 1
# Share of the period by which a sample may be early [1]: with jitter, speeds at the period are not thinned.
_MAX_EARLY: Final = 0.4


@dataclass(frozen=True, slots=True)
class AlignmentConfig:
    """How records become samples."""

    period: float = setting(SAMPLE_PERIOD, 'sample period', 's', 0.02, 5.0)
    max_lag: float = setting(0.3, 'how far a topic may lag behind the others, in stamps', 's', 0.0, 10.0)
    max_gap: float = setting(0.7, 'longest gap of force and gradient to interpolate over', 's', 0.05, 10.0)
    max_dt: float = setting(1.0, 'longest time between samples of one uninterrupted drive', 's', 0.1, 10.0)
    command_timeout: float = setting(2.0, 'age at which a brake command is no longer known', 's', 0.2, 60.0)
    command_hold: float = setting(
        0.0, 'how long a brake command published only on change holds; 0: commands are periodic', 's', 0.0, 86400.0
    )
    command_gap: float = setting(
        0.35, 'longest gap after which the time of a changed command counts as known', 's', 0.05, 10.0
    )
    max_interval: float = setting(
        1.25,
        'longest interval of a topic that raises these limits: to 2.5 intervals, command_gap to 1.5',
        's',
        0.02,
        10.0,
    )
    max_jump: float = setting(
        10.0, 'longest pause of all topics that does not count as a jump of the clock', 's', 1.0, 3600.0
    )
    max_jump_back: float = setting(
        2.0, 'largest step of the stamps that a single record may make, back or ahead', 's', 0.5, 3600.0
    )


@dataclass(frozen=True, slots=True)
class TimeJump:
    """The stamps moved to another time base."""

    stamp_ns: int  # First stamp there [ns]
    step_s: float  # How far it is; negative for a jump back [s]
    is_step_forward: bool = False  # Whether it leaves a time base to which the stamps may return within a minute
    undoes_step: bool = False  # Whether it returns to the time base before a step forward


AlignmentEvent: TypeAlias = Sample | Rejection | TimeJump


class Aligner:
    """Turn records, in any order of topics, into samples in stamp order."""

    STATE: ClassVar[State] = declare(
        '_force', '_gradient', '_brake', '_mass', '_speed_interval', several('_pending', blank_row), 'newest_ns',
        '_speed_ns', '_agreeing', '_released_ns', '_sample_ns', '_due_ns', '_commands', '_travel',
        several('_suspects', blank_row), '_previous',
    )  # fmt: skip

    def __init__(self, config: AlignmentConfig, *, reject_jump_back: bool = False) -> None:
        self.config = config
        self._reject_jump_back = reject_jump_back
        self._max_gap_ns = round(config.max_gap * NS_PER_S)
        self._lag_ns = round(config.max_lag * NS_PER_S)
        self._patience_ns = self._max_gap_ns + self._lag_ns
        self._max_jump_ns = round(config.max_jump * NS_PER_S)
        self._max_jump_back_ns = round(config.max_jump_back * NS_PER_S)
        self._period_ns = round(config.period * NS_PER_S)
        self._early_ns = round(_MAX_EARLY * self._period_ns)
        longest_ns = round(config.max_interval * NS_PER_S)
        self._force = TopicTrack(self._max_gap_ns, longest_ns)
        self._gradient = TopicTrack(self._max_gap_ns, longest_ns)
        self._brake = TopicTrack(self._max_gap_ns, longest_ns)
        self._mass = TopicTrack(self._max_gap_ns, longest_ns)
        self._required = [self._force, self._gradient, self._brake]
        self._commands = BrakeCommands(
            self._brake,
            round(config.command_timeout * NS_PER_S),
            round(config.command_gap * NS_PER_S),
            round(config.command_hold * NS_PER_S),
            self._lag_ns,
        )
        self._speed_interval = LearnedInterval(longest_ns)
        self.reset()

    def reset(self) -> None:
        """Forget all records and the time base."""
        for track in self._required:
            track.clear()
        self._mass.clear()
        self._speed_interval.clear()
        # Speeds that no sample has been made of yet.
        self._pending: list[TopicRow] = []
        self.newest_ns = 0
        """Newest stamp taken in on any topic; 0 before the first."""
        self._speed_ns = 0
        self._agreeing: set[int] = set()
        self._released_ns = 0
        self._sample_ns = 0
        self._due_ns = 0
        self._commands.clear()
        self._travel = Travel()
        # Records whose stamps do not fit those before.
        self._suspects: list[TopicRow] = []
        self._previous = PreviousTimeBase()

    def is_before(self, topic: int, stamp_ns: int, x: float, y: float) -> bool:
        """Return whether a valid record lies farther back than its topic alone can step."""
        back = stamp_ns < self.newest_ns and self._is_far(stamp_ns, self.newest_ns)
        return back and find_fault(topic, stamp_ns, x, y) is None

    @property
    def complete_ns(self) -> int:
        """Newest stamp that every required topic has reached; 0 while one has not begun."""
        known_ns = self._commands.known_ns(self.newest_ns)
        return min(self._speed_ns, self._force.last_ns, self._gradient.last_ns, known_ns)

    def silence_ns(self, topic: int) -> int:
        """Return how long a required topic may be silent [ns]: 2.5 intervals of a slow one; 0 while it is not known."""
        if topic == BRAKE:
            return self._commands.silence_ns()
        interval = self._speed_interval if topic == SPEED else self._required[topic - FORCE].interval
        return round(ONE_LOST * interval.ns)

    def is_behind(self, limit_ns: int) -> bool:
        """Return whether a required topic is behind the others by more than a limit, and than its rate explains."""
        if self._is_late(self._speed_ns, self._speed_interval, limit_ns):
            return True
        known_ns = self._commands.known_ns(self.newest_ns)
        return (
            self._is_late(self._force.last_ns, self._force.interval, limit_ns)
            or self._is_late(self._gradient.last_ns, self._gradient.interval, limit_ns)
            or self._is_late(known_ns, self._brake.interval, limit_ns)
        )

    def _is_late(self, stamp_ns: int, interval: LearnedInterval, limit_ns: int) -> bool:
        return self.newest_ns - stamp_ns > max(limit_ns, ONE_LOST * interval.ns + self._lag_ns)

    def push(self, record: Record) -> list[AlignmentEvent]:
        """Take in one record; return the samples it completes, or why it was rejected."""
        return self.push_row(*record.row())

    def push_row(self, topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> list[AlignmentEvent]:
        """Take in one record as a row of numbers, see :data:`~trainid_ros.interface.records.Row`."""
        if (fault := find_fault(topic, stamp_ns, x, y)) is not None:
            return [fault]
        row = TopicRow(topic, stamp_ns, x, y, flag)
        events: list[AlignmentEvent] = []
        if self.newest_ns and self._is_far(stamp_ns, self.newest_ns):
            self._suspect(row, events)
            return events
        if self._suspects:
            self._reject_suspects(events)
        self._admit(row, events)
        return events

    def _is_far(self, stamp_ns: int, other_ns: int) -> bool:
        """Return whether one topic alone cannot step between two stamps."""
        return not -self._max_jump_back_ns <= stamp_ns - other_ns <= self._max_jump_back_ns

    def _admit(self, row: TopicRow, events: list[AlignmentEvent]) -> None:
        rejection = self._store_speed(row) if row.topic == SPEED else self._store(row)
        if rejection is not None:
            events.append(rejection)
            return
        self.newest_ns = max(self.newest_ns, row.stamp_ns)
        self._agreeing.add(row.topic)
        self._release(events)

    def _suspect(self, row: TopicRow, events: list[AlignmentEvent]) -> None:
        """Follow a step of the stamps only when it lasts: one topic has shown it three times, and others have, too."""
        if self._suspects and self._is_far(row.stamp_ns, self._suspects[-1].stamp_ns):
            self._reject_suspects(events)
        self._suspects.append(row)
        if len(self._suspects) > _MAX_SUSPECTS:
            events.append(self._reject_jump(self._suspects.pop(0)))
        shown = [item.topic for item in self._suspects]
        if _CONFIRMATIONS <= max([shown.count(topic) for topic in shown]) < len(shown):
            self._follow_step(events)

    def _follow_step(self, events: list[AlignmentEvent]) -> None:
        """Follow a step of all topics: forward after a time without messages, or to another time base."""
        stamp_ns = self._suspects[0].stamp_ns
        step_ns = stamp_ns - self.newest_ns
        undoes_step = step_ns < 0 and self._previous.is_return(self.newest_ns, stamp_ns, self._max_jump_back_ns)
        # A time base that only one topic has shown may itself have been the wrong one.
        if step_ns < 0 and self._reject_jump_back and len(self._agreeing) > 1 and not undoes_step:
            self._reject_suspects(events)
            return
        rows, self._suspects = self._suspects, []
        if not 0 < step_ns <= self._max_jump_ns:
            self._release(events, everything=True)
            is_step_forward = step_ns > 0 and self._previous.leave(self.newest_ns, stamp_ns)
            events.append(TimeJump(stamp_ns, seconds(step_ns), is_step_forward, undoes_step))
            previous = self._previous if step_ns > 0 else PreviousTimeBase()
            self.reset()
            self._previous = previous
        for row in rows:
            self._admit(row, events)

    def _reject_suspects(self, events: list[AlignmentEvent]) -> None:
        events.extend([self._reject_jump(row) for row in self._suspects])
        self._suspects.clear()

    def _reject_jump(self, row: TopicRow) -> Rejection:
        step_s = seconds(row.stamp_ns - self.newest_ns)
        return Rejection(row.stamp_ns, Reason.STAMP_JUMP, step_s, math.copysign(self.config.max_jump_back, step_s))

    def _store(self, row: TopicRow) -> Rejection | None:
        stamp_ns, is_mass = row.stamp_ns, row.topic == MASS
        track = self._mass if is_mass else self._required[row.topic - FORCE]
        if row.topic == GRADIENT:
            row.y = 1.0 / row.y if row.y > 0.0 else 0.0  # curvature, which can be averaged
        if not track.insert(row):
            return Rejection(stamp_ns, Reason.DUPLICATE, seconds(stamp_ns), 0.0)
        # Samples do not wait for the mass, but use one that arrives a little late.
        limit_ns = self._released_ns - (self._lag_ns if is_mass else 0)
        if stamp_ns <= limit_ns:
            return Rejection(stamp_ns, Reason.LATE, seconds(stamp_ns - limit_ns), 0.0)
        return None

    def _store_speed(self, row: TopicRow) -> Rejection | None:
        stamp_ns = row.stamp_ns
        if stamp_ns < self._released_ns:
            return Rejection(stamp_ns, Reason.LATE, seconds(stamp_ns - self._released_ns), 0.0)
        if stamp_ns == self._released_ns or not insert_row(self._pending, row):
            return Rejection(stamp_ns, Reason.DUPLICATE, seconds(stamp_ns), 0.0)
        self._speed_ns = max(self._speed_ns, stamp_ns)
        return None

    def _release(self, events: list[AlignmentEvent], *, everything: bool = False) -> None:
        while self._pending and (everything or self._is_complete(self._pending[0].stamp_ns)):
            row = self._pending.pop(0)
            stamp_ns = row.stamp_ns
            self._released_ns = stamp_ns
            self._speed_interval.see(stamp_ns)
            if self._due_ns and stamp_ns < self._due_ns - self._early_ns:
                since_s = seconds(stamp_ns - self._sample_ns)
                events.append(Rejection(stamp_ns, Reason.THINNED, since_s, self.config.period))
            else:
                events.append(self._sample(row))
                self._advance(stamp_ns)

    def _is_complete(self, stamp_ns: int) -> bool:
        if self.newest_ns - stamp_ns > self._patience_ns and not self._may_still_come(stamp_ns):
            return True
        return (
            self._force.last_ns >= stamp_ns
            and self._gradient.last_ns >= stamp_ns
            and self._commands.known_ns(self.newest_ns) >= stamp_ns
            and self._is_settled(stamp_ns)
        )

    def _is_settled(self, stamp_ns: int) -> bool:
        """Return whether no late record can belong to a sample."""
        since_ns, settled_ns = self._sample_ns, self.newest_ns - self._lag_ns
        if stamp_ns > settled_ns and stamp_ns - self._released_ns > self._speed_interval.min_gap_with_loss_ns:
            return False
        return (
            self._force.is_settled(since_ns, stamp_ns, settled_ns)
            and self._gradient.is_settled(since_ns, stamp_ns, settled_ns)
            and self._brake.is_settled(since_ns, stamp_ns, settled_ns)
        )

    def _may_still_come(self, stamp_ns: int) -> bool:
        """Return whether a slow topic may still bring a record to interpolate to."""
        slowest_ns = max(self._force.interval.ns, self._gradient.interval.ns)
        return self.newest_ns - stamp_ns <= ONE_LOST * slowest_ns + self._lag_ns

    def _sample(self, row: TopicRow) -> Sample:
        """Return the sample at a row of speed."""
        now, before = row.stamp_ns, self._sample_ns
        self._travel.follow(now, row.x, row.y)
        dt = self._elapsed(now)
        start = now if math.isnan(dt) else before
        changes, missed = self._commands.changes(before, now)
        command, emergency = self._commands.at(now)
        curvature, tunnel = self._track_at(now)
        mass, weighed_ns = self._latest_mass(now - self._lag_ns)
        # The load changes until the departure: a repeated mass that ceased before it, with far more messages missing
        # than one, is that of other passengers.
        interval_ns = self._mass.interval.ns
        ceased_ns = 2 * (round(ONE_LOST * interval_ns) + self._lag_ns)
        ceased = interval_ns > 0 and weighed_ns + ceased_ns < self._travel.stood_ns
        has_stood = ceased or weighed_ns < self._travel.stop_ns
        forces, gradients = self._force.value(now), self._gradient.value(now)
        gradient_mean, curvature_mean = self._gradient.mean(start, now, gradients)
        return Sample(
            stamp_ns=now, dt=dt, speed=row.x, position=row.y, direction=self._travel.direction,
            force=forces[0], force_mean=self._force.mean(start, now, forces)[0],
            gradient=gradients[0], gradient_mean=gradient_mean,
            curve_radius=1.0 / curvature if curvature > 0.0 else 0.0, tunnel=tunnel, mass=mass,
            brake_command=command, brake_changes=changes, brake_gap=missed, emergency=emergency,
            curvature_mean=curvature_mean,
            force_interval=0.0 if math.isnan(forces[0]) else self._force.interval_around(now),
            stood_since_weighing=has_stood,
            is_weighing_overdue=has_stood and now - weighed_ns > round(_LOST_IN_A_ROW * interval_ns) > 0,
        )  # fmt: skip

    def _elapsed(self, now_ns: int) -> float:
        """Return the time since the last sample [s]; NaN for the first and after a gap."""
        elapsed_ns = now_ns - self._sample_ns
        dt = seconds(elapsed_ns)
        if self._sample_ns == 0 or (dt > self.config.max_dt and elapsed_ns > ONE_LOST * self._speed_interval.ns):
            return math.nan
        return dt

    def _advance(self, now_ns: int) -> None:
        """Set when the next sample is due, and drop the rows that no later sample needs."""
        self._sample_ns = now_ns
        # Keep phase with the period, so that faster speed topics are thinned to it evenly.
        in_phase = self._due_ns and -self._period_ns <= 2 * (now_ns - self._due_ns) <= self._period_ns
        self._due_ns = (self._due_ns if in_phase else now_ns) + self._period_ns
        for track in self._required:
            track.prune(now_ns - self._max_gap_ns)
        self._mass.prune(now_ns - max(self._max_gap_ns, self._lag_ns))

    def _track_at(self, at_ns: int) -> tuple[float, bool]:
        """Return curvature [1/m], interpolated, and the tunnel flag of the record before."""
        rows = self._gradient.rows
        if not rows:
            return 0.0, False
        right = self._gradient.first_from(at_ns)
        first, last = rows[max(right - 1, 0)], rows[min(right, len(rows) - 1)]
        span_ns = last.stamp_ns - first.stamp_ns
        share = min(max((at_ns - first.stamp_ns) / span_ns, 0.0), 1.0) if span_ns else 0.0
        curvature = (1.0 - share) * first.y + share * last.y
        return curvature, last.flag if last.stamp_ns <= at_ns else first.flag

    def _latest_mass(self, at_ns: int) -> tuple[float, int]:
        """Return the mass at a stamp that even a lagging mass has reached, and its own: samples do not wait for it."""
        end = self._mass.first_from(at_ns + 1)
        return (self._mass.rows[end - 1].x, self._mass.rows[end - 1].stamp_ns) if end else (math.nan, 0)
