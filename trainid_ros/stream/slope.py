# SPDX-License-Identifier: Apache-2.0
"""Slope of the acceleration over traction or brake, and what a wrong slope looks like."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

# Plausible slopes of traction and brake [1]: loads, brake rates and resistances differ by less.
TRACTION_RANGE = (0.55, 1.8)
BRAKE_RANGE = (0.35, 2.2)
# Errors of map and resistance that do not grow with x [N/kN]: for traction, and share of the resistance added [1], and
# for brakes, which may follow slowly.
_OFFSET: Final = 4.0
_OFFSET_SHARE: Final = 0.5
_BRAKE_OFFSET: Final = 8.0
# Share of them beyond which a slope is suspected [1].
_SUSPECTED: Final = 0.5
# Memory [blocks], and while a finding lasts: then what was wrong is soon forgotten when it is mended.
_MEMORY: Final = 20.0
_SHORT: Final = 8.0
# Blocks in a row that are off before they count: slip of the wheels at a departure is shorter.
_HELD: Final = 8
# A slope is known when its standard deviation is below this share of it, or of 1, after this many blocks.
_KNOWN: Final = 0.12
_MIN_BLOCKS: Final = 6.0
# Correlation below which y and x do not belong together [1], after this many blocks.
_UNRELATED: Final = 0.5
_UNRELATED_BLOCKS: Final = 12.0
# Ratios of effort and deceleration to the command: both are beyond this if the command is wrong, and agree within this
# with each other; it is right again within this [1].
_WRONG: Final = 1.35
_SAME: Final = 1.25
_RIGHT: Final = 1.2
# An effort is off by this share of the usual one [1], this many usual deviations, and this force [N/kN]. A deviation
# counts for at most so many usual ones; these are learned with this memory [blocks], from this on [1].
_OFF: Final = 0.3
_OFF_SIGMAS: Final = 4.0
_OFF_FORCE: Final = 6.0
_LEARNED_SIGMAS: Final = 3.0
_USUAL_MEMORY: Final = 100.0
_USUAL: Final = 0.05
# Blocks in a row that are off before the effort is suspected.
_OFF_BLOCKS: Final = 2
# Traction that shows a wrong slope soon, in root mean square [N/kN].
_STRONG: Final = 20.0
# Slope of a force that certainly acts against the command [1].
_OPPOSITE: Final = 0.4
_G: Final = 9.81
# Ratio within which a slope may be a factor, as far as mass, brake and resistance are known [1].
_NEAR: Final = 1.0 / 0.7
# Ratios by which a number in another unit is too large: speeds in km/h and miles per hour, newtons over pounds-force.
_KMH: Final = 3.6
_MPH: Final = 2.2369
_LBF: Final = 4.4482
# Slope of the brake below which the train does not brake [1].
_NO_BRAKING: Final = 0.2


@dataclass(slots=True)
class Regression:
    """Regression y = R x through the origin, with exponential forgetting.

    Attributes:
        finding: What is wrong, empty if nothing is.
        yy: Sum of y^2 [(N/kN)^2].
        xx: Sum of x^2 [(N/kN)^2].
        yx: Sum of y x [(N/kN)^2].
        count: Effective number of blocks.

    """

    finding: str = ''
    yy: float = 0.0
    xx: float = 0.0
    yx: float = 0.0
    count: float = 0.0

    def add(self, y: float, x: float, memory: float = _MEMORY) -> None:
        """Add the means of one block [N/kN]; so many count while nothing is wrong."""
        keep = 1.0 - 1.0 / (_SHORT if self.finding else memory)
        self.yy = keep * self.yy + y * y
        self.xx = keep * self.xx + x * x
        self.yx = keep * self.yx + y * x
        self.count = keep * self.count + 1.0

    @property
    def value(self) -> float:
        """The slope R [1]; 0 where x is always 0."""
        return self.yx / self.xx if self.xx > 0.0 else 0.0

    @property
    def is_known(self) -> bool:
        """True if there is enough evidence for the slope."""
        if self.count < _MIN_BLOCKS or self.xx <= 0.0:
            return False
        rest = max(self.yy - self.value * self.yx, 0.0) / self.count
        return math.sqrt(rest / self.xx) < _KNOWN * max(1.0, abs(self.value))


@dataclass(slots=True)
class Slope(Regression):
    """Slope of the acceleration over traction or brake.

    Attributes:
        off: Number of blocks in a row that are off.
        held: Their y and x in turn, while they do not count [N/kN].
        offset: Error of y that does not grow with x [N/kN].
        excess: By how much y is outside the limits of the slope, in root mean square [N/kN]; 0 while it is not known.

    """

    off: int = 0
    held: tuple[float, ...] = ()
    offset: float = _OFFSET
    excess: float = 0.0

    @property
    def is_valid(self) -> bool:
        """True if the blocks that are held are a possible number."""
        return len(self.held) == (2 * self.off if self.off < _HELD else 0) and self.off >= 0

    def take(self, y: float, x: float, limit: float) -> None:
        """Add the means of one block [N/kN], one with a residual above a limit only with others like it in a row."""
        if abs(y - x) <= limit:
            self.off, self.held = 0, ()
            self.add(y, x)
            return
        self.off = min(self.off + 1, _HELD)
        self.held = (*self.held, y, x)
        if self.off == _HELD:
            for k in range(0, len(self.held), 2):
                self.add(self.held[k], self.held[k + 1])
            self.held = ()

    def limit(self, limits: tuple[float, float]) -> float:
        """Return the limit on the side of the slope."""
        return limits[1] if self.value > 1.0 else limits[0]

    @property
    def is_plausible(self) -> bool:
        """True if the slope is known and within its limits."""
        return self.is_known and self.excess == 0.0

    @property
    def is_suspected(self) -> bool:
        """True while the slope is hardly to be explained."""
        return self.excess > _SUSPECTED * self.offset

    @property
    def is_open(self) -> bool:
        """True while it is too early to tell a wrong slope from an error that does not grow with x."""
        strong = self.xx > _STRONG * _STRONG * self.count
        return (
            self.count < _MIN_BLOCKS
            or self.off > 0
            or (strong and not TRACTION_RANGE[0] < self.value < TRACTION_RANGE[1])
        )

    def is_unrelated(self, noise: float) -> bool:
        """Return whether the speed certainly changes, or should, but not with x; ``noise`` is that of y [N/kN]."""
        least = 4.0 * _BRAKE_OFFSET * _BRAKE_OFFSET + noise * noise
        if self.count < _UNRELATED_BLOCKS or max(self.yy, self.xx) < self.count * least:
            return False
        return self.yx <= _UNRELATED * math.sqrt(self.yy * self.xx)

    def judge_traction(self, noise: float, resistance: float, by_position: float) -> None:
        """Judge the slope of traction.

        Args:
            noise: Noise of y [N/kN].
            resistance: The present w(v) [N/kN].
            by_position: Distance by the speed over that by the position [1], NaN if it is not known.

        """
        if self._is_judged(TRACTION_RANGE, _OFFSET + _OFFSET_SHARE * resistance):
            if self.excess > self.offset:
                self.finding = _traction_text(self.value, by_position)
            elif self.excess == 0.0:  # less traction refutes nothing
                self.finding = ''
        elif self.is_unrelated(noise):
            self.finding = 'the speed does not follow ato/force: one of them is stuck, late or of another train'

    def judge_brake(self, noise: float, by_position: float) -> None:
        """Judge the slope of the brake; the arguments are those for traction."""
        if self._is_judged(BRAKE_RANGE, _BRAKE_OFFSET):
            if self.excess > self.offset:
                self.finding = _brake_text(self.value, by_position)
            elif self.excess == 0.0:
                self.finding = ''
        elif self.is_unrelated(noise):
            self.finding = 'the speed does not follow ato/brake_command: one of them is stuck or of another train'

    def _is_judged(self, limits: tuple[float, float], offset: float) -> bool:
        """Compare the slope with its limits, beyond an offset of y [N/kN]; return whether it is known."""
        self.offset, self.excess = offset, 0.0
        if not self.is_known:
            return False
        outside = max(limits[0] - self.value, self.value - limits[1], 0.0)
        self.excess = outside * math.sqrt(self.xx / self.count)
        return True


@dataclass(slots=True)
class Effort(Regression):
    """Slope of the reported force over the brake command, while the brake is applied: 1 whatever the brake rate is.

    Attributes:
        usual: The slope as it has been for long [1].
        square: Mean square of the deviations of single blocks from it, as shares of it [1].
        off: Number of blocks in a row that are off.
        has_stayed: True if the last suspicion ended because such deviations have become usual.

    """

    usual: float = 1.0
    square: float = _USUAL * _USUAL
    off: int = 0
    has_stayed: bool = False

    @property
    def is_suspected(self) -> bool:
        """True while the force is suddenly another one for the same command."""
        return self.off >= _OFF_BLOCKS

    def take(self, y: float, x: float) -> None:
        """Add force and command of one block, both as forces [N/kN]."""
        self.add(y, x)
        expected = self.usual * x
        size, deviation = max(abs(expected), _OFF_FORCE), abs(y - expected)
        limit = self._limit(size)
        share = min(deviation / size, _LEARNED_SIGMAS * math.sqrt(self.square))
        self.square += (max(share * share, _USUAL * _USUAL) - self.square) / _USUAL_MEMORY
        if deviation > limit:
            self.off, self.has_stayed = self.off + 1, False
            return
        if self.is_suspected:
            self.has_stayed = deviation > max(_OFF * size, _OFF_FORCE)
        self.off = 0
        self.usual += (self.value - self.usual) / _MEMORY

    def compare(self, y: float, x: float) -> None:
        """Suspect a force [N/kN] beyond that of the strongest command that may still act, as a force."""
        expected = self.usual * x
        if self.off < _OFF_BLOCKS and y < expected - self._limit(max(abs(expected), _OFF_FORCE)):
            self.off, self.has_stayed = self.off + 1, False

    def take_impulses(self, by_force: float, by_speed: float) -> None:
        """Suspect a command that is off over a whole braking, by force and speed alike.

        Args:
            by_force: Impulse of the reported force over that of the nominal brake [1].
            by_speed: That of the force which the speed shows [1].

        """
        if _is_off(by_force, by_speed):
            self.off, self.has_stayed = max(self.off, _OFF_BLOCKS), False
        elif _agree(by_force, 1.0, _RIGHT):
            self.off = 0

    def _limit(self, size: float) -> float:
        """Return the largest deviation from an expected force of this size [N/kN]."""
        return max(max(_OFF, _OFF_SIGMAS * math.sqrt(self.square)) * size, _OFF_FORCE)

    def judge(self, brake: Slope) -> None:
        """Judge the slope together with that of the acceleration over the command."""
        if self.is_known and self.value < -_OPPOSITE:
            self.finding = 'ato/force drives while ato/brake_command brakes: its sign is missing or wrong'
            return
        if not (self.is_known and brake.is_known):
            return
        by_force, by_speed = self.value, brake.value
        if _is_off(by_force, by_speed):
            unit = 'looks like g' if is_near(by_force, _G) else 'is off'
            self.finding = f'ato/brake_command {unit}: speed and ato/force brake {by_force:.2g} times as much'
        elif not _agree(by_force, by_speed, _SAME) or _agree(by_force, 1.0, _RIGHT):
            self.finding = ''


def _is_off(by_force: float, by_speed: float) -> bool:
    """Return whether two ratios to the command agree with each other, but not with it."""
    is_right = _agree(by_force, 1.0, _WRONG) or _agree(by_speed, 1.0, _WRONG)
    return _agree(by_force, by_speed, _SAME) and not is_right


def _agree(ratio: float, other: float, factor: float) -> bool:
    """Return whether two ratios differ by less than a factor."""
    return other < factor * ratio and ratio < factor * other


def is_near(ratio: float, factor: float, within: float = _NEAR) -> bool:
    """Return whether a ratio may be this factor, as far as mass, brake and resistance are known."""
    return factor < ratio * within and ratio < factor * within


def speed_unit(ratio: float, within: float = _NEAR) -> str:
    """Return the unit of a speed that is too large by this ratio, within another one; empty if it is none."""
    if not (is_near(ratio, _MPH, within) or is_near(ratio, _KMH, within)):
        return ''
    return 'km/h' if ratio * ratio > _KMH * _MPH else 'mph'


def _speed_text(slope: float, by_position: float) -> str:
    """Return the unit that the speed looks like by the acceleration and by its position, empty if by none."""
    if math.isnan(by_position):  # a load may be twice what is known, but not more
        return 'km/h' if speed_unit(slope) == 'km/h' else ''
    is_speed = by_position > 0.0 and abs(math.log(by_position / slope)) < abs(math.log(by_position))
    return speed_unit(by_position) if is_speed else ''


def _traction_text(slope: float, by_position: float) -> str:
    if slope < 0.0:
        return 'ato/force looks as if it had the wrong sign'
    if is_near(slope, 1e3):
        return 'ato/force looks like kN: it is about 1000 times too small for the acceleration'
    if is_near(slope, 1e-3):
        return 'ato/force is about 1000 times too large for the acceleration'
    if unit := _speed_text(slope, by_position):
        unit += ', or ato/force like lbf' if math.isnan(by_position) and is_near(slope, _LBF) else ''
        return f'ato/speed looks like {unit}: the acceleration is {slope:.2g} times what ato/force gives'
    if is_near(slope, _LBF):
        return f'ato/force looks like lbf: it is {slope:.2g} times too small for the acceleration'
    return f'the acceleration is {slope:.2g} times what ato/force and mass give'


def _brake_text(slope: float, by_position: float) -> str:
    if slope < _NO_BRAKING:
        return 'the train does not brake while ato/brake_command brakes'
    if is_near(slope, _G):
        return f'ato/brake_command looks like g: the train brakes {slope:.2g} times as much'
    if unit := _speed_text(slope, by_position):
        return f'ato/speed looks like {unit}: the train brakes {slope:.2g} times as much as ato/brake_command'
    return f'the train brakes {slope:.2g} times as much as ato/brake_command'
