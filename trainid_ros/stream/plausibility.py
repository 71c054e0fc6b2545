# SPDX-License-Identifier: Apache-2.0
"""Check the inputs against each other before anything is learned from them: units, signs, stuck or late inputs.

With specific forces [N/kN] and y = 1000 (1 + gamma) (dv/dt) / g + i + w(v), where w(v) is that of the train file,

- y = x = traction where no brake acts,
- y = x = 1000 (1 + gamma) r c / g where the brake has followed the target acceleration c for some time; r is the brake
  rate of the train file.

Both are regressions through the origin, y = R x, over the last seconds of each kind. R is about 1: mass, brake rate and
resistance differ from those of the train file by some ten per cent, wrong units by factors. Further checks compare
distances, the gradient with the line, and the times of steps. What is found lasts until it is certainly mended; the
stream rejects all samples meanwhile. A sample whose last two seconds contradict the balance by more than any resistance
is rejected at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.results import Reason, Rejection
from trainid_ros.scalars import is_finite
from trainid_ros.state import decode, encode
from trainid_ros.stream.input_checks import BRAKING, DistanceCheck, LineCheck, MessageCheck, ShiftCheck
from trainid_ros.stream.samples import Sample
from trainid_ros.stream.slope import Slope
from trainid_ros.train.davis import davis
from trainid_ros.train.line import LineProfile

# Inputs are averaged over blocks, so that the noise of the speed matters little [s]; memory of the residual [blocks].
_BLOCK_S: Final = 0.5
_RECENT: Final = 4.0
# Slower trains may stand or shunt [m/s].
_MIN_SPEED: Final = 1.0
# Residual that no resistance explains [N/kN], and shares of traction and brake added to it [1].
_SUDDEN: Final = 12.0
_SUDDEN_TRACTION: Final = 0.4
_SUDDEN_BRAKE: Final = 0.8
# Mean residual over a longer time that no resistance explains [N/kN], share of traction added, memory [blocks].
_BALANCE: Final = 10.0
_BALANCE_SHARE: Final = 0.3
_BALANCE_MEMORY: Final = 60.0
# Traction that contradicts a brake which has followed its command [N/kN].
_DRIVING: Final = 10.0
# Noise of the speed at the start [m/s], and its multiple that is hardly ever exceeded [1].
_SPEED_STD: Final = 0.025
_SIGMAS: Final = 4.0
# A brake has followed a command after its dead time and this many time constants.
_FOLLOWED: Final = 2.0
# Motion under a finding after which all checks begin anew, so that none lasts when its inputs have gone [s].
_RETRY_S: Final = 300.0
# Decay of the residual while nothing can be compared [s].
_RESIDUAL_S: Final = 5.0
# Motion after which an estimate may be valid although the slope of traction is still not known [s]: without strong
# acceleration (in root mean square, N/kN), and in any case.
_CALM_S: Final = 20.0
_CALM: Final = 15.0
_LENIENT_S: Final = 90.0


@dataclass(slots=True)
class Block:
    """Sums over the samples of a block, all of which have the brake off, or applied.

    Attributes:
        kind: 1 with the brake off, 2 with the brake applied, 0 for no block.
        first: Speed before its first sample [m/s].
        last: Speed at its last one [m/s].
        seconds: Its length [s].
        track: Integral of gradient and w(v) [N/kN s].
        traction: Integral of traction [N/kN s].
        command: Integral of the brake command [m/s].

    """

    kind: int = 0
    first: float = 0.0
    last: float = 0.0
    seconds: float = 0.0
    track: float = 0.0
    traction: float = 0.0
    command: float = 0.0


@dataclass(slots=True)
class PlausibilityState:
    """State of the monitor.

    Attributes:
        messages: Check of single messages.
        distance: Check of speed against position.
        line: Check of the gradient.
        shift: Check of the times of steps.
        traction: Slope of traction.
        brake: Slope of the brake.
        of_traction: What is wrong with traction, empty if nothing is.
        of_brake: What is wrong with the brake.
        of_balance: What is wrong with the balance of forces over a longer time.
        confirmed: True once the slope of traction was plausible.
        moved_s: Time in motion with known forces [s].
        found_s: Time in motion under findings since the checks began [s].
        retried: True if the checks have begun anew under a finding: they must then hold for some time.
        residual: Mean of the last residuals y - x [N/kN].
        limit: Mean of their limits [N/kN].
        balance: Mean residual where no brake acts, over a longer time [N/kN].
        level: Mean of |traction| over the same time [N/kN].
        noise: Noise of the speed.
        block: The block that is being filled.
        speed: Last speed [m/s], NaN before the first.
        position: Last position [m].

    """

    messages: MessageCheck = field(default_factory=MessageCheck)
    distance: DistanceCheck = field(default_factory=DistanceCheck)
    line: LineCheck = field(default_factory=LineCheck)
    shift: ShiftCheck = field(default_factory=ShiftCheck)
    traction: Slope = field(default_factory=Slope)
    brake: Slope = field(default_factory=Slope)
    of_traction: str = ''
    of_brake: str = ''
    of_balance: str = ''
    confirmed: bool = False
    moved_s: float = 0.0
    found_s: float = 0.0
    retried: bool = False
    residual: float = 0.0
    limit: float = _SUDDEN
    balance: float = 0.0
    level: float = 0.0
    noise: SpeedNoise = field(default_factory=lambda: SpeedNoise.declared(_SPEED_STD, robust=True))
    block: Block = field(default_factory=Block)
    speed: float = math.nan
    position: float = math.nan

    @property
    def finding(self) -> str:
        """What contradicts what, empty if nothing does."""
        of_forces = self.of_traction or self.of_brake
        return (
            self.messages.finding
            or of_forces
            or self.distance.finding
            or self.shift.finding
            or self.line.finding
            or self.of_balance
        )


class PlausibilityMonitor:
    """Check the inputs sample by sample."""

    def __init__(self, known: KnownForce) -> None:
        train_file = known.train_file
        brake, line = train_file.brake, train_file.line
        self._known = known
        self._followed_s = brake.delay + _FOLLOWED * brake.time_constant
        self._line = LineProfile(line, train_file.train.length) if line.gradient else None
        self._line_std = line.gradient_std
        self._last = ''
        self.state = PlausibilityState()

    def restore(self, state: PlausibilityState) -> None:
        """Continue from a copy of a saved, valid state."""
        self.state = decode(encode(state), PlausibilityState)

    @property
    def finding(self) -> str:
        """What contradicts what, empty if nothing does."""
        return self.state.finding

    @property
    def last_finding(self) -> str:
        """The last finding, empty if there never was one."""
        return self.state.finding or self._last

    @property
    def is_trusted(self) -> bool:
        """True if an estimate from these inputs may be valid: they agree, or cannot be compared."""
        state, slope = self.state, self.state.traction
        if state.finding or (state.retried and state.moved_s < _RETRY_S):
            return False
        calm = state.moved_s > _CALM_S and slope.yy < _CALM * _CALM * slope.count
        return state.confirmed or calm or state.moved_s > _LENIENT_S

    def follow(self, sample: Sample) -> Rejection | None:
        """Take in a sample; return why it must not be used, None if nothing contradicts it."""
        state = self.state
        before, position = state.speed, state.position
        state.speed, state.position = sample.speed, sample.position
        state.noise.add(sample.speed, sample.dt)
        self._check_messages(sample)
        if is_finite(sample.dt) and is_finite(before):
            if sample.speed >= _MIN_SPEED:
                by_speed = 0.5 * (before + sample.speed) * sample.dt
                state.distance.add(by_speed, sample.direction * (sample.position - position))
            self._check_forces(sample, before)
        else:
            self._interrupt()
        if finding := state.finding:
            self._last = finding
            self._retry(sample)
            return Rejection(sample.stamp_ns, Reason.CONTRADICTION, math.nan, math.nan)
        if abs(state.residual) > state.limit:
            return Rejection(sample.stamp_ns, Reason.CONTRADICTION, state.residual, state.limit)
        return None

    def _retry(self, sample: Sample) -> None:
        """Begin all checks anew after some motion; no estimate is trusted until they have succeeded."""
        state = self.state
        if sample.speed >= _MIN_SPEED and sample.dt > 0.0:
            state.found_s += sample.dt
        if state.found_s > _RETRY_S:
            noise, messages = state.noise, state.messages
            self.state = PlausibilityState(noise=noise, speed=state.speed, position=state.position, retried=True)
            self.state.messages.command, self.state.messages.held_s = messages.command, messages.held_s

    def _interrupt(self) -> None:
        self.state.block.kind = 0
        self.state.shift.interrupt()

    def _check_messages(self, sample: Sample) -> None:
        messages = self.state.messages
        if sample.speed < _MIN_SPEED:  # the command may do anything while the train is held
            messages.reversals = 0.0
        for change in sample.brake_changes:
            messages.add_command(change.target_acceleration)
        if is_finite(sample.dt):
            messages.add_force(self._known.traction(sample.force, sample), sample.dt)

    def _check_forces(self, sample: Sample, speed: float) -> None:
        """Add a sample to its block; judge the block when it is full."""
        known, kind = self._known, self._kind(sample)
        if sample.speed < _MIN_SPEED:
            self.state.residual = 0.0
        if not kind or not is_finite(sample.gradient_mean) or not is_finite(sample.force_mean):
            self._interrupt()
            self.state.residual *= math.exp(-sample.dt / _RESIDUAL_S)
            return
        block = self.state.block
        if block.kind != kind:
            block = self.state.block = Block(kind, speed)
        resistance = davis(known.train_file.resistance, sample.speed)
        block.seconds += sample.dt
        block.track += sample.dt * (sample.gradient_mean + resistance)
        block.traction += sample.dt * known.traction(sample.force_mean, sample)
        block.command += sample.dt * sample.brake_command
        block.last = sample.speed
        self.state.moved_s += sample.dt
        if block.seconds >= _BLOCK_S:
            self._close(block)
            self._check_gradient(sample)
            block.kind = 0

    def _kind(self, sample: Sample) -> int:
        """Return 1 where only traction acts, 2 where the brake has followed the command, 0 elsewhere."""
        held_s = self.state.messages.held_s
        if sample.speed < _MIN_SPEED or not is_finite(sample.brake_command) or sample.emergency:
            return 0
        if sample.brake_command < BRAKING:
            return 2 if held_s > self._followed_s else 0
        return 1 if held_s > self._known.settling and sample.brake_command == 0.0 else 0

    def _close(self, block: Block) -> None:
        """Take in a full block."""
        state, inertia, seconds = self.state, self._known.inertia, block.seconds
        y = (inertia * (block.last - block.first) + block.track) / seconds
        traction = block.traction / seconds
        noise = inertia * max(_SIGMAS * state.noise.std, state.noise.quantum) / seconds
        if block.kind == 1:
            self._see_residual(y - traction, _SUDDEN + _SUDDEN_TRACTION * abs(traction) + noise / _RECENT)
            state.traction.add(y, traction)
            state.of_traction = state.traction.traction_finding(state.of_traction, noise)
            state.confirmed = state.confirmed or (state.traction.is_known and not state.of_traction)
            self._see_balance(y, traction)
            state.shift.add(y, traction, seconds)
            return
        brake = inertia * self._known.train_file.brake.rate_at(block.last) * block.command / seconds
        self._see_residual(y - brake, _SUDDEN + _SUDDEN_BRAKE * abs(brake) + noise / _RECENT)
        state.brake.add(y, brake)
        state.of_brake = state.brake.brake_finding(state.of_brake, noise)
        if traction > _DRIVING:
            state.residual = 2.0 * state.limit

    def _see_residual(self, residual: float, limit: float) -> None:
        """Follow the residual y - x of a block [N/kN] and the largest one that a resistance explains."""
        state = self.state
        state.residual += (residual - state.residual) / _RECENT
        state.limit += (limit - state.limit) / _RECENT

    def _see_balance(self, y: float, traction: float) -> None:
        """Follow the mean residual over a longer time, in N/kN."""
        state = self.state
        state.balance += (y - traction - state.balance) / _BALANCE_MEMORY
        state.level += (abs(traction) - state.level) / _BALANCE_MEMORY
        if abs(state.balance) > _BALANCE + _BALANCE_SHARE * state.level:
            state.of_balance = f'forces do not balance by {-state.balance:+.0f} N/kN: ato/force or ato/gradient is off'
        elif abs(state.balance) < 0.5 * _BALANCE:
            state.of_balance = ''

    def _check_gradient(self, sample: Sample) -> None:
        """Compare the gradient with that of the line, where both are known."""
        if self._line is None or not is_finite(sample.position) or not is_finite(sample.gradient):
            return
        expected = self._line.gradient(sample.position, sample.direction)
        if not self.state.line.add(sample.gradient, expected, self._line_std):
            self.state.residual = 2.0 * self.state.limit
