# SPDX-License-Identifier: Apache-2.0
"""The stream of samples: everything between the records of a train and the estimators, none of which it depends on.

Records are corrected for sensor errors that the train file states, aligned to the stamps of the speed, given the
history of the drive where effects depend on it, and checked for a stuck speed sensor and for contradictions.
Estimators with the same train file and settings can share one stream.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar, Final, TypeAlias

from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.interface.results import Rejection
from trainid_ros.interface.scalars import is_finite
from trainid_ros.state import State, declare, encode, restore, several
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.stream.brake_checks import BrakeDelayCheck
from trainid_ros.stream.drive_history import DriveHistoryTracker
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.plausibility import PlausibilityMonitor
from trainid_ros.stream.samples import Sample
from trainid_ros.stream.sensor_correction import SensorCorrection
from trainid_ros.stream.stuck_speed import StuckSpeed
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import TrainFile

StreamEvent: TypeAlias = Sample | Rejection | TimeJump

LARGEST_STEP_S: Final = 3600.0
"""A clock is set back by at most this time [s]; a larger step back is another drive, but for a return."""
# A brake has followed a command longer ago than this, whatever its lag [ns].
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
    """

    STATE: ClassVar[State] = declare(
        '_aligner', '_history', '_correction', '_stuck', '_plausibility', '_is_skipping',
        several('_skipped', BrakeCommandChange), '_first_ns', '_behind_ns',
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
        self._history = DriveHistoryTracker(config.train_file)
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
        self._behind_ns = 0

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
        return self._plausibility.finding

    @property
    def is_contradicted(self) -> bool:
        """True once a finding has lasted for some motion: what was learned just before it may be wrong."""
        return self._plausibility.is_lasting

    @property
    def brake_delay(self) -> BrakeDelayCheck:
        """Check of the dead time of the brake: where it is wrong, no brake rate is valid."""
        return self._plausibility.brake_delay

    @property
    def has_changed(self) -> bool:
        """True while forces, commands or distances are improbable together by what they were before."""
        return self._plausibility.has_changed

    @property
    def has_returned(self) -> bool:
        """True if it is as it was before the last such change, which was then no change of the train."""
        return self._plausibility.has_returned

    @property
    def last_finding(self) -> str:
        """The last contradiction found, empty if there never was one."""
        return self._plausibility.last_finding

    @property
    def is_trusted(self) -> bool:
        """True if an estimate from these inputs may be valid: they agree, or cannot be compared."""
        return self._plausibility.is_trusted

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
        return self._behind_ns > timeout_ns and self._aligner.is_behind(timeout_ns + self._skew_ns)

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
        newest_ns = self.newest_ns
        self._first_ns = self._first_ns or newest_ns
        self._behind_ns = newest_ns - (self._aligner.complete_ns or self._first_ns) - self._skew_ns
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
        if sample.rejection is not None:
            self._skip(sample)
        # Estimators go back where all is as it was before a change, so for them the sample follows a gap.
        elif self._is_skipping or (changed and not self.has_changed and self.has_returned):
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
    return jump.step_s < -LARGEST_STEP_S and not jump.returns and policy is TimeJumpPolicy.RESET
