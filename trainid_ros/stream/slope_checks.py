# SPDX-License-Identifier: Apache-2.0
"""Slope of the acceleration over traction or brake, and distance by the speed over distance by the position.

A wrong slope tells what an input looks like; distances are compared segment by segment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.train.forces import G

# Plausible slopes of traction and brake [1]: loads, brake rates and resistances differ by less.
TRACTION_RANGE = (0.55, 1.8)
BRAKE_RANGE = (0.35, 2.2)
# Error of map and resistance that does not grow with the traction [N/kN].
_OFFSET: Final = 4.0
# Share of the resistance added to it [1].
_OFFSET_SHARE: Final = 0.5
# The same error for brakes, which may follow slowly [N/kN].
_BRAKE_OFFSET: Final = 8.0
# Share of these errors beyond which a slope is suspected [1].
_SUSPECTED: Final = 0.5
# Memory of a slope [blocks].
_MEMORY: Final = 20.0
# Memory while a finding lasts [blocks]: what was wrong is soon forgotten when it is mended.
_SHORT: Final = 8.0
# Blocks in a row that are off before they count: slip of the wheels at a departure is shorter.
_HELD: Final = 8
# Standard deviation below which a slope is known, as a share of the slope, or of 1 if that is more.
_KNOWN: Final = 0.12
# Number of blocks that this needs.
_MIN_BLOCKS: Final = 6.0
# Correlation below which y and x are unrelated [1].
_UNRELATED: Final = 0.5
# Number of blocks that this needs.
_UNRELATED_BLOCKS: Final = 12.0
# The command is wrong when the ratios of effort and deceleration to it are both farther from 1 than this factor [1],
_WRONG: Final = 1.35
# and differ from each other by less than this factor [1].
_SAME: Final = 1.25
# It is right again within this factor [1].
_RIGHT: Final = 1.2
# Smallest deviation of an effort that is off, as a share of the usual effort [1].
_OFF: Final = 0.3
# The same in usual deviations [1].
_OFF_SIGMAS: Final = 4.0
# The same as a force, and smallest effort that the share refers to [N/kN].
_OFF_FORCE: Final = 6.0
# Largest deviation that is learned, in usual ones [1].
_LEARNED_SIGMAS: Final = 3.0
# Memory of the usual deviation [blocks].
_USUAL_MEMORY: Final = 100.0
# The usual deviation at the start, and the smallest one, as a share of the effort [1].
_USUAL: Final = 0.05
# Blocks in a row that are off before the effort is suspected.
_OFF_BLOCKS: Final = 2
# Traction that shows a wrong slope soon, in root mean square [N/kN].
_STRONG: Final = 20.0
# Slope of a force that certainly acts against the command [1].
_OPPOSITE: Final = 0.4
# Factor within which a slope may be another one, as far as mass, brake and resistance are known [1].
_NEAR: Final = 1.0 / 0.7
# Ratio by which a speed in km/h is too large.
_KMH: Final = 3.6
# Ratio by which a speed in miles per hour is too large.
_MPH: Final = 2.2369
# Newtons per pound-force: ratio by which a force in pounds is too small.
_LBF: Final = 4.4482
# Slope of the brake below which the train does not brake [1].
_NO_BRAKING: Final = 0.2


@dataclass(slots=True)
class Regression:
    """Regression y = R x through the origin, with exponential forgetting."""

    finding: str = ''  # What is wrong, empty if nothing is
    yy: float = 0.0  # Sum of y^2 [(N/kN)^2]
    xx: float = 0.0  # Sum of x^2 [(N/kN)^2]
    yx: float = 0.0  # Sum of y x [(N/kN)^2]
    count: float = 0.0  # Effective number of blocks

    def add(self, y: float, x: float, memory: float = _MEMORY) -> None:
        """Add the means of one block [N/kN]; ``memory`` [blocks] applies while there is no finding."""
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
    """Slope of the acceleration over traction or brake."""

    off: int = 0  # Number of blocks in a row that are off
    held: tuple[float, ...] = ()  # Their y and x in turn, while they do not count [N/kN]
    offset: float = _OFFSET  # Error of y that does not grow with x [N/kN]
    # By how much y is outside the limits of the slope, in root mean square [N/kN]; 0 while it is not known
    excess: float = 0.0

    def take(self, y: float, x: float, limit: float) -> None:
        """Add the means of one block [N/kN]; with a residual above a limit it counts only with others in a row."""
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
        """True while the slope is not plausibly explained."""
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
        """Return whether y and x are certainly unrelated while one is large; ``noise`` is that of y [N/kN]."""
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
    """Slope of the reported force over the brake command, while the brake is applied: 1 whatever the brake rate is."""

    usual: float = 1.0  # The slope as it has been for long [1]
    square: float = _USUAL * _USUAL  # Mean square of the deviations of single blocks from it, as shares of it [1]
    off: int = 0  # Number of blocks in a row that are off
    has_stayed: bool = False  # True if the last suspicion ended because such deviations have become usual

    @property
    def is_suspected(self) -> bool:
        """True while the force for a command suddenly differs from the usual one."""
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
            unit = 'looks like g' if is_near(by_force, G) else 'is off'
            self.finding = f'ato/brake_command {unit}: speed and ato/force brake {by_force:.2g} times as much'
        elif not _agree(by_force, by_speed, _SAME) or _agree(by_force, 1.0, _RIGHT):
            self.finding = ''


def _is_off(by_force: float, by_speed: float) -> bool:
    """Return whether two ratios to the command agree with each other, but are not 1."""
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
    if is_near(slope, G):
        return f'ato/brake_command looks like g: the train brakes {slope:.2g} times as much'
    if unit := _speed_text(slope, by_position):
        return f'ato/speed looks like {unit}: the train brakes {slope:.2g} times as much as ato/brake_command'
    return f'the train brakes {slope:.2g} times as much as ato/brake_command'


# Length of a segment [m].
_SEGMENT: Final = 100.0
# Longest one, where the position stands still [m].
_MAX_M: Final = 1000.0
# Number of segments whose mean error counts.
_DISTANCE_MEMORY: Final = 7.0
# Number of segments that it needs.
_MIN_COUNT: Final = 4.0
# Limit of the mean error [1]: wheels wear by less than 2 %, balises correct the position by some metres.
_ERROR: Final = 0.035
# Error of a segment that agrees again [1].
_MENDED: Final = 0.025
# Number of these in a row after which a finding is over.
_MENDED_SEGMENTS: Final = 3
# Smallest deviation from the mean that is sudden [1]: wheels do not change on the way.
_SUDDEN: Final = 0.025
# The same in standard deviations of the segments before [1].
_SUDDEN_SIGMAS: Final = 5.0
# Number of such segments in a row that are a finding.
_SUDDEN_SEGMENTS: Final = 2
# A change of the position above three times the distance and this is a correction [m].
_JUMP: Final = 20.0
# A larger one is no correction of an odometer but a leap [m]; the train may know its position only now.
_LEAP: Final = 100.0
# Each leap counts one, less this for each segment since.
_LEAP_KEPT: Final = 0.05
# A larger count than this is a fault: two leaps within a kilometre.
_LEAPS: Final = 1.5
# A position is stuck that stands still over this way [m],
_STILL: Final = 200.0
# and over this multiple of the longest way that it stood still before [1].
_STILL_FACTOR: Final = 3.0
# Ratio of the distances beyond which the forces tell whether speed or position is off [1].
_FORCES_TELL: Final = 1.4
# Largest ratio of the distances that is told from others [1].
_MAX_RATIO: Final = 1e6
# Ratio within which a speed has another unit [1].
_UNIT: Final = 1.1
# Distance over which the present ratio of both is taken [m].
_RATIO_WAY: Final = 60.0
# Smallest distance that shows it [m].
_MIN_WAY: Final = 50.0
# Distance over which a position may stand still and be that of the train [m].
_BEHIND: Final = 20.0


@dataclass(slots=True)
class DistanceCheck:
    """Error of the distance by the speed, relative to that by the position [1]."""

    finding: str = ''  # What is wrong, empty if nothing is
    by_speed: float = 0.0  # Distance by the speed in this segment [m]
    by_position: float = 0.0  # Distance by the position in it [m]
    error: float = 0.0  # Error of the last segment [1]
    mean: float = 0.0  # Mean error [1]
    square: float = 0.0  # Mean square of the deviations from the mean [1]
    count: float = 0.0  # Number of segments in the mean
    sudden: int = 0  # Number of segments in a row that are suddenly off
    mended: int = 0  # Number of segments in a row without an error
    still: float = 0.0  # Distance by the speed since the position has changed last [m]
    has_moved: bool = False  # True once the position has changed
    longest_still: float = 0.0  # Longest such distance until it changed [m]
    leaps: float = 0.0  # Number of leaps of the position lately
    lately_by_speed: float = 0.0  # Distance by the speed, with forgetting [m]
    lately_by_position: float = 0.0  # The same by the position [m]
    by_force: float = 0.0  # Last known ratio of the acceleration to the forces under a finding [1], 0 if there is none

    @property
    def limit(self) -> float:
        """Largest error [1]."""
        return _ERROR

    @property
    def is_suspected(self) -> bool:
        """True while the last segment was suddenly off."""
        return self.sudden > 0

    def interrupt(self) -> None:
        """Begin a new segment; the train may turn where it stands."""
        self.by_speed = self.by_position = 0.0

    def forget_ratio(self) -> None:
        """Forget the present ratio of the distances, where the speed may now have another unit."""
        self.lately_by_speed = self.lately_by_position = 0.0

    @property
    def ratio(self) -> float:
        """Distance by the speed over that by the position [1], NaN while it is not known."""
        if self.lately_by_speed < _MIN_WAY or self.lately_by_position <= 0.0:
            return math.nan
        return self.lately_by_speed / self.lately_by_position

    @property
    def has_position(self) -> bool:
        """True if the position is where the train is, as far as the speed can tell."""
        return not self.finding and not self.is_suspected and self.still <= _BEHIND

    def add(self, by_speed: float, by_position: float, by_force: float = math.nan) -> None:
        """Add the distances between two samples.

        Args:
            by_speed: That by the speed [m].
            by_position: That by the position [m], NaN if it is not known.
            by_force: Acceleration over what the forces give [1], NaN if it is not known; a wrong speed changes it.
        """
        self._follow_position(by_speed, by_position)
        # While the direction is not known, positions seem to run back; slowly, they do by their noise.
        back = by_position < -0.5 * by_speed
        if back or not by_position <= 3.0 * (self.by_speed + by_speed) + _JUMP or self.by_speed > _MAX_M:
            self.interrupt()
            return
        keep = math.exp(-by_speed / _RATIO_WAY)
        self.lately_by_speed = keep * self.lately_by_speed + by_speed
        self.lately_by_position = keep * self.lately_by_position + by_position
        self.by_speed += by_speed
        self.by_position += by_position
        # A position may be updated less often than the speed: a segment ends where it changes.
        if by_position != 0.0 and self.by_speed >= _SEGMENT:
            if self.by_position != 0.0:  # below 0, the direction is not known since the position hardly changes
                self._close(min(self.by_speed / abs(self.by_position), _MAX_RATIO) - 1.0, by_force)
            self.interrupt()

    def _follow_position(self, by_speed: float, by_position: float) -> None:
        """Look for a position that stands still or leaps."""
        if by_position == 0.0:
            self.still += by_speed
            most = min(max(_STILL, _STILL_FACTOR * self.longest_still), _MAX_M) if self.has_moved else _MAX_M
            if self.still > most:
                self._name('the position in ato/speed stands still while the train moves')
        elif not math.isnan(by_position):
            if self.still <= _MAX_M:
                self.longest_still = max(self.longest_still, self.still)
            self.has_moved, self.still = True, 0.0
            self.leaps += 1.0 if is_leap(by_speed, by_position) else 0.0
            if is_leap(by_speed, by_position) and self.leaps > _LEAPS:
                self._name(f'the position in ato/speed jumps, by {by_position:+.0f} m the last time')

    def _name(self, finding: str) -> None:
        self.finding, self.mended = finding, 0

    def _close(self, error: float, by_force: float) -> None:
        """Judge the error of a segment [1]."""
        self.leaps = max(self.leaps - _LEAP_KEPT, 0.0)
        if not (self.finding and math.isnan(by_force)):
            self.by_force = 0.0 if math.isnan(by_force) else by_force
        deviation = error - self.mean
        limit = max(_SUDDEN, _SUDDEN_SIGMAS * math.sqrt(self.square))
        is_sudden = self.count >= _MIN_COUNT and abs(deviation) > limit
        self.error = error
        self.sudden = self.sudden + 1 if is_sudden else 0
        self.mended = self.mended + 1 if abs(error) < _MENDED else 0
        if not is_sudden:
            self.count = min(self.count + 1.0, _DISTANCE_MEMORY)
            self.mean += deviation / self.count
            self.square += (deviation * (error - self.mean) - self.square) / self.count
        if self.finding and self.mended >= _MENDED_SEGMENTS:
            self.finding, self.mean = '', error
        elif self.sudden >= _SUDDEN_SEGMENTS or (self.count >= _MIN_COUNT and abs(self.mean) > _ERROR):
            self.finding = _text(1.0 + error, self.by_force) if self.mended == 0 else self.finding


def is_leap(by_speed: float, by_position: float) -> bool:
    """Return whether the position has changed by far more than the way that the train has run [m]."""
    return abs(by_position) > 3.0 * by_speed + _LEAP


def _text(ratio: float, by_force: float) -> str:
    """Name what is off by the ratio of the distances; ``by_force`` is that of the acceleration to the forces [1]."""
    tells = by_force > 0.0 and not 1.0 / _FORCES_TELL < ratio < _FORCES_TELL
    if tells and abs(math.log(by_force)) < abs(math.log(by_force / ratio)):
        return f'the position in ato/speed changes by {1.0 / ratio:.2g} times the distance that the speed gives'
    if unit := speed_unit(ratio, _UNIT):
        return f'ato/speed looks like {unit}: {ratio:.2f} times what its position gives'
    return f'ato/speed is about {100.0 * (ratio - 1.0):+.0f} % off what its position gives'
