# SPDX-License-Identifier: Apache-2.0
"""Check the inputs against each other before anything is learned from them: units, signs, stuck or late inputs.

With specific forces [N/kN] and y = 1000 (1 + gamma) (dv/dt) / g0 + i + w(v), where w(v) is that of the train file,

- y = x = traction where no brake acts,
- y = x = 1000 (1 + gamma) r c / g0 where the brake has followed the target acceleration c for some time; r is the brake
  rate of the train file.

Both are regressions through the origin, y = R x, over the last seconds of each kind. R is about 1: mass, brake rate and
resistance differ from those of the train file by some ten per cent, wrong units by factors. Further checks compare
distances, the gradient with the line, and the times of steps. What is found lasts until it is certainly mended; the
stream rejects all samples meanwhile. A sample whose last two seconds contradict the balance by more than any resistance
is rejected at once. While a change is only suspected, samples are used, but no estimate is trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Final

from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare
from trainid_ros.stream.balance_checks import SUDDEN_MEMORY, BalanceCheck, ChangeCheck, LineCheck, ShiftCheck
from trainid_ros.stream.brake_checks import BrakeDelayCheck, BrakeTiming
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.stream.message_check import CommandCheck, ExcursionCheck, MassCheck, ReleaseCheck, SpikeCheck
from trainid_ros.stream.samples import STANDING, Sample
from trainid_ros.stream.slope_checks import (
    BRAKE_RANGE,
    TRACTION_RANGE,
    DistanceCheck,
    Effort,
    Regression,
    Slope,
    is_leap,
)
from trainid_ros.train.forces import davis
from trainid_ros.train.line import LineProfile

# Noise of the speed at the start [m/s].
_SPEED_STD: Final = 0.025
# Motion after the checks have begun anew in which a delay that was found before is suspected still [s]: steps of the
# traction may be rare.
_SUSPECTED_S: Final = 900.0

# Smallest spike of the gradient, which as the mean under a train cannot change for a moment [per mille].
_GRADIENT_SPIKE: Final = 5.0
# Its longest duration [s].
_GRADIENT_SPIKE_S: Final = 0.65
# Smallest spike of the brake command [m/s^2].
_COMMAND_SPIKE: Final = 0.15
# Its longest duration [s].
_COMMAND_SPIKE_S: Final = 0.25
# Shortest time for which the command has held before it [s].
_COMMAND_HELD_S: Final = 1.0

# Memory of the recent slope of acceleration over force [blocks].
RECENT: Final = 8.0
# Smallest number of blocks that it needs.
_RECENT_MIN: Final = 4.0
# Smallest force that shows it, in root mean square [N/kN].
_RECENT_FORCE: Final = 15.0
# Acceleration that no train has [m/s^2].
_STEP: Final = 4.0
# Standard deviations of the noise of the speed added to it [1].
_STEP_SIGMAS: Final = 8.0

NO_BLOCK: Final = 0
"""Kind of a block: nothing can be compared."""
RELEASED: Final = 1
"""No brake acts."""
BRAKED: Final = 2
"""The brake has followed its command."""


@dataclass(slots=True)
class Block:
    """Integrals over the samples of a block, all of which have the brake off, or applied."""

    kind: int = NO_BLOCK  # Which of them
    seconds: float = 0.0  # Its length [s]
    specific_impulse: float = 0.0  # Integral of the force by speed, gradient and w(v) [N/kN s]
    traction: float = 0.0  # Integral of traction [N/kN s]
    command: float = 0.0  # Integral of the brake command [m/s]

    def add(self, dt: float, specific_impulse: float, traction: float, command: float) -> None:
        """Add a sample: its length [s], the integral of the force, means of traction [N/kN] and command [m/s^2]."""
        self.seconds += dt
        self.specific_impulse += specific_impulse
        self.traction += dt * traction
        self.command += dt * command


@dataclass(slots=True)
class PlausibilityState:
    """State of the monitor."""

    mass: MassCheck = field(default_factory=MassCheck)  # Check of the mass
    commands: CommandCheck = field(default_factory=CommandCheck)  # Check for two publishers of the brake command
    # Check for spikes of the brake command
    command_spikes: ExcursionCheck = field(
        default_factory=lambda: ExcursionCheck(
            topic='ato/brake_command',
            height=_COMMAND_SPIKE,
            longest_s=_COMMAND_SPIKE_S,
            calm_s=_COMMAND_HELD_S,
            direction=-1.0,
        )
    )
    releases: ReleaseCheck = field(default_factory=ReleaseCheck)  # Check for spikes of the brake command towards zero
    spikes: SpikeCheck = field(default_factory=SpikeCheck)  # Check for spikes of the force
    # Check for spikes of the gradient
    gradient_spikes: ExcursionCheck = field(
        default_factory=lambda: ExcursionCheck(
            topic='ato/gradient', height=_GRADIENT_SPIKE, longest_s=_GRADIENT_SPIKE_S
        )
    )
    distance: DistanceCheck = field(default_factory=DistanceCheck)  # Check of speed against position
    line: LineCheck = field(default_factory=LineCheck)  # Check of the gradient
    shift: ShiftCheck = field(default_factory=ShiftCheck)  # Check of the times of steps
    traction: Slope = field(default_factory=Slope)  # Slope of traction
    brake: Slope = field(default_factory=Slope)  # Slope of the brake
    # Slope of the reported force over the brake command, while the brake is applied
    effort: Effort = field(default_factory=Effort)
    recent: Regression = field(default_factory=Regression)  # Acceleration over traction or brake in the last seconds
    balance: BalanceCheck = field(default_factory=BalanceCheck)  # Check of the residual
    change: ChangeCheck = field(default_factory=ChangeCheck)  # Check for changes that the balance does not explain
    brake_delay: BrakeDelayCheck = field(default_factory=BrakeDelayCheck)  # Check of the dead time of the brake
    last: str = ''  # The last finding, empty if there never was one
    confirmed: bool = False  # True once the slope of traction was plausible
    moved_s: float = 0.0  # Time in motion with known forces [s]
    found_s: float = 0.0  # Time in motion under findings since the checks began [s]
    lasting_s: float = 0.0  # Time in motion under the present finding [s]
    retried: bool = False  # True if the checks have begun anew under a finding: they must then hold for some time
    # Noise of the speed
    noise: SpeedNoise = field(default_factory=lambda: SpeedNoise.declared(_SPEED_STD, robust=True))
    block: Block = field(default_factory=Block)  # The block that is being filled
    held_s: float = 0.0  # Time since the brake was applied, or released [s]
    slowest: float = 0.0  # Lowest speed since the brake has followed its command, the speed itself before that [m/s]
    strongest: float = 0.0  # Strongest command in the present window [m/s^2]
    strongest_before: float = 0.0  # Strongest command in the window before [m/s^2]
    strongest_s: float = 0.0  # Length of the present window [s]
    steady: float = 0.0  # Brake command when it last changed by more than a brake need follow [m/s^2]
    steady_s: float = 0.0  # Time since then [s]
    has_alternated: bool = True  # True if it was applied or released since the last finding about it
    driven: float = 0.0  # Distance driven [m]
    stopped: float = 0.0  # The same at the last stop [m]
    speed: float = math.nan  # Last speed [m/s], NaN before the first
    position: float = math.nan  # Last position [m]

    @property
    def finding(self) -> str:
        """What contradicts what, empty if nothing does."""
        return (
            self.mass.finding
            or self.commands.finding
            or self.command_spikes.finding
            or self.releases.finding
            or self.spikes.finding
            or self.gradient_spikes.finding
            or self.traction.finding
            or self.brake.finding
            or self.effort.finding
            or self.distance.finding
            or self.shift.finding
            or self.line.finding
            or self.change.finding
            or self.balance.finding
        )

    @property
    def is_suspected(self) -> bool:
        """True while the last seconds are inconsistent with those before."""
        commands = self.command_spikes.is_suspected or self.releases.is_suspected
        spikes = self.spikes.is_suspected or commands or self.gradient_spikes.is_suspected
        late = self.shift.is_suspected and self.moved_s < _SUSPECTED_S
        sudden = self.balance.is_suspected or self.change.is_suspected
        slopes = self.traction.is_suspected or self.brake.is_suspected or self.effort.is_suspected
        return sudden or slopes or late or spikes or self.distance.is_suspected or self.line.is_suspected

    @property
    def by_force(self) -> float:
        """Acceleration over what traction and brake give, over the last seconds [1]; NaN if they hardly act."""
        recent = self.recent
        strong = recent.count > _RECENT_MIN and recent.xx > _RECENT_FORCE * _RECENT_FORCE * recent.count
        return recent.value if strong else math.nan

    def follow_step(self, change: float, dt: float) -> None:
        """Forget what relates the speed to other inputs where it jumps [m/s] impossibly fast for this time [s]."""
        if abs(change) > _STEP * dt + _STEP_SIGMAS * self.noise.std:
            self.recent = Regression()
            self.distance.forget_ratio()

    @property
    def numbers(self) -> tuple[float, float]:
        """Value of what the finding is about, and its limit."""
        traction, brake, shift, balance = self.traction, self.brake, self.shift, self.balance
        for finding, value, limit in (
            (self.mass.finding, self.mass.ratio, self.mass.limit),
            (self.commands.finding, self.commands.reversals, self.commands.limit),
            (self.command_spikes.finding, self.command_spikes.spikes, self.command_spikes.limit),
            (self.releases.finding, self.releases.spikes, self.releases.limit),
            (self.spikes.finding, self.spikes.spikes, self.spikes.limit),
            (self.gradient_spikes.finding, self.gradient_spikes.spikes, self.gradient_spikes.limit),
            (traction.finding, traction.value, traction.limit(TRACTION_RANGE)),
            (brake.finding, brake.value, brake.limit(BRAKE_RANGE)),
            (self.effort.finding, self.effort.value, 1.0),
            (self.distance.finding, self.distance.error, self.distance.limit),
            (shift.finding, shift.delay, 0.0),
            (self.line.finding, self.line.value, self.line.limit),
            (self.change.finding, self.change.ratio, 1.0),
        ):
            if finding:
                return value, limit
        return balance.mean, balance.mean_limit


# Inputs are averaged over blocks, so that the noise of the speed matters little [s].
_BLOCK_S: Final = 0.5
# Slower trains may stand or shunt [m/s].
_MIN_SPEED: Final = 1.0
# A command below this brakes [m/s^2].
_BRAKING: Final = -0.02
# Slower trains may brake by friction alone [m/s].
_BLENDED: Final = 4.0
# Largest change of a steady command [m/s^2].
_STEADY: Final = 0.02
# The same as a share of the command [1].
_STEADY_SHARE: Final = 0.1
# Brake command assumed where some were not seen: as strong as any [m/s^2].
_UNSEEN: Final = -3.0
# A brake command that holds a train on any gradient [m/s^2].
_HOLDING: Final = -0.3
# A rise of the speed that is no noise [m/s].
_ROLLING: Final = 0.2
# Residual that no resistance explains [N/kN].
_SUDDEN: Final = 12.0
# Share of the traction added to it [1].
_SUDDEN_TRACTION: Final = 0.4
# Share of the brake force added to it [1].
_SUDDEN_BRAKE: Final = 0.8
# Multiple of that limit to which residuals are clipped in the search for late inputs [1]: slip is no step of traction.
_SLIP: Final = 3.0
# Traction that contradicts a brake which has followed its command [N/kN].
_DRIVING: Final = 10.0
# Largest noise of the speed, in standard deviations [1].
_SIGMAS: Final = 4.0
# Error of a force by the change of the speed over two samples, besides that noise [N/kN].
_IMPULSE_STD: Final = 3.0
# A brake has followed a command after its dead time and this many time constants.
_FOLLOWED: Final = 2.0
# Decay of a sudden residual while nothing can be compared [s].
_RESIDUAL_S: Final = 5.0
# Error of the gradient below which no other positions are tried [per mille].
_SAME_GRADIENT: Final = 0.5
# Error of the position [m].
_POSITION_ERROR: Final = 30.0
# Share of the distance driven added to it [1]: worn wheels may be 0.5 % off, and not all are corrected on the way.
_POSITION_DRIFT: Final = 0.006
# Shares of that error at which the line is looked up, nearer ones first [1].
_SHARES: Final = tuple(sign * k / 8.0 for k in range(1, 9) for sign in (1.0, -1.0))
# Distance after a stop at which the direction is known [m].
_TURNED: Final = 20.0
# Motion under a finding after which what was learned before is wrong: a single odd moment is over by then [s].
_LASTING_S: Final = 2.0
# Motion under findings after which all checks begin anew, so that none lasts when its inputs have gone [s].
_RETRY_S: Final = 300.0
# Motion without strong acceleration after which an estimate may be valid although the slope of traction is unknown [s].
_CALM_S: Final = 20.0
# Largest such acceleration, in root mean square [N/kN].
_CALM: Final = 15.0
# The same motion whatever the acceleration [s].
_LENIENT_S: Final = 90.0


class PlausibilityMonitor:
    """Check the inputs sample by sample."""

    STATE: ClassVar[State] = declare('state')

    def __init__(self, known: KnownForce) -> None:
        train_file = known.train_file
        brake, line = train_file.brake, train_file.line
        self._known = known
        self._followed_s = brake.delay + _FOLLOWED * brake.time_constant
        self._line = LineProfile(line, train_file.train.length) if line.gradient else None
        self._map_std = line.gradient_std
        self._timing = BrakeTiming(train_file)
        self.state = PlausibilityState()

    @property
    def noise(self) -> SpeedNoise:
        """Noise of the speed."""
        return self.state.noise

    @property
    def finding(self) -> str:
        """What contradicts what, empty if nothing does."""
        return self.state.finding

    @property
    def last_finding(self) -> str:
        """The last finding, empty if there never was one."""
        return self.state.last

    @property
    def is_fault_confirmed(self) -> bool:
        """True once a finding has lasted for some motion: what was learned just before it may be wrong."""
        return self.state.lasting_s >= _LASTING_S

    @property
    def brake_delay(self) -> BrakeDelayCheck:
        """Check of the dead time of the brake: where it is wrong, no brake rate is valid."""
        return self.state.brake_delay

    @property
    def has_changed(self) -> bool:
        """True while forces, commands or distances are inconsistent with recent history."""
        state = self.state
        forces = state.change.is_suspected or state.effort.is_suspected or state.balance.is_drifting
        return forces or state.distance.is_suspected

    @property
    def was_false_alarm(self) -> bool:
        """True if the last such change was a false alarm."""
        state = self.state
        return state.change.was_false_alarm and not (state.effort.has_stayed or state.balance.has_stayed)

    @property
    def is_trusted(self) -> bool:
        """True if an estimate from these inputs may be valid: they agree, or cannot be compared."""
        state, slope = self.state, self.state.traction
        if state.finding or state.is_suspected or (state.retried and state.moved_s < _RETRY_S):
            return False
        if state.confirmed:
            return True
        if state.last and not (state.retried and state.found_s == 0.0):  # what was found is not taken on trust
            return False
        calm = state.moved_s > _CALM_S and slope.yy < _CALM * _CALM * slope.count
        return calm or state.moved_s > _LENIENT_S

    def follow(self, sample: Sample) -> Rejection | None:
        """Take in a sample; return why it must not be used, None if nothing contradicts it."""
        state = self.state
        before, position = state.speed, state.position
        state.speed, state.position = sample.speed, sample.position
        state.noise.add(sample.speed, sample.dt)
        state.mass.add(sample.mass, self._known.train_file.train.mass)
        self._follow_command(sample)
        self._follow_brake(sample, before)
        if is_finite(sample.dt) and is_finite(before):
            state.follow_step(sample.speed - before, sample.dt)
            if sample.speed >= _MIN_SPEED:
                by_speed = 0.5 * (before + sample.speed) * sample.dt
                state.driven += by_speed
                by_position = sample.direction * (sample.position - position)
                state.distance.add(by_speed, by_position, state.by_force)
            else:
                by_speed, by_position = 0.0, sample.position - position
                state.distance.interrupt()
                state.distance.forget_ratio()
            if is_leap(by_speed, by_position) and not state.line.finding:  # another place of the line from now on
                state.line = LineCheck()
            self._check_forces(sample, before)
            self._check_standstill(sample.speed)
        else:
            self._interrupt()
        if finding := state.finding:
            state.last = finding
            self._persist(sample)
            value, limit = state.numbers
            return Rejection(sample.stamp_ns, Reason.CONTRADICTION, value, limit)
        state.lasting_s = 0.0
        if state.balance.is_sudden:
            return Rejection(sample.stamp_ns, Reason.CONTRADICTION, state.balance.residual, state.balance.limit)
        return None

    def _persist(self, sample: Sample) -> None:
        """Begin all checks anew after some motion under findings; no estimate is trusted until they have succeeded."""
        state = self.state
        if sample.speed >= _MIN_SPEED and sample.dt > 0.0:
            state.found_s += sample.dt
            state.lasting_s += sample.dt
        if state.found_s > _RETRY_S:
            self.state = PlausibilityState(
                commands=CommandCheck(command=state.commands.command),
                shift=ShiftCheck(delay=state.shift.delay),
                brake_delay=state.brake_delay,
                noise=state.noise,
                held_s=state.held_s,
                driven=state.driven,
                stopped=state.stopped,
                speed=state.speed,
                position=state.position,
                last=state.last,
                retried=True,
            )

    def _interrupt(self) -> None:
        state = self.state
        state.block.kind = NO_BLOCK
        state.shift.interrupt()

    def _follow_command(self, sample: Sample) -> None:
        """Follow the brake command, and how long the brake has been applied, or released."""
        state, dt = self.state, sample.dt if is_finite(sample.dt) else 0.0
        before = state.commands.command
        state.commands.add(sample.brake_changes, dt)
        state.command_spikes.add(sample.brake_command, dt)
        if sample.speed < _MIN_SPEED:  # the command may do anything while the train is held
            state.commands.reversals = 0.0
        state.held_s += dt
        state.steady_s += dt
        if abs(state.commands.command - state.steady) > max(_STEADY, _STEADY_SHARE * abs(state.steady)):
            state.steady, state.steady_s = state.commands.command, 0.0
        state.strongest = min(state.strongest, state.commands.command) if not sample.brake_gap else _UNSEEN
        state.strongest_s += dt
        if state.strongest_s > self._known.settling:
            state.strongest_before, state.strongest, state.strongest_s = state.strongest, state.commands.command, 0.0
        if (state.commands.command < _BRAKING) != (before < _BRAKING):
            state.held_s, state.has_alternated = 0.0, True

    def _follow_brake(self, sample: Sample, before: float) -> None:
        """Compare a whole braking with its command; ``before`` is the speed before [m/s]."""
        known, state, y, force, dt = self._known, self.state, math.nan, math.nan, sample.dt
        if sample.speed >= _MIN_SPEED and is_finite(sample.force_mean) and is_finite(sample.gradient_mean):
            resistance = davis(known.train_file.resistance, sample.speed) + known.track(sample)
            force = known.traction(sample.force_mean, sample)
            y = known.inertia * (sample.speed - before) + dt * (resistance - max(force, 0.0))
        rate = known.inertia * known.train_file.brake.rate_at(sample.speed) * known.brake_share(sample)
        braking = state.brake_delay.follow(sample, y, force, rate, self._timing)
        if braking is not None and braking.is_comparable and not state.finding:
            nominal = known.inertia * braking.commanded
            state.effort.take_impulses(braking.by_force / nominal, braking.by_speed / braking.by_command)

    def _check_forces(self, sample: Sample, before: float) -> None:
        """Add a sample to its block; judge the block when it is full. ``before`` is the speed before [m/s]."""
        state, known, dt, kind = self.state, self._known, sample.dt, self._kind(sample)
        if sample.speed < _MIN_SPEED:
            state.balance.decay(0.0)
        if sample.speed < STANDING:
            state.change.stand(weighed=is_finite(sample.mass))
            state.stopped = state.driven
        force, traction, specific_impulse = known.traction(sample.force, sample), math.nan, math.nan
        if is_finite(sample.gradient_mean) and is_finite(sample.force_mean):
            traction = known.traction(sample.force_mean, sample)
            resistance = davis(known.train_file.resistance, sample.speed)
            specific_impulse = known.inertia * (sample.speed - before) + dt * (known.track(sample) + resistance)
        std = known.inertia * math.sqrt(2.0) * state.noise.std + _IMPULSE_STD * 2.0 * dt
        self._check_command(sample, force)
        state.gradient_spikes.add(sample.gradient, dt)
        state.spikes.add(force, traction, specific_impulse if kind == RELEASED else math.nan, std, dt)
        if kind == NO_BLOCK or math.isnan(specific_impulse):
            self._interrupt()
            state.balance.decay(math.exp(-dt / _RESIDUAL_S))
            return
        block = state.block
        if block.kind != kind:
            block = state.block = Block(kind)
        block.add(dt, specific_impulse, traction, sample.brake_command)
        state.moved_s += dt
        if block.seconds >= _BLOCK_S:
            self._close(block, sample)
            self._check_gradient(sample)
            block.kind = NO_BLOCK

    def _check_command(self, sample: Sample, force: float) -> None:
        """Compare the brake command with the reported force [N/kN]."""
        state, known, is_moving = self.state, self._known, sample.speed >= _MIN_SPEED
        state.releases.add(sample.brake_command if is_moving else math.nan, force, self._followed_s, sample.dt)
        if is_moving and sample.brake_command < _BRAKING and not sample.emergency:
            most = min(state.strongest, state.strongest_before)
            state.effort.compare(force, known.inertia * most)

    def _check_standstill(self, speed: float) -> None:
        """Contradict a speed [m/s] that rises from a standstill while the brake holds the train."""
        state = self.state
        holds = state.commands.command < _HOLDING and state.held_s > self._followed_s
        state.slowest = min(state.slowest, speed) if holds else speed
        if state.slowest < STANDING and speed - state.slowest > _ROLLING + _SIGMAS * state.noise.std:
            state.balance.contradict()

    def _kind(self, sample: Sample) -> int:
        """Return whether only traction acts, or the brake has followed the command."""
        held_s = self.state.held_s
        if sample.speed < _MIN_SPEED or not is_finite(sample.brake_command) or sample.emergency:
            return NO_BLOCK
        if sample.brake_command < _BRAKING:
            return BRAKED if held_s > self._followed_s else NO_BLOCK
        return RELEASED if held_s > self._known.settling and sample.brake_command == 0.0 else NO_BLOCK

    def _close(self, block: Block, sample: Sample) -> None:
        """Take in a full block."""
        state, inertia, seconds = self.state, self._known.inertia, block.seconds
        y, traction = block.specific_impulse / seconds, block.traction / seconds
        noise = inertia * max(_SIGMAS * state.noise.std, state.noise.quantum) / seconds
        resistance = davis(self._known.train_file.resistance, sample.speed)
        if block.kind == RELEASED:
            limit = _SUDDEN + _SUDDEN_TRACTION * abs(traction)
            state.balance.add(y - traction, limit + noise / SUDDEN_MEMORY)
            state.recent.add(y, traction, RECENT)
            state.traction.take(y, traction, limit + noise)
            state.traction.judge_traction(noise, resistance, state.distance.ratio)
            state.confirmed = state.confirmed or state.traction.is_plausible
            self._close_released(y, traction, limit + noise, seconds, resistance)
            return
        nominal = inertia * block.command / seconds
        brake = self._known.train_file.brake.rate_at(sample.speed) * nominal
        limit = _SUDDEN + _SUDDEN_BRAKE * abs(brake)
        state.balance.add(y - brake, limit + noise / SUDDEN_MEMORY)
        state.recent.add(y, brake, RECENT)
        state.brake.take(y, brake, limit + noise)
        self._judge_brake(noise)
        # Electric brakes, whose force some trains report alone, fade out before the stop.
        if state.steady_s > self._followed_s + _BLOCK_S and sample.speed >= _BLENDED:
            state.effort.take(traction, nominal)
            state.effort.judge(state.brake)
        if traction > _DRIVING:
            state.balance.contradict()

    def _judge_brake(self, noise: float) -> None:
        """Judge the slope of the brake; a command that is stuck agrees by chance while a driver brakes as much."""
        state = self.state
        before = state.brake.finding
        state.brake.judge_brake(noise, state.distance.ratio)
        if not before:
            state.has_alternated = not state.brake.finding
        elif not state.has_alternated:
            state.brake.finding = state.brake.finding or before

    def _close_released(self, y: float, x: float, limit: float, seconds: float, resistance: float) -> None:
        """Take in acceleration y, traction x, the limit of the residual and w(v) [N/kN] of a block without brake."""
        state, residual = self.state, y - x
        change = state.change
        residual_left = min(max(y - change.gain * x, -limit), limit)
        named = not state.traction.is_open
        state.balance.add_released(residual_left, change.offset, resistance, self._map_std, named=named)
        # Slip of the wheels is no step of the traction.
        most = _SLIP * limit
        state.shift.add(x + min(max(residual, -most), most), x, seconds)
        off = abs(residual) > limit or state.finding != ''
        change.add(y, x, self._known.inertia, state.noise.std, seconds, off=off)

    def _check_gradient(self, sample: Sample) -> None:
        """Compare the gradient with that of the line, where both are known."""
        line, here, driven = self._line, sample.position, self.state.driven
        if line is None or not line.first <= here <= line.last or not is_finite(sample.gradient):
            return
        if self.state.gradient_spikes.peak > 0.0 or not self.state.distance.has_position:
            return
        if driven - self.state.stopped < _TURNED:
            return
        expected = least = most = line.gradient(here, sample.direction)
        if abs(sample.gradient - expected) > _SAME_GRADIENT:
            off = _POSITION_ERROR + _POSITION_DRIFT * driven
            for share in _SHARES:
                if least <= sample.gradient <= most:
                    break
                nearby = line.gradient(here + share * off, sample.direction)
                least, most = min(least, nearby), max(most, nearby)
        self.state.line.add(sample.gradient, expected, least, most, self._map_std)
