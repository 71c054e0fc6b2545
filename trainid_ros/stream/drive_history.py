# SPDX-License-Identifier: Apache-2.0
"""History of the drive that effects depend on: time, distance, brake response and brake heat."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Final

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.scalars import seconds
from trainid_ros.state import State, declare
from trainid_ros.stream.samples import Motion, Sample
from trainid_ros.train.effects import BRAKE_APPLIED, heat_after
from trainid_ros.train.forces import CommandHistory, actuator_response
from trainid_ros.train.train_file import TrainFile

# During a longer gap the train may have stood still.
_MAX_GAP_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class DriveHistoryState:
    """State of the tracker: newest stamp [ns], speed [m/s] and motion there, and commands that may still act."""

    stamp_ns: int = 0
    speed: float = 0.0
    motion: Motion = field(default_factory=lambda: Motion(time_s=0.0, distance_run=0.0))
    commands: CommandHistory = field(default_factory=CommandHistory)


class DriveHistoryTracker:
    """Tracks a drive sample by sample, with the brake of the train file."""

    STATE: ClassVar[State] = declare('state')

    def __init__(self, train_file: TrainFile) -> None:
        self._brake = train_file.brake
        self._delay_ns = round(self._brake.delay * NS_PER_S)
        self.state = DriveHistoryState()

    def reset(self) -> None:
        """Start a new drive."""
        self.state = DriveHistoryState()

    def follow(self, sample: Sample) -> Motion:
        """Take in a sample; return the motion of the drive up to its stamp."""
        state = self.state
        same_drive = 0 < state.stamp_ns <= sample.stamp_ns
        start_ns = state.stamp_ns if same_drive else sample.stamp_ns
        commands = state.commands if same_drive else CommandHistory()
        commands.follow(sample.brake_changes)
        before, elapsed = state.motion, seconds(sample.stamp_ns - start_ns)
        speed = 0.5 * (state.speed + sample.speed) if elapsed <= _MAX_GAP_S else 0.0
        brake, brake_integral = actuator_response(
            commands,
            start_ns,
            sample.stamp_ns,
            before.brake,
            delay_ns=self._delay_ns,
            time_constant=self._brake.time_constant,
        )
        rate = self._brake.rate_at(speed)
        heat = heat_after(before.heat, rate * brake_integral / elapsed, speed, elapsed) if elapsed else before.heat
        motion = Motion(
            time_s=before.time_s + elapsed,
            distance_run=before.distance_run + speed * elapsed,
            since_release=0.0 if brake < BRAKE_APPLIED else before.since_release + elapsed,
            heat=heat,
            brake=brake,
        )
        commands.prune(sample.stamp_ns - self._delay_ns)
        self.state = DriveHistoryState(sample.stamp_ns, sample.speed, motion, commands)
        return motion
