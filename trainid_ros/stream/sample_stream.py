# SPDX-License-Identifier: Apache-2.0
"""The stream of samples: everything between the records of a train and the estimators, none of which it depends on.

Records are corrected for sensor errors that the train file states, aligned to the stamps of the speed, given the
history of the drive where effects depend on it, and checked for a stuck speed sensor and for contradictions.
Estimators with the same train file and settings can share one stream.

A stuck speed stays the same to the last bit although traction or brake must change it, or for longer than noisy
measurements do: two of them with noise sigma, in steps of q, are equal with probability q / (2 sqrt(pi) sigma).
Estimators would otherwise learn a brake without effect, or a resistance as large as the traction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, ClassVar, Final, TypeAlias

from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.records import FORCE, NS_PER_S, SPEED, Record
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, encode, restore, several, unknown
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.stream.brake_checks import BrakeDelayCheck
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.stream.plausibility import PlausibilityMonitor
from trainid_ros.stream.samples import STANDING, Motion, Sample
from trainid_ros.train.effects import BRAKE_APPLIED, effect_value, heat_after
from trainid_ros.train.forces import BrakeActuator, BrakeCommandChange, CommandHistory, davis
from trainid_ros.train.train_file import TrainFile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.train.train_file import Effect


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
        self._brake = train_file.brake
        self.reset()

    def reset(self) -> None:
        """Start a new drive."""
        self._stamp_ns, self._speed = 0, 0.0
        self.motion = Motion(time_s=0.0, distance_run=0.0)
        self._actuator = BrakeActuator(self._brake)

    def follow(self, sample: Sample) -> Motion:
        """Take in a sample; return the motion of the drive up to its stamp."""
        start_ns, before = self._stamp_ns, self.motion
        if not 0 < start_ns <= sample.stamp_ns:  # another drive
            start_ns, self._actuator.commands = sample.stamp_ns, CommandHistory()
        self._actuator.commands.follow(sample.brake_changes)
        elapsed = seconds(sample.stamp_ns - start_ns)
        speed = 0.5 * (self._speed + sample.speed) if elapsed <= _MAX_GAP_S else 0.0
        brake_integral = self._actuator.advance(start_ns, sample.stamp_ns)
        brake = self._actuator.output
        rate = self._brake.rate_at(speed)
        heat = heat_after(before.heat, rate * brake_integral / elapsed, speed, elapsed) if elapsed else before.heat
        self.motion = Motion(
            time_s=before.time_s + elapsed,
            distance_run=before.distance_run + speed * elapsed,
            since_release=0.0 if brake < BRAKE_APPLIED else before.since_release + elapsed,
            heat=heat,
            brake=brake,
        )
        self._stamp_ns, self._speed = sample.stamp_ns, sample.speed
        return self.motion


# Largest change of speed by the forces that a healthy sensor may not show [m/s]: more than any quantum, and more than
# the train file's error of the resistance adds up to while cruising.
_MAX_MISSING: Final = 0.5
# Density of the difference of two equal measurements at zero, times sigma: 1 / (2 sqrt(pi)), rounded.
_EQUAL: Final = 0.2821
# Probability of a repeat above which coarse steps hide the noise, so that repeats say nothing [1].
_MAX_REPEAT_PROBABILITY: Final = 0.4
# Time constants after the dead time until a brake has followed a command to 1 - exp(-2) = 86 %.
_FOLLOWED: Final = 2.0
# Probability of chance repeats below which the sensor is stuck [1]: once in 6 years at 5 Hz.
_MIN_PROBABILITY: Final = 1e-9
# Smallest number of repeats that is judged.
_MIN_REPEATS: Final = 5
# Number of changes of the speed that show its noise first.
_MIN_CHANGES: Final = 100


class StuckSpeed:
    """Detects a stuck speed sensor, sample by sample."""

    STATE: ClassVar[State] = declare(unknown('_speed'), '_missing', '_repeats', '_max_repeats', '_changes', '_braked_s')

    def __init__(self, known: KnownForce) -> None:
        self._known = known
        brake = known.train_file.brake
        self._followed_s = brake.delay + _FOLLOWED * brake.time_constant
        self._speed = math.nan  # Last measured speed [m/s], NaN before the first
        self._missing = 0.0  # Expected change of speed since the measured speed last changed [m/s]
        self._repeats = 0  # Number of times that the last speed has come again
        self._max_repeats = 0  # Limit for a noisy speed, as known when it changed last; 0 if repeats say nothing
        self._changes = 0  # Number of changes in motion, up to those that show the noise
        self._braked_s = 0.0  # Time for which the brake has been applied [s]

    def reject(self, sample: Sample, noise: SpeedNoise) -> Rejection | None:
        """Return why the speed of a sample is rejected, or None if it is accepted; ``noise`` is that until then."""
        self._braked_s = self._braked_s + sample.dt if sample.brake_command < 0.0 and sample.dt > 0.0 else 0.0
        if sample.speed != self._speed or sample.speed < STANDING or math.isnan(sample.dt):
            if sample.speed >= STANDING and sample.speed != self._speed:
                self._changes = min(self._changes + 1, _MIN_CHANGES)
                self._max_repeats = max_repeats(noise) if self._changes == _MIN_CHANGES else 0
            self._speed, self._missing, self._repeats = sample.speed, 0.0, 0
            return None
        self._repeats += 1
        expected = self._acceleration(sample) * sample.dt
        if is_finite(expected):
            self._missing += expected
        if abs(self._missing) > _MAX_MISSING:
            return Rejection(sample.stamp_ns, Reason.SPEED_STUCK, self._missing, _MAX_MISSING)
        if 0 < self._max_repeats < self._repeats:
            return Rejection(sample.stamp_ns, Reason.SPEED_STUCK, float(self._repeats), float(self._max_repeats))
        return None

    def _acceleration(self, sample: Sample) -> float:
        """Return the acceleration expected from the brake command, or from traction less resistance [m/s^2].

        It is NaN while the brake need not have followed the command yet.
        """
        if sample.brake_command < 0.0:
            return sample.brake_command if self._braked_s > self._followed_s else math.nan
        known = self._known
        resistance = davis(known.train_file.resistance, sample.speed) + known.track(sample)
        return (known.traction(max(sample.force_mean, 0.0), sample) - resistance) / known.inertia


def max_repeats(noise: SpeedNoise) -> int:
    """Return how often in a row a noisy speed may come again, 0 if any number is possible."""
    repeated = max(_EQUAL * noise.quantum / noise.std, 1.0 - noise.changed)
    if repeated >= _MAX_REPEAT_PROBABILITY or not noise.is_seen:
        return 0
    return (
        max(_MIN_REPEATS, math.ceil(math.log(_MIN_PROBABILITY) / math.log(repeated)))
        if repeated > 0.0
        else _MIN_REPEATS
    )


StreamEvent: TypeAlias = Sample | Rejection | TimeJump

MAX_STEP_S: Final = 3600.0
"""Largest step back of a clock being set [s]. A larger step back starts a new drive, unless it undoes a recent step
forward.
"""
# Age of a command that a brake has followed whatever its dead time and lag, which are seconds [ns].
_FOLLOWED_NS: Final = 60 * NS_PER_S


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
        finding: What contradicts what in the inputs, empty if nothing does.
        is_fault_confirmed: True once a finding has lasted for some motion: what was learned just before may be wrong.
        has_changed: True while forces, commands or distances are inconsistent with recent history.
        was_false_alarm: True if the last such change was a false alarm.
        is_trusted: True if an estimate from these inputs may be valid: they agree, or cannot be compared.
    """

    STATE: ClassVar[State] = declare(
        '_aligner', '_history', '_correction', '_stuck', '_plausibility', '_is_skipping',
        several('_skipped', BrakeCommandChange), '_first_ns', 'behind_ns', 'finding', 'is_fault_confirmed',
        'has_changed', 'was_false_alarm', 'is_trusted',
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
        self._stuck = StuckSpeed(self._known)
        self._plausibility = PlausibilityMonitor(self._known)
        # Whether the last sample was rejected, and the brake commands of all such samples since the last accepted one.
        self._is_skipping = False
        self._skipped: list[BrakeCommandChange] = []
        self._first_ns = 0
        # How far the last required topic is behind the newest stamp, beyond the correction of the force's stamps [ns].
        self.behind_ns = 0
        self._conclude()

    def _conclude(self) -> None:
        """Keep what the checks of the inputs say after a sample, for all who ask."""
        checks = self._plausibility
        self.finding = checks.finding
        self.is_fault_confirmed = checks.is_fault_confirmed
        self.has_changed = checks.has_changed
        self.was_false_alarm = checks.was_false_alarm
        self.is_trusted = checks.is_trusted

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
    def brake_delay(self) -> BrakeDelayCheck:
        """Check of the dead time of the brake: where it is wrong, no brake rate is valid."""
        return self._plausibility.brake_delay

    @property
    def last_finding(self) -> str:
        """The last contradiction found, empty if there never was one."""
        return self._plausibility.last_finding

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

        A sample whose ``rejection`` is set has a speed that must not be used.
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
        if not self._rejects_faults:
            return
        changed = self.has_changed
        stuck, contradiction = self._stuck.reject(sample, self._plausibility.noise), self._plausibility.follow(sample)
        sample.rejection = contradiction if stuck is None else stuck
        self._conclude()
        if sample.rejection is not None:
            self._skip(sample)
        # Estimators go back after a false alarm, so for them the sample follows a gap.
        elif self._is_skipping or (changed and not self.has_changed and self.was_false_alarm):
            self._resume(sample)

    def _skip(self, sample: Sample) -> None:
        """Keep the changes of the brake command in a rejected sample, as long as the last of them may still act."""
        self._is_skipping = True
        self._skipped.extend(sample.brake_changes)
        since_ns = sample.stamp_ns - _FOLLOWED_NS
        while len(self._skipped) > 1 and self._skipped[1].stamp_ns <= since_ns:
            del self._skipped[0]

    def _resume(self, sample: Sample) -> None:
        """Merge the changes of the rejected samples, if any, into the next one, which then follows a gap.

        The command in force is stated again: an estimator that went back has missed those since then.
        """
        changes = (*self._skipped, *sample.brake_changes)
        if is_finite(sample.brake_command):
            changes = (*changes, BrakeCommandChange(sample.stamp_ns, sample.brake_command))
        self._is_skipping, self._skipped = False, []
        sample.dt, sample.brake_changes, sample.brake_gap = math.nan, changes, True

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

    def follow(self, finding: str, now_s: float) -> None:
        """Update the current fault: a finding after a sample, '' if there is none, replaces the last one."""
        lasts = self.finding != '' and math.isnan(self.end_s)
        if finding and not lasts:
            self.begin_s, self.end_s = now_s, math.nan
        elif lasts and not finding:
            self.end_s = now_s
        self.finding = finding or self.finding

    @property
    def text(self) -> str:
        """What contradicted what, and when."""
        if math.isnan(self.end_s):
            return f'inputs contradict each other since {self.begin_s:.1f} s: {self.finding}'
        return f'inputs contradicted each other from {self.begin_s:.1f} to {self.end_s:.1f} s: {self.finding}'
