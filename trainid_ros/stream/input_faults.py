# SPDX-License-Identifier: Apache-2.0
"""What is wrong with the inputs, and which estimates must wait for it.

The balance of forces and distances is compared by :class:`~trainid_ros.stream.input_check.InputCheck`. Beside it stand
checks of what that cannot see, or sees some seconds later: messages that no healthy source sends, a train that rolls
away under its brake, and a brake rate that changes over speed otherwise than the train file says.

Whatever they find condemns some of the inputs. Only estimators that use one of them must wait.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare
from trainid_ros.stream.brake_shape import BrakeShapeCheck
from trainid_ros.stream.fault_filter import MIN_BRAKE
from trainid_ros.stream.fault_table import BRAKE, BRAKE_LATE, FORCE_LATE, GAIN, TABLE, Input
from trainid_ros.stream.input_blocks import MIN_SPEED, MOVING
from trainid_ros.stream.input_check import InputCheck
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.message_check import (
    MAX_MASS,
    CommandCheck,
    EmergencyCheck,
    ExcursionCheck,
    MassCheck,
    MessageCheck,
    ReleaseCheck,
    RepeatCheck,
    SpikeCheck,
)
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import STANDING, davis

# Smallest spike of the gradient, which as the mean under a train cannot change for a moment [per mille].
_GRADIENT_SPIKE: Final = 5.0
_GRADIENT_SPIKE_S: Final = 0.65  # s: longest duration of one
_COMMAND_SPIKE: Final = 0.15  # m/s^2: smallest spike of the brake command
_COMMAND_SPIKE_S: Final = 0.25  # s: longest duration of one
_COMMAND_HELD_S: Final = 1.0  # s: shortest time for which the command has held before it
# Error of a force by the change of the speed over two samples, besides the noise of the speed [N/kN].
_IMPULSE_STD: Final = 3.0

# A brake has followed a command after its dead time and this many time constants: to 1 - exp(-2) = 86 %.
_TIME_CONSTANTS: Final = 2.0
_HOLDING: Final = -0.3  # m/s^2: a brake command that holds a train on any gradient
# A rise of the speed that is no noise [m/s], beside this many standard deviations of it.
_ROLLING: Final = 0.2
_ROLLING_SIGMAS: Final = 4.0

_HOLDS: Final = 0.2  # the command holds where the brake differs by no more than this share in all blocks ...
# ... up to this number before and after: then an error of the dead time by some 1.5 s does not matter.
_NEIGHBOURS: Final = 3

# Motion under a finding after which what was learned before is wrong: a single odd moment is over by then [s].
_LASTING_S: Final = 2.0
# Motion before which nothing is taken on trust, at first and after a fault [s]: units and signs show at a departure.
_CONFIRMED_S: Final = 30.0


@dataclass(slots=True)
class Trust:
    """What is wrong with the inputs that one kind of estimate uses."""

    finding: str = ''  # What is wrong with them, empty if nothing is: nothing must be learned from them
    suspicion: str = ''  # What may be wrong, empty if nothing is suspected: no estimate is valid
    objection: str = ''  # Why else no estimate is valid yet, empty if it may be
    lasting_s: float = 0.0  # Time in motion under the finding [s]

    @property
    def is_full(self) -> bool:
        """True if an estimate from these inputs may be valid."""
        return not (self.finding or self.suspicion or self.objection)

    @property
    def is_fault_confirmed(self) -> bool:
        """True once a finding has lasted for some motion: what was learned just before it may be wrong."""
        return self.lasting_s >= _LASTING_S

    @property
    def doubt(self) -> str:
        """Why no estimate may be valid, empty if it may be."""
        if self.finding:
            return 'inputs contradict each other'
        return f'it is suspected that {self.suspicion}' if self.suspicion else self.objection

    def update(self, finding: str, suspicion: str, objection: str, moved_s: float) -> None:
        """Set what is the case after some motion [s]."""
        self.lasting_s = self.lasting_s + moved_s if finding else 0.0
        self.finding, self.suspicion, self.objection = finding, suspicion, objection


class InputFaults:
    """All checks of the inputs, sample by sample.

    Attributes:
        finding: What is wrong with the inputs, empty if nothing is.
        last_finding: The last finding, empty if there never was one.
        resistance: Trust in what resistance and speed model use.
        brake_rate: Trust in what the brake rate uses.
    """

    STATE: ClassVar[State] = declare(
        'finding', 'last_finding', 'resistance', 'brake_rate', 'check', 'shape', '_mass', '_commands', '_emergency',
        '_command_spikes', '_releases', '_force_spikes', '_gradient_spikes', '_repeats', '_speed', '_held_s',
        '_slowest', '_moved_s', '_blocks',
    )  # fmt: skip

    def __init__(self, known: KnownForce) -> None:
        self._known = known
        self._followed_s = known.brake.delay + _TIME_CONSTANTS * known.brake.time_constant
        self._max_speed = known.train_file.train.max_speed
        self.finding = self.last_finding = ''
        self.resistance, self.brake_rate = Trust(), Trust()
        self.check = InputCheck(known)
        self.shape = BrakeShapeCheck()
        self._mass = MassCheck()
        self._commands = CommandCheck()
        self._emergency = EmergencyCheck()
        self._command_spikes = ExcursionCheck(
            topic=Input.COMMAND.value,
            height=_COMMAND_SPIKE,
            longest_s=_COMMAND_SPIKE_S,
            calm_s=_COMMAND_HELD_S,
            direction=-1.0,
        )
        self._releases = ReleaseCheck(topic=Input.COMMAND.value)
        self._force_spikes = SpikeCheck(topic=Input.FORCE.value)
        self._gradient_spikes = ExcursionCheck(
            topic=Input.GRADIENT.value, height=_GRADIENT_SPIKE, longest_s=_GRADIENT_SPIKE_S
        )
        self._repeats = RepeatCheck()
        self._speed = 0.0  # Last speed [m/s]
        self._held_s = 0.0  # Time since the brake was applied, or released [s]
        # Lowest speed since the brake has followed a command that holds the train, the speed itself before that [m/s].
        self._slowest = 0.0
        self._moved_s = 0.0  # Time in motion with known forces, up to that which confirms the inputs [s]
        self._blocks = 0  # Number of blocks of the check whose brake was looked at

    @property
    def brake_warning(self) -> str:
        """What is wrong with the brake of the train file, empty if nothing is."""
        verdict = self.check.verdict
        is_of_brake = Input.BRAKE in TABLE[verdict.row].condemns
        return verdict.finding if is_of_brake else self.shape.warning(self._max_speed)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Topics that the finding condemns, none without one."""
        if not self.finding:
            return ()
        of_messages = (frozenset({what}) for check, what in self._messages() if check.finding)
        condemned = next(of_messages, TABLE[self.check.verdict.row].condemns)
        return tuple(sorted({one.topic for one in condemned} - {''}))

    @property
    def holds_back(self) -> tuple[str, ...]:
        """Estimates that wait because of the finding."""
        of_resistance = ('resistance', 'speed_model') if self.resistance.finding else ()
        return (*of_resistance, *(('brake_rate',) if self.brake_rate.finding else ()))

    @property
    def misread(self) -> str:
        """Which input has a wrong unit or sign, is stuck, or has two publishers, empty if none: no train does that."""
        verdict, stuck = self.check.verdict, 'ato/speed is stuck' if self._repeats.is_stuck else ''
        is_misread = TABLE[verdict.row].misread or not 1.0 / MAX_MASS < self.check.gain < MAX_MASS
        return self._mass.misread or self._commands.finding or (verdict.finding if is_misread else stuck)

    def _messages(self) -> tuple[tuple[MessageCheck, Input], ...]:
        """Return the checks of messages with the input that each condemns, those of the brake command last."""
        return (
            (self._mass, Input.MASS), (self._force_spikes, Input.FORCE), (self._gradient_spikes, Input.GRADIENT),
            (self._commands, Input.COMMAND), (self._emergency, Input.COMMAND), (self._command_spikes, Input.COMMAND),
            (self._releases, Input.COMMAND),
        )  # fmt: skip

    def take(self, sample: Sample) -> None:
        """Take in a sample; set why estimators must not use it."""
        dt = sample.dt if is_finite(sample.dt) else 0.0
        self._repeats.add(sample.speed, self.check.blocks.noise)
        self._check_messages(sample, dt)
        self.check.take(sample)
        self._check_brake(sample, dt)
        self._conclude(dt if sample.speed >= MIN_SPEED else 0.0)
        self._reject(sample)
        self._speed = sample.speed

    def _check_messages(self, sample: Sample, dt: float) -> None:
        """Look for messages that no healthy source sends."""
        known, commands, is_moving = self._known, self._commands, sample.speed >= MIN_SPEED
        before = commands.command
        self._mass.add(sample.mass, known.train_file.train.mass, is_overdue=sample.is_weighing_overdue)
        commands.add(sample.brake_changes, dt)
        if not is_moving:  # the command may do anything while the train is held
            commands.reversals = 0.0
        self._held_s = self._held_s + dt if (commands.command < 0.0) == (before < 0.0) else 0.0
        self._command_spikes.add(sample.brake_command, dt)
        self._gradient_spikes.add(sample.gradient, dt)
        force = known.traction(sample.force, sample)
        self._emergency.add(force, dt, emergency=sample.emergency)
        self._releases.add(sample.brake_command if is_moving else math.nan, force, self._followed_s, dt)
        if dt > 0.0:
            self._check_force(sample, force)

    def _check_force(self, sample: Sample, force: float) -> None:
        """Look for spikes of the reported force [N/kN]."""
        known, dt, mean, by_speed = self._known, sample.dt, math.nan, math.nan
        if is_finite(sample.gradient_mean) and is_finite(sample.force_mean):
            mean = known.traction(sample.force_mean, sample)
            is_released = sample.brake_command == 0.0 and self._held_s > known.settling and not sample.emergency
            if is_released and sample.speed >= MIN_SPEED:
                resistance = davis(known.train_file.resistance, sample.speed) + known.track(sample)
                by_speed = known.inertia * (sample.speed - self._speed) + dt * resistance
        std = known.inertia * math.sqrt(2.0) * self.check.blocks.noise.std + _IMPULSE_STD * 2.0 * dt
        self._force_spikes.add(force, mean, by_speed, std, dt)

    def _check_brake(self, sample: Sample, dt: float) -> None:
        """Look at the brake: whether it has acted, whether it holds, and at its rate over speed."""
        command, speed, is_complete = self._commands.command, sample.speed, is_finite(sample.force_mean)
        if speed >= MIN_SPEED and is_complete and is_finite(sample.gradient_mean) and not self.check.is_speed_odd:
            self._moved_s = min(self._moved_s + dt, _CONFIRMED_S)
        holds = command < _HOLDING and self._held_s > self._followed_s
        self._slowest = min(self._slowest, speed) if holds else speed
        if self._blocks != self.check.blocks.count:
            self._blocks = self.check.blocks.count
            self._follow_shape()

    def _follow_shape(self) -> None:
        """Compare the specific force of the brake with that of the train file, in the middle of the blocks kept."""
        blocks, known = self.check.blocks, self._known
        middle = blocks.block(_NEIGHBOURS)
        level = middle.brake
        if level > -MIN_BRAKE or middle.state != MOVING or self.brake_rate.finding:
            self.shape.end()
            return
        for back in range(2 * _NEIGHBOURS + 1):
            block = blocks.block(back)
            if not (block.is_known and abs(block.brake - level) < _HOLDS * -level):
                return
        resistance = davis(known.train_file.resistance, middle.speed) + middle.gradient + middle.extra
        y = known.inertia * middle.speed_step / middle.seconds + resistance - max(middle.force, 0.0)
        share = min(middle.speed / self._max_speed, 1.0) if self._max_speed > 0.0 else 0.0
        self.shape.add(y, middle.rate * level, share - 0.5)

    def _conclude(self, moved_s: float) -> None:
        """Conclude which estimates must wait, after some motion [s]."""
        verdict = self.check.verdict
        row, suspect = TABLE[verdict.row], TABLE[verdict.suspect]
        found = suspected = of_command = command_suspected = ''
        for check, what in self._messages():
            # What condemns inputs of the resistance condemns those of the brake rate, which uses the command too.
            of_command, command_suspected = of_command or check.finding, command_suspected or check.suspicion
            if what is not Input.COMMAND:
                found, suspected = of_command, command_suspected
        self.resistance.update(
            found or (verdict.finding if row.holds_resistance else ''),
            suspected or (verdict.suspicion if suspect.holds_resistance else ''),
            self._objection_to_forces(),
            moved_s,
        )
        self.brake_rate.update(
            of_command or (verdict.finding if row.holds_brake_rate else ''),
            command_suspected or (verdict.suspicion if suspect.holds_brake_rate else ''),
            self.resistance.objection or self._objection(),
            moved_s,
        )
        # After a fault the inputs have to confirm each other anew.
        if self.resistance.finding:
            self._moved_s = 0.0
        if self.brake_rate.finding:
            self.check.is_brake_confirmed = False
        self.finding = of_command or ('' if Input.BRAKE in row.condemns else verdict.finding)
        self.last_finding = self.finding or self.last_finding

    def _objection_to_forces(self) -> str:
        """Return why nothing is valid although the inputs agree, empty if it may be."""
        if self._moved_s < _CONFIRMED_S:
            return 'the inputs have not yet confirmed each other'
        check = self.check
        return (
            check.scale_objection() or check.slope_objection()
            or check.at_limit((GAIN, FORCE_LATE)) or check.resistance_objection()
        )  # fmt: skip

    def _objection(self) -> str:
        """Return why no brake rate is valid although its inputs agree, empty if it may be."""
        if self.shape.is_wrong:
            return 'the brake contradicts the train file'
        if self.shape.is_odd:
            return 'the present braking contradicts the train file'
        if not self.check.is_brake_confirmed:
            return 'no braking has confirmed brake.delay and brake.rate yet'
        return self.check.at_limit((BRAKE, BRAKE_LATE)) or self.check.timing_objection()

    def _reject(self, sample: Sample) -> None:
        """Set why estimators must not use a sample, if they must not."""
        repeats, stamp_ns, rise = self._repeats, sample.stamp_ns, sample.speed - self._slowest
        limit = _ROLLING + _ROLLING_SIGMAS * self.check.blocks.noise.std
        if repeats.is_stuck:
            found = Rejection(stamp_ns, Reason.SPEED_STUCK, float(repeats.repeats), float(repeats.most))
            sample.rejection = sample.brake_rejection = found
        elif self._slowest < STANDING and rise > limit:  # it rolls away under the brake
            found = Rejection(stamp_ns, Reason.CONTRADICTION, rise, limit)
            sample.rejection = sample.brake_rejection = found
        elif self.brake_rate.finding:
            is_stuck = Input.SPEED in TABLE[self.check.verdict.row].ignores
            reason = Reason.SPEED_STUCK if is_stuck else Reason.CONTRADICTION
            found = Rejection(stamp_ns, reason, math.nan, math.nan)
            sample.brake_rejection = found
            if self.resistance.finding:
                sample.rejection = found
