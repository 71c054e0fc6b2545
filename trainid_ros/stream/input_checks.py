# SPDX-License-Identifier: Apache-2.0
"""Checks of single inputs and pairs of them; each has a state to be saved and says in ``finding`` what is wrong.

A finding lasts until the same check is certain that nothing is wrong any more. All forces are specific [N/kN].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

# A command below this brakes [m/s^2]; larger changes to and fro alternate: up to this many may, with this memory.
BRAKING: Final = -0.02
_REVERSAL: Final = 0.15
_REVERSALS: Final = 8.0
_REVERSAL_MEMORY_S: Final = 5.0
# A single report of the force stands out by this [N/kN]; up to this many of them, with this memory.
_SPIKE: Final = 15.0
_SPIKES: Final = 2.5
_SPIKE_MEMORY_S: Final = 30.0
# The neighbours of a spike agree to this share of its height [1].
_SPIKE_BASE: Final = 0.3
# Below this number of both, with forgetting, nothing is wrong any more.
_QUIET: Final = 1.0


@dataclass(slots=True)
class MessageCheck:
    """Messages that cannot come from one healthy source: an alternating brake command, spikes of the force.

    Attributes:
        finding: What is wrong, empty if nothing is.
        command: Last brake command [m/s^2, <= 0].
        direction: Sign of its last large change.
        held_s: Time since the brake was applied, or released [s].
        reversals: Number of changes to and fro, with forgetting.
        last: Last specific force [N/kN].
        before: The one before.
        spikes: Number of spikes, with forgetting.

    """

    finding: str = ''
    command: float = 0.0
    direction: float = 0.0
    held_s: float = 0.0
    reversals: float = 0.0
    last: float = 0.0
    before: float = 0.0
    spikes: float = 0.0

    def add_command(self, target: float) -> None:
        """Add a change of the brake command [m/s^2]."""
        step = target - self.command
        if (target < BRAKING) != (self.command < BRAKING):
            self.held_s = 0.0
        if abs(step) > _REVERSAL:
            sign = math.copysign(1.0, step)
            self.reversals += 1.0 if sign * self.direction < 0.0 else 0.0
            self.direction = sign
        self.command = target

    def add_force(self, force: float, dt: float) -> None:
        """Add a specific force [N/kN], NaN if it is missing, and the time since the last one [s]."""
        force = self.last if math.isnan(force) else force
        self.held_s += dt
        self.reversals *= math.exp(-dt / _REVERSAL_MEMORY_S)
        self.spikes *= math.exp(-dt / _SPIKE_MEMORY_S)
        rise, fall = self.last - self.before, self.last - force
        if min(abs(rise), abs(fall)) > _SPIKE and abs(force - self.before) < _SPIKE_BASE * abs(fall):
            self.spikes += 1.0
        self.before, self.last = self.last, force
        if self.reversals > _REVERSALS:
            self.finding = 'ato/brake_command alternates between values: two publishers?'
        elif self.spikes > _SPIKES:
            self.finding = 'ato/force has spikes'
        elif self.reversals + self.spikes < _QUIET:
            self.finding = ''


# Distances are compared with this memory, from this distance on [m], and may differ by this share [1]: wheels wear by
# less than 2 %, balises correct the position by some metres.
_DISTANCE_MEMORY: Final = 700.0
_MIN_DISTANCE: Final = 450.0
_DISTANCE_ERROR: Final = 0.035
# A change of the position above three times the distance and this is a correction [m].
_JUMP: Final = 20.0


@dataclass(slots=True)
class DistanceCheck:
    """Distance by the speed against distance by the position.

    Attributes:
        finding: What is wrong, empty if nothing is.
        by_speed: Distance by the speed, with forgetting [m].
        by_position: Distance by the position, with forgetting [m].
        waiting: Distance by the speed since the position last changed [m].

    """

    finding: str = ''
    by_speed: float = 0.0
    by_position: float = 0.0
    waiting: float = 0.0

    def add(self, by_speed: float, by_position: float) -> None:
        """Add the distances between two samples [m]; that by the position is NaN if it is not known."""
        by_speed += self.waiting
        if by_position == 0.0:  # a position that is updated less often than the speed
            self.waiting = min(by_speed, _DISTANCE_MEMORY)
            return
        self.waiting = 0.0
        if not abs(by_position) <= 3.0 * by_speed + _JUMP:
            return
        keep = math.exp(-by_speed / _DISTANCE_MEMORY)
        self.by_speed = keep * self.by_speed + by_speed
        self.by_position = keep * self.by_position + by_position
        if self.by_speed > _MIN_DISTANCE and self.by_position > 0.0:
            ratio = self.by_speed / self.by_position
            self.finding = _distance_text(ratio) if abs(ratio - 1.0) > _DISTANCE_ERROR else ''


def is_near(ratio: float, factor: float) -> bool:
    """Return whether a ratio may be this factor, as far as mass, brake and resistance are known."""
    return 0.7 * factor < ratio < factor / 0.7


def _distance_text(ratio: float) -> str:
    if is_near(ratio, 3.6):
        return f'ato/speed looks like km/h: {ratio:.2f} times what its position gives'
    return f'ato/speed is about {100.0 * (ratio - 1.0):+.0f} % off what its position gives'


# Error of the gradient that the topic may have against the line [per mille], and multiple of its stated std added.
_LINE_ERROR: Final = 1.0
_LINE_STDS: Final = 6.0
# Memories [blocks]; number of blocks before anything is found.
_LINE_MEMORY: Final = 300.0
_LINE_SHORT: Final = 5.0
_LINE_BLOCKS: Final = 60.0
# Share of the mean square of the line's gradient that the error may have [1]: it is 1 if they are unrelated.
_LINE_SHARE: Final = 0.6
# A sudden error exceeds this multiple of the usual ones.
_LINE_SIGMAS: Final = 5.0


@dataclass(slots=True)
class LineCheck:
    """Gradient of the topic against the line of the train file [per mille].

    Attributes:
        finding: What is wrong, empty if nothing is.
        count: Number of gradients compared, with forgetting.
        offset: Mean error.
        square: Mean square error.
        steepness: Mean square of the gradient of the line.
        lately: Mean error over a short time.

    """

    finding: str = ''
    count: float = 0.0
    offset: float = 0.0
    square: float = 0.0
    steepness: float = 0.0
    lately: float = 0.0

    def add(self, gradient: float, expected: float, std: float) -> bool:
        """Add a gradient and that of the line, with its stated std [per mille]; return False if it is suddenly off."""
        error, limit = gradient - expected, _LINE_ERROR + _LINE_STDS * std
        self.lately += (error - self.lately) / _LINE_SHORT
        sudden = abs(self.lately) > limit + _LINE_SIGMAS * math.sqrt(self.square) and self.count >= _LINE_BLOCKS
        self.count += 1.0 - self.count / _LINE_MEMORY
        share = 1.0 / self.count
        self.offset += share * (error - self.offset)
        self.square += share * (error * error - self.square)
        self.steepness += share * (expected * expected - self.steepness)
        if self.count < _LINE_BLOCKS:
            return not sudden
        if abs(self.offset) > limit:
            self.finding = f'ato/gradient is about {self.offset:+.1f} per mille off the line of the train file'
        elif self.square > _LINE_SHARE * self.steepness + limit * limit:
            self.finding = 'ato/gradient does not follow the line of the train file'
        else:
            self.finding = ''
        return not sudden


# Shifts are tried up to this many blocks; smallest step of x, and sum of squared steps, that show one [N/kN].
_MAX_SHIFT: Final = 6
_SHIFTS: Final = 2 * _MAX_SHIFT + 1
_EDGE: Final = 6.0
_EDGES: Final = 2000.0
_SHIFT_KEPT: Final = 0.998
# Standard deviations by which a shift must stand out from chance, and from no shift.
_SHIFT_KNOWN: Final = 5.0
_SHIFT_BETTER: Final = 3.0


@dataclass(slots=True)
class ShiftCheck:
    """Steps of the acceleration against earlier and later steps of the traction: which of them is late.

    Attributes:
        finding: What is wrong, empty if nothing is.
        edges: Sum of squared steps of the traction [(N/kN)^2].
        jerks: Sum of squared steps of the acceleration, as a specific force [(N/kN)^2].
        count: Number of steps, with forgetting.
        products: Sums of products of both, the acceleration -6 to 6 blocks later [(N/kN)^2].
        recent: Acceleration and traction of the last blocks, in turn, oldest first [N/kN].

    """

    finding: str = ''
    edges: float = 0.0
    jerks: float = 0.0
    count: float = 0.0
    products: tuple[float, ...] = (0.0,) * _SHIFTS
    recent: tuple[float, ...] = ()

    @property
    def is_valid(self) -> bool:
        """True if products and blocks have possible numbers."""
        return len(self.products) == _SHIFTS and len(self.recent) % 2 == 0 and len(self.recent) <= 2 * (_MAX_SHIFT + 2)

    def interrupt(self) -> None:
        """Start a new run of blocks."""
        self.recent = ()

    def add(self, y: float, x: float, block_s: float) -> None:
        """Add the next block: acceleration y and traction x [N/kN], and its length [s]."""
        run = (*self.recent, y, x)[-2 * (_MAX_SHIFT + 2) :]
        self.recent = run
        if len(run) < 2 * (_MAX_SHIFT + 2):
            return
        dy, dx = run[-2] - run[-4], run[-1] - run[-3]
        edge = abs(dx) > _EDGE
        products = [_SHIFT_KEPT * product for product in self.products]
        for k in range(_MAX_SHIFT + 1):
            end = len(run) - 2 * k
            earlier_dy, earlier_dx = run[end - 2] - run[end - 4], run[end - 1] - run[end - 3]
            if abs(earlier_dx) > _EDGE:
                products[_MAX_SHIFT + k] += dy * earlier_dx
            if k and edge:
                products[_MAX_SHIFT - k] += earlier_dy * dx
        self.products = tuple(products)
        self.edges = _SHIFT_KEPT * self.edges + (dx * dx if edge else 0.0)
        self.jerks = _SHIFT_KEPT * self.jerks + dy * dy
        self.count = _SHIFT_KEPT * self.count + 1.0
        if self.edges >= _EDGES:
            self._judge(block_s)

    def _judge(self, block_s: float) -> None:
        chance = math.sqrt(self.jerks / self.count * self.edges)
        best = 0
        for k in range(_SHIFTS):
            if self.products[k] > self.products[best]:
                best = k
        if self.products[best] < max(_SHIFT_KNOWN * chance, 0.5 * self.edges):
            return
        if self.products[best] - self.products[_MAX_SHIFT] < _SHIFT_BETTER * chance:
            self.finding = ''
            return
        later, sooner = ('ato/speed', 'ato/force') if best > _MAX_SHIFT else ('ato/force', 'ato/speed')
        self.finding = f'{later} is about {abs(best - _MAX_SHIFT) * block_s:.1f} s late, or {sooner} early'
