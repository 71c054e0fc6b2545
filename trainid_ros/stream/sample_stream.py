# SPDX-License-Identifier: Apache-2.0
"""The stream of samples: everything between the records of a train and the estimators, none of which it depends on.

Records are corrected for sensor errors that the train file states, aligned to the stamps of the speed, given the
history of the drive where effects depend on it, and checked against each other. Estimators with the same train file and
settings can share one stream.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import ClassVar, Final, TypeAlias

from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.records import FORCE, NS_PER_S, SPEED, Record
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import seconds
from trainid_ros.interface.state import State, declare, encode, restore, unknown
from trainid_ros.stream.adhesion import AdhesionEstimator
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.stream.input_faults import InputFaults
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.samples import Motion, Sample
from trainid_ros.train.effects import BRAKE_APPLIED, effect_value, heat_after
from trainid_ros.train.forces import STANDING, BrakeActuator, CommandHistory, held_by
from trainid_ros.train.train_file import Effect, TrainFile


class SensorCorrection:
    """Corrects records for the effects ``wheel_diameter`` and ``stamp_skew``.

    Attributes:
        skew_s: Delay of the stamps of the force [s].
        stop_position: Measured position of the last stop [m], NaN while unknown.
        is_needed: True if any record needs a correction.
    """

    STATE: ClassVar[State] = declare(unknown('stop_position'))

    def __init__(self, effects: Sequence[Effect]) -> None:
        self.skew_s = effect_value(effects, 'stamp_skew', 'delay', 0.0)
        self._skew_ns = round(self.skew_s * NS_PER_S)
        self._ratio = effect_value(effects, 'wheel_diameter', 'ratio', 1.0)
        self.is_needed = self._ratio != 1.0 or self._skew_ns != 0
        self.reset()

    def reset(self) -> None:
        """Forget the position of the last stop."""
        self.stop_position = math.nan

    def widen(self, alignment: AlignmentConfig) -> AlignmentConfig:
        """Return alignment settings whose ``max_lag`` allows for the shift of the corrected stamps."""
        return replace(alignment, max_lag=alignment.max_lag + abs(self.skew_s))

    def correct(self, topic: int, stamp_ns: int, x: float, y: float) -> tuple[int, float, float]:
        """Return stamp and numbers of a record, corrected where needed; see ``Row`` of the records."""
        if topic == SPEED and self._ratio != 1.0:
            speed, position = self._correct_speed(x, y)
            return stamp_ns, speed, position
        if topic == FORCE and stamp_ns > 0:  # a zero stamp stays one, to be rejected
            return stamp_ns - self._skew_ns, x, y
        return stamp_ns, x, y

    def _correct_speed(self, speed: float, position: float) -> tuple[float, float]:
        """Correct speed and distance since the last stop; the position at rest is that of the platform."""
        if speed == 0.0 or math.isnan(self.stop_position):
            self.stop_position = position
        return speed / self._ratio, self.stop_position + (position - self.stop_position) / self._ratio


# Time between samples over which the speed is taken as linear [s]: in a longer one the train may have stood still.
_MAX_GAP_S: Final = 10.0


class DriveHistory:
    """History of the drive that effects depend on, followed with the brake of the train file."""

    STATE: ClassVar[State] = declare('_stamp_ns', '_speed', 'motion', '_actuator')

    def __init__(self, train_file: TrainFile) -> None:
        self._brake, self._train = train_file.brake, train_file.train
        self.reset()

    def reset(self) -> None:
        """Start a new drive."""
        self._stamp_ns, self._speed = 0, 0.0
        self.motion = Motion(time_s=0.0, distance_run=0.0)
        self._actuator = BrakeActuator(self._brake)

    @property
    def is_releasing(self) -> bool:
        """True while the brake still acts more than its command says."""
        return self._actuator.output < self._actuator.commands.value(self._stamp_ns)

    def follow(self, sample: Sample) -> Motion:
        """Take in a sample; return the motion of the drive up to its stamp."""
        start_ns, before = self._stamp_ns, self.motion
        if start_ns == 0 and sample.speed < STANDING:
            before, self._actuator.output = replace(before, since_release=0.0), held_by(self._train, sample.force)
        if not 0 < start_ns <= sample.stamp_ns:  # another drive
            start_ns, self._actuator.commands = sample.stamp_ns, CommandHistory()
        self._actuator.commands.follow(sample.brake_changes)
        elapsed = seconds(sample.stamp_ns - start_ns)
        speed = 0.5 * (self._speed + sample.speed) if elapsed <= _MAX_GAP_S else 0.0
        brake_integral = self._actuator.advance(start_ns, sample.stamp_ns)
        brake, rate = self._actuator.output, self._brake.rate_at(speed)
        brake_mean = brake_integral / elapsed if elapsed else brake
        self.motion = Motion(
            time_s=before.time_s + elapsed,
            distance_run=before.distance_run + speed * elapsed,
            since_release=0.0 if brake < BRAKE_APPLIED else before.since_release + elapsed,
            heat=heat_after(before.heat, rate * brake_mean, speed, elapsed),
            brake=brake,
            brake_mean=brake_mean,
            run=before.run + (self._speed < STANDING <= sample.speed),
        )
        self._stamp_ns, self._speed = sample.stamp_ns, sample.speed
        return self.motion


StreamEvent: TypeAlias = Sample | Rejection | TimeJump

MAX_STEP_S: Final = 3600.0
"""Largest step back of a clock being set [s]. A larger step back starts a new drive, unless it undoes a recent step
forward.
"""


class TimeJumpPolicy(Enum):
    """What to do when the stamps jump back (a bag starts over, a clock is set)."""

    RESET = 'reset'
    IGNORE = 'ignore'
    REFUSE = 'refuse'


@dataclass(frozen=True, slots=True)
class StreamConfig:
    """What shapes a stream; streams of equal configurations give equal samples."""

    train_file: TrainFile  # The train file
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)  # Settings of the alignment
    time_jump_policy: TimeJumpPolicy = TimeJumpPolicy.RESET  # What to do when the stamps jump back
    # Whether samples are rejected whose speed is stuck, or whose inputs contradict each other, by the forces of the
    # train file
    rejects_faults: bool = True


class SampleStream:
    """Turn the records of one train into samples.

    Attributes:
        config: What shapes it.
        is_new: True until the first record.
        faults: What is wrong with the inputs.
        adhesion: Adhesion, slip and slide.
    """

    STATE: ClassVar[State] = declare(
        '_aligner', '_history', '_correction', 'faults', 'adhesion', '_first_ns', 'behind_ns'
    )  # fmt: skip

    def __init__(self, config: StreamConfig) -> None:
        """Prepare; InputError, naming the field, if a setting is out of range."""
        check_settings(config.alignment)
        self.config = config
        self.is_new = True
        self._known = KnownForce(config.train_file)
        self._correction = SensorCorrection(config.train_file.effects)
        self._aligner = Aligner(
            self._correction.widen(config.alignment),
            reject_jump_back=config.time_jump_policy is TimeJumpPolicy.REFUSE,
        )
        self._history = DriveHistory(config.train_file)
        self._has_effects = bool(config.train_file.effects)
        self._rejects_faults = config.rejects_faults
        self._skew_ns = round(abs(self._correction.skew_s) * NS_PER_S)
        self._clear()

    def _clear(self) -> None:
        self._correction.reset()
        self._history.reset()
        self._start_over()

    def _start_over(self) -> None:
        self.faults = InputFaults(self._known)
        self.adhesion = AdhesionEstimator(self._known)
        self._first_ns = 0
        # How far the last required topic is behind the newest stamp, beyond the correction of the force's stamps [ns].
        self.behind_ns = 0

    def equals(self, other: SampleStream) -> bool:
        """Return whether both have taken in nothing yet and would make the same samples of the same records."""
        same = self.is_new and other.is_new and self.config == other.config
        # As text, since positions may be NaN.
        return same and encode(self) == encode(other)

    def successor(self, *, continues: bool = False) -> SampleStream:
        """Return a new stream with the same configuration, which continues this one if asked to.

        Records that lie before those of a restored state are another drive: its records are then forgotten, and only
        time and distance continue, for effects that depend on them.
        """
        stream = SampleStream(self.config)
        if continues:
            restore(stream, encode(self))
        return stream

    @property
    def finding(self) -> str:
        """What contradicts what in the inputs, empty if nothing does."""
        return self.faults.finding

    @property
    def last_finding(self) -> str:
        """The last contradiction found, empty if there never was one."""
        return self.faults.last_finding

    @property
    def newest_ns(self) -> int:
        """Newest stamp on any topic; 0 before the first."""
        return self._aligner.newest_ns

    def timeout_ns(self, topic: int, shortest_ns: int) -> int:
        """Return how long a required topic may be missing [ns]: 2.5 intervals of a slow topic, ``shortest_ns`` else."""
        return max(shortest_ns, self._aligner.silence_ns(topic))

    def is_input_missing(self, timeout_ns: int) -> bool:
        """Return whether a required topic is behind the others by more than a timeout [ns] or has not started."""
        # A slow topic is behind the others until its next record: that is checked only if the first test fails.
        return self.behind_ns > timeout_ns and self._aligner.is_behind(timeout_ns + self._skew_ns)

    def push(self, record: Record) -> list[StreamEvent]:
        """Take in one record; return the samples it completes, why records were rejected, and jumps of the stamps.

        A sample whose ``rejection`` is set must not be used for a resistance or a speed model, one whose
        ``brake_rejection`` is set not for a brake rate.
        """
        return self.push_row(*record.row())

    def push_row(self, topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> list[StreamEvent]:
        """Take in one record as a row of numbers, see :data:`~trainid_ros.interface.records.Row`."""
        if self.is_new:
            self._begin(topic, stamp_ns, x, y)
        if self._correction.is_needed:
            stamp_ns, x, y = self._correction.correct(topic, stamp_ns, x, y)
        events = self._aligner.push_row(topic, stamp_ns, x, y, flag)
        for event in events:
            if isinstance(event, Sample):
                self._follow(event)
            elif isinstance(event, TimeJump):
                self._jump(event)
        newest_ns = self._aligner.newest_ns
        self._first_ns = self._first_ns or newest_ns
        self.behind_ns = newest_ns - (self._aligner.complete_ns or self._first_ns) - self._skew_ns
        return events

    def _begin(self, topic: int, stamp_ns: int, x: float, y: float) -> None:
        """Forget the records of a restored state if the first new record belongs to another drive."""
        self.is_new = False
        if self._aligner.is_before(topic, stamp_ns, x, y):
            self._aligner.reset()
            self._correction.reset()
            self._start_over()

    def _follow(self, sample: Sample) -> None:
        """Complete a sample."""
        if self._has_effects:
            sample.motion = self._history.follow(sample)
            sample.extra = self._known.extra(sample)
        if self._rejects_faults:
            self.faults.take(sample)
            self.adhesion.step(sample, self.faults.check.blocks.noise)
            sample.adhesion = adhesion = self.adhesion.estimate()
            if adhesion.slipping:  # the axle does not tell how the train runs
                held = Rejection(sample.stamp_ns, Reason.SPEED_INCONSISTENT, adhesion.slip, 0.0)
                sample.rejection = sample.rejection or held
                sample.brake_rejection = sample.brake_rejection or held

    def _jump(self, jump: TimeJump) -> None:
        """Follow a jump of the stamps by the policy; the aligner has started over already."""
        self._first_ns = 0
        if is_reset_by(jump, self.config.time_jump_policy):
            self._clear()


def is_reset_by(jump: TimeJump, policy: TimeJumpPolicy) -> bool:
    """Return whether everything starts over after a jump of the stamps; a clock set right again loses nothing."""
    return jump.step_s < -MAX_STEP_S and not jump.undoes_step and policy is TimeJumpPolicy.RESET


@dataclass(slots=True)
class Contradiction:
    """The last time that inputs contradicted each other, in time covered by the samples."""

    finding: str = ''  # What contradicted what, empty if nothing ever did
    begin_s: float = math.nan  # When it began [s], NaN if it never did
    end_s: float = math.nan  # When it ended [s], NaN while it lasts
    inputs: tuple[str, ...] = ()  # Topics condemned
    holds_back: tuple[str, ...] = ()  # Estimates that waited

    def follow(self, faults: InputFaults, now_s: float) -> None:
        """Update it after a sample: what is wrong now, if anything is, replaces what was wrong last."""
        finding = faults.finding
        lasts = self.finding != '' and math.isnan(self.end_s)
        if finding and not lasts:
            self.begin_s, self.end_s = now_s, math.nan
        elif lasts and not finding:
            self.end_s = now_s
        if finding:
            self.finding, self.inputs, self.holds_back = finding, faults.inputs, faults.holds_back

    @property
    def text(self) -> str:
        """What contradicted what, and when."""
        if math.isnan(self.end_s):
            return f'inputs contradict each other since {self.begin_s:.1f} s: {self.finding}'
        return f'inputs contradicted each other from {self.begin_s:.1f} to {self.end_s:.1f} s: {self.finding}'
