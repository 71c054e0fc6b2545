# SPDX-License-Identifier: Apache-2.0
"""Samples as blocks of half a second, and how noisy their inputs are.

A block has the means of forces and gradients, the steps at its ends, and both distances. The last eight are kept, so
that inputs that come too late or too early can be read from other blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, several, stored, unknown
from trainid_ros.interface.vectors import vec
from trainid_ros.stream.fault_table import WHEEL
from trainid_ros.stream.known_force import CAPPED_MEAN, KnownForce, SpeedNoise
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import STANDING, BrakeActuator
from trainid_ros.train.line import profile_of

_BLOCK_S: Final = 0.5  # s: a few samples, shorter than any lag of interest
_GAP_S: Final = 1.6  # s: samples further apart are no neighbours
MIN_SPEED: Final = 1.0  # m/s: slower trains stand, shunt, or stop with a jerk
KEPT: Final = 8  # blocks kept: the longest delay, and the one before
_DRIVEN: Final = 1.5  # m/s: a train whose position changes faster moves (sensors see none below 1 m/s), ...
_SURE: Final = 32.0  # times the variance of a position: ... if it has moved by four standard deviations of a difference
_ROUNDING: Final = 1e-9  # share of a constant force by which rounding changes its mean
_NEAR_ZERO: Final = 1e-4  # m/s^2: a brake is released

# Noise: assumed sizes of healthy trains where no source is named; benchmarks/healthy.py shows that they cover them.

_NOISE_SIGMAS: Final = 4.0  # standard deviations of a speed: the most that noise changes it
_SPEED_STD: Final = 0.02  # m/s: least noise of a speed ...
_FIRST_SQUARES: Final = 3.0  # ... which counts for so many samples: half of a noise of 0.1 m/s shows after 20 s
_POSITION_STD: Final = 0.5  # m: noise of a distance by position, before it is learned
_COARSEST_M: Final = 120.0  # m: positions that change in longer steps are corrected, as at balises
_GRADIENT_STD: Final = 0.3  # per mille: least error of the gradient of the topic against that of the line
ERROR_M: Final = 250.0  # m: distance over which errors of a map are alike: there is one in it
_GRADIENT_MEMORY_M: Final = 5000.0  # m: distance over which that error is learned: twenty such lengths
_PLACE_M: Final = 30.0  # m: error of the place on the line at first ...
_MIN_PLACE_M: Final = 5.0  # m: ... and at least, once learned from the gradient ...
_PLACE_WALK: Final = 0.025  # m: growth of its variance per distance: 5 m in 1 km, by balises and maps
_SCALE_STD: Final = 0.03  # error of the scale of the position at first [1]: worn wheels, or those of another train
_MAX_SCALE: Final = 0.12  # largest such error [1]: a worn wheel in place of a new one is 10 % off
_FITS: Final = 4.0  # variances within which a gradient is one of the line, and tells the place
_LEARNED: Final = 0.01  # weight of a new square in the learned noise of the position: 100 blocks ...
_FIRST: Final = 10.0  # blocks ... of which its first value counts for so many

MOVING: Final = 0
"""State of a block: the train moves, and all inputs are known."""
AT_STOP: Final = 1
"""It stands."""
UNKNOWN: Final = 2
"""Nothing can be compared."""


@dataclass(slots=True)
class Block:
    """The inputs over about half a second."""

    seconds: float = 0.0  # Its length [s]
    state: int = UNKNOWN  # What can be compared
    speed: float = 0.0  # Speed at its end [m/s]
    speed_step: float = 0.0  # Change of the speed over the block [m/s]
    variance: float = 0.0  # Variance of that speed [(m/s)^2]
    by_speed: float = 0.0  # Distance by speed [m]
    by_position: float = stored(0.0, may_be_nan=True)  # Distance by position [m], NaN if unknown
    force: float = 0.0  # Mean reported force F [N/kN]
    force_step: float = 0.0  # Its change over the block [N/kN]
    brake: float = 0.0  # Mean force B of a nominal brake [N/kN, <= 0]
    brake_step: float = 0.0  # Its change over the block [N/kN]
    rate: float = 1.0  # Brake rate of the train file [1]
    gradient: float = 0.0  # Mean gradient of the topic [per mille]
    line: float = math.nan  # Gradient of the line at its end [per mille], NaN if unknown
    steepness: float = 0.0  # Change of that gradient with the position [per mille/m]
    miss: float = math.nan  # Speed at its end less what the accepted row gives from its start [m/s]
    least: float = math.nan  # Least gradient of the line nearby [per mille]
    most: float = math.nan  # Greatest one
    extra: float = 0.0  # Resistance of the effects of the train file [N/kN]
    tunnel: bool = False  # Whether it ends in a tunnel
    is_at_portal: bool = False  # Whether the block before did not, or the other way round
    is_frozen: bool = False  # Whether the speed is exactly that of the block before

    @property
    def is_known(self) -> bool:
        """True if inputs can be compared."""
        return self.state != UNKNOWN


class InputBlocks:
    """Make blocks of samples.

    Attributes:
        count: Number of full blocks.
        noise: Noise of the speed.
        brake: Force of a nominal brake at the end of the last block [N/kN, <= 0].
        still: Time for which speed, position, force and command have not changed [s], shape (4,).
        is_weighed: Whether the load was weighed at the end of the last block.
        position_var: Variance of the distance by position over a block, as learned [m^2].
        gradient_var: Variance of the gradient of the topic about that of the line [per mille^2].
    """

    STATE: ClassVar[State] = declare(
        several('_blocks', Block), '_filling', 'count', '_actuator', 'noise', '_stamp_ns', '_direction',
        unknown('_speed'), unknown('_position'), unknown('_force'), 'brake', 'still', 'is_weighed', 'position_var',
        '_position_step', '_is_held', '_compared', '_off', '_place', 'scale', '_place_var',
        '_place_scale', 'scale_var', 'gradient_var',
    )  # fmt: skip

    def __init__(self, known: KnownForce) -> None:
        line = known.train_file.line
        self._known = known
        self._line = profile_of(known.train_file) if line.gradient else None
        self.gradient_var = (_GRADIENT_STD + line.gradient_std) * (_GRADIENT_STD + line.gradient_std)
        least = max(_GRADIENT_STD, line.gradient_std)
        self._least_gradient_var = least * least
        self._blocks = [Block() for _ in range(KEPT)]
        self._filling = Block()
        self.count = 0
        self._actuator = BrakeActuator(known.brake)
        self.noise = SpeedNoise.declared(_SPEED_STD, robust=True, squares=_FIRST_SQUARES)
        self._stamp_ns, self._direction = 0, 1
        self._speed = self._position = self._force = math.nan
        self.brake = 0.0
        self.still = vec[float]([0.0, 0.0, 0.0, 0.0])
        self.is_weighed = False
        self.position_var = _POSITION_STD * _POSITION_STD
        self._position_step, self._is_held = 0.0, False  # Step of the position [m]; whether it waits for the next one
        self._compared = 0  # Number of distances from which it was learned
        self._off = 0.0  # Distance by position less that by speed of the last block [m]
        self._place, self.scale = 0.0, 0.0  # Place on the line less the position [m], and its loss per distance [1]
        self._place_var, self._place_scale, self.scale_var = _PLACE_M * _PLACE_M, 0.0, _SCALE_STD * _SCALE_STD

    def take(self, sample: Sample) -> bool:
        """Take in a sample; return whether it completes a block."""
        # A standing train shows no noise.
        self.noise.add(sample.speed, sample.dt if sample.speed >= STANDING else math.nan)
        is_full = self._add(sample, self._follow_brake(sample))
        if is_full:
            self._close(sample)
        return is_full

    def _follow_brake(self, sample: Sample) -> float:
        """Return the impulse of a nominal brake since the last sample [N/kN s]."""
        actuator, start_ns = self._actuator, self._stamp_ns
        self._stamp_ns = sample.stamp_ns
        actuator.commands.follow(sample.brake_changes)
        self.still[3] = 0.0 if sample.brake_changes or not sample.dt > 0.0 else self.still[3] + sample.dt
        if not 0 < start_ns <= sample.stamp_ns:
            return 0.0
        changes = actuator.commands.changes
        is_released = not changes or (len(changes) == 1 and changes[0].target_acceleration == 0.0)
        if is_released and actuator.output > -_NEAR_ZERO:
            actuator.output = 0.0
            return 0.0
        return actuator.advance(start_ns, sample.stamp_ns) * self._known.inertia

    def _add(self, sample: Sample, impulse: float) -> bool:
        """Add a sample to the block that is being filled; return whether it is full."""
        block, dt, known = self._filling, sample.dt, self._known
        before, position, direction = self._speed, self._position, self._direction
        self._speed, self._position, self._direction = sample.speed, sample.position, sample.direction
        jump = abs(sample.position - position) - sample.speed * dt
        # As where a position is set right.
        if abs(jump) > _MIN_PLACE_M and jump * jump > _SURE * self.distance_var():
            self._place_var += min(jump * jump, _PLACE_M * _PLACE_M)
        is_known = 0.0 < dt < _GAP_S and sample.direction == direction and not (sample.emergency or sample.brake_gap)
        if not (is_known and is_finite(sample.force_mean) and is_finite(sample.gradient_mean)
                and is_finite(before) and is_finite(sample.brake_command)):  # fmt: skip
            return True
        block.seconds += dt
        block.by_speed += 0.5 * (before + sample.speed) * dt
        block.by_position += sample.direction * (sample.position - position)
        self._learn_step(abs(sample.position - position), sample.speed)
        block.force += known.traction(sample.force_mean, sample) * dt
        block.brake += impulse
        block.gradient += sample.gradient_mean * dt
        block.extra += (known.track(sample) - sample.gradient_mean) * dt
        return block.seconds >= _BLOCK_S

    def _learn_step(self, moved: float, speed: float) -> None:
        """Learn the step in which a position counts [m]: that after samples in which a moving train stood still."""
        if moved == 0.0:
            self._is_held = self._is_held or speed >= MIN_SPEED
            return
        if self._is_held and moved < _COARSEST_M:
            self._position_step = max(self._position_step, moved)
        elif moved < 0.9 * self._position_step:
            self._position_step = 0.0
        self._is_held = False

    def _close(self, sample: Sample) -> None:
        """Complete the block; its place is taken by the oldest one."""
        block, known = self._filling, self._known
        force, brake = known.traction(sample.force, sample), known.inertia * self._actuator.output
        last = self.block(0)
        if block.seconds > 0.0:
            seconds = block.seconds
            block.force, block.brake = block.force / seconds, block.brake / seconds
            block.gradient, block.extra = block.gradient / seconds, block.extra / seconds
            block.force_step = force - self._force if is_finite(force - self._force) else 0.0
            block.brake_step = brake - self.brake
        quantum = self.noise.quantum
        block.speed, block.is_frozen = sample.speed, sample.speed == last.speed
        block.speed_step = sample.speed - last.speed
        # Blocks between two steps of a speed share the error of its rounding.
        share = sample.dt / block.seconds if block.seconds > 0.0 and sample.dt > 0.0 else 0.0
        rounding = self.noise.rounding * min(share, 1.0)
        block.variance = max(self.noise.learned, _SPEED_STD * _SPEED_STD) + max(rounding, quantum * quantum / 6.0)
        block.tunnel = sample.tunnel
        block.rate = 1.0
        if brake < 0.0 or block.brake < 0.0:
            block.rate = known.train_file.brake.rate_at(sample.speed) * known.brake_share(sample)
        self._look_up(block, sample)
        block.is_at_portal = block.tunnel != last.tunnel
        block.state = self._state(block, force)
        if block.seconds > 0.0:
            self._count_still(block, last, force)
        self._force, self.brake, self.is_weighed = force, brake, sample.weighed
        self.count += 1
        self._filling = self._blocks[self.count % KEPT]
        self._blocks[self.count % KEPT] = block
        block = self._filling
        block.seconds = block.by_speed = block.by_position = 0.0
        block.force = block.brake = block.gradient = block.extra = block.force_step = block.brake_step = 0.0
        block.miss = math.nan

    def _state(self, block: Block, force: float) -> int:
        """Return what can be compared in a full block."""
        if block.seconds < _BLOCK_S or not is_finite(force):
            return UNKNOWN
        if block.speed >= MIN_SPEED:
            return MOVING
        moved = sum(other.by_position for other in self._blocks)
        is_driven = abs(block.by_position) > _DRIVEN * block.seconds and moved * moved > _SURE * self.distance_var()
        return MOVING if is_driven else AT_STOP

    def _count_still(self, block: Block, last: Block, force: float) -> None:
        """Count for how long speed and position of a moving train, and any force, have not changed."""
        still, moved_s = self.still, block.seconds if block.state == MOVING else 0.0
        still[0] = still[0] + moved_s if self._speed == last.speed else 0.0
        still[1] = still[1] + moved_s if block.by_position == 0.0 else 0.0
        is_held = force == self._force and abs(block.force - force) <= _ROUNDING * abs(force)
        still[2] = still[2] + block.seconds if is_held else 0.0

    def _look_up(self, block: Block, sample: Sample) -> None:
        """Look up the line in the middle of the block, and on either side of it where that may be."""
        line, direction, std = self._line, sample.direction, math.sqrt(self._place_var)
        here = sample.position - 0.5 * direction * block.by_speed + self._place
        block.line = block.least = block.most = math.nan
        if line is None or not line.first <= here <= line.last or not block.by_speed > 0.0:
            return
        # From where the front enters to where half of the train has left.
        front = here + 0.5 * direction * line.length
        block.tunnel = block.tunnel or line.tunnel(here, direction) or line.tunnel(front, direction)
        block.line = line.gradient(here, direction)
        before, after = line.gradient(here - std, direction), line.gradient(here + std, direction)
        block.least, block.most = min(before, after, block.line), max(before, after, block.line)
        if not block.least <= block.gradient <= block.most:
            before2, after2 = line.gradient(here - 2.0 * std, direction), line.gradient(here + 2.0 * std, direction)
            block.least, block.most = min(before2, after2, block.least), max(before2, after2, block.most)
        block.steepness = 0.5 * (after - before) / std

    def block(self, back: int) -> Block:
        """Return one of the last eight blocks by how far it is back; 0 is the last one."""
        return self._blocks[(self.count - back) % KEPT]

    @property
    def most_noise(self) -> float:
        """The most by which noise and rounding change a speed [m/s]."""
        quantum = self.noise.quantum
        # Rounding, of speeds that change by half a quantum at each sample, is learned as this noise at most.
        white = self.noise.learned - quantum * quantum / (6.0 * CAPPED_MEAN)
        return quantum + _NOISE_SIGMAS * math.sqrt(max(white, _SPEED_STD * _SPEED_STD))

    def distance_var(self) -> float:
        """Return the variance of a distance by position without its drift: as learned, and of rounding at both ends."""
        return self.position_var + self._position_step * self._position_step / 6.0

    def learn_position(self, block: Block, by_position: float, by_speed: float) -> None:
        """Learn the noise of the distance by position over a block from both distances [m], corrected."""
        if block.state != MOVING or not is_finite(by_position):
            return
        # From one block to the next, where an error of the scale is the same.
        off = by_position - by_speed
        change, self._off = off - self._off, off
        square = min(0.5 * change * change, self.position_var) / CAPPED_MEAN
        self._compared += 1
        self.position_var += max(_LEARNED, 1.0 / (_FIRST + self._compared)) * (square - self.position_var)

    def learn_place(self, block: Block, *, is_line_right: bool) -> None:
        """Learn the place on a line with a known gradient, and the error of the topic where the line is right."""
        # A position whose scale is off leaves the line as the train moves: x = F x, P = F P F' + Q.
        d, std = self._direction * block.by_speed, _SCALE_STD
        share = block.seconds / WHEEL.time_s
        self._place -= d * self.scale
        self._place_var += d * (d * self.scale_var - 2.0 * self._place_scale) + _PLACE_WALK * block.by_speed
        self._place_scale -= d * self.scale_var
        self.scale -= share * self.scale
        self.scale_var += 2.0 * share * (std * std - self.scale_var)
        off = max(block.gradient - block.most, block.least - block.gradient, 0.0)
        square = off * off / self.gradient_var
        if square < _FITS:
            # One error of the gradient for each length in which errors of a map repeat themselves.
            H, P, C = block.steepness, self._place_var, self._place_scale
            R = self.gradient_var * max(ERROR_M / block.by_speed, 1.0)
            nu, S = block.gradient - block.line, H * H * P + R
            gain = H / S if nu * nu < _FITS * S else 0.0
            self._place += gain * P * nu
            self.scale = min(max(self.scale + gain * C * nu, -_MAX_SCALE), _MAX_SCALE)
            self._place_var = max((1.0 - gain * H * P) * P, _MIN_PLACE_M * _MIN_PLACE_M)
            self._place_scale -= gain * H * P * C
            self.scale_var -= gain * H * C * C
        if is_line_right:
            change = min(square, 1.0) / CAPPED_MEAN - 1.0
            share = min(block.by_speed / _GRADIENT_MEMORY_M, _LEARNED)
            self.gradient_var = max((1.0 + share * change) * self.gradient_var, self._least_gradient_var)
