# SPDX-License-Identifier: Apache-2.0
"""Distance by the speed against distance by the position, segment by segment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.stream.slope import speed_unit

# Length of a segment [m]; longest one, where the position stands still [m].
_SEGMENT: Final = 100.0
_LONGEST: Final = 1000.0
# Number of segments whose mean error counts, and of those it needs.
_MEMORY: Final = 7.0
_LEAST: Final = 4.0
# Limit of the mean error [1]: wheels wear by less than 2 %, balises correct the position by some metres.
_ERROR: Final = 0.035
# It is over when so many segments in a row have errors below this [1].
_MENDED: Final = 0.025
_MENDED_SEGMENTS: Final = 3
# Error beyond the mean that so many segments in a row have at once [1], and standard deviations of the segments before:
# wheels do not change on the way.
_SUDDEN: Final = 0.025
_SUDDEN_SIGMAS: Final = 5.0
_SUDDEN_SEGMENTS: Final = 2
# A change of the position above three times the distance and this is a correction [m].
_JUMP: Final = 20.0
# A larger one is no correction of an odometer [m]; the train may know its position only now. Each counts one, less this
# for each segment since; more than the limit within a kilometre are a fault.
_LEAP: Final = 100.0
_LEAP_KEPT: Final = 0.05
_LEAPS: Final = 1.5
# A position that stands still over three times the longest way before, and this, is stuck [m].
_STILL: Final = 200.0
_STILL_FACTOR: Final = 3.0
# Ratio of the distances beyond which the forces tell whether speed or position is off [1].
_FORCES_TELL: Final = 1.4
# Largest ratio of the distances that is told from others [1].
_MOST: Final = 1e6
# Ratio within which a speed has another unit [1].
_UNIT: Final = 1.1
# Distance over which the present ratio of both is taken, and least one that shows it [m].
_RATIO_WAY: Final = 60.0
_LEAST_WAY: Final = 50.0
# Distance over which a position may stand still and be that of the train [m].
_BEHIND: Final = 20.0


@dataclass(slots=True)
class DistanceCheck:
    """Error of the distance by the speed, relative to that by the position [1].

    Attributes:
        finding: What is wrong, empty if nothing is.
        by_speed: Distance by the speed in this segment [m].
        by_position: Distance by the position in it [m].
        error: Error of the last segment [1].
        mean: Mean error [1].
        square: Mean square of the deviations from the mean [1].
        count: Number of segments in the mean.
        sudden: Number of segments in a row that are suddenly off.
        mended: Number of segments in a row without an error.
        still: Distance by the speed since the position has changed last [m].
        has_moved: True once the position has changed.
        longest_still: Longest such distance until it changed [m].
        leaps: Number of leaps of the position lately.
        lately_by_speed: Distance by the speed, with forgetting [m].
        lately_by_position: The same by the position [m].
        by_force: Last known ratio of the acceleration to the forces under a finding [1], 0 if there is none.

    """

    finding: str = ''
    by_speed: float = 0.0
    by_position: float = 0.0
    error: float = 0.0
    mean: float = 0.0
    square: float = 0.0
    count: float = 0.0
    sudden: int = 0
    mended: int = 0
    still: float = 0.0
    has_moved: bool = False
    longest_still: float = 0.0
    leaps: float = 0.0
    lately_by_speed: float = 0.0
    lately_by_position: float = 0.0
    by_force: float = 0.0

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
        if self.lately_by_speed < _LEAST_WAY or self.lately_by_position <= 0.0:
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
        if back or not by_position <= 3.0 * (self.by_speed + by_speed) + _JUMP or self.by_speed > _LONGEST:
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
                self._close(min(self.by_speed / abs(self.by_position), _MOST) - 1.0, by_force)
            self.interrupt()

    def _follow_position(self, by_speed: float, by_position: float) -> None:
        """Look for a position that stands still or leaps."""
        if by_position == 0.0:
            self.still += by_speed
            most = min(max(_STILL, _STILL_FACTOR * self.longest_still), _LONGEST) if self.has_moved else _LONGEST
            if self.still > most:
                self._name('the position in ato/speed stands still while the train moves')
        elif not math.isnan(by_position):
            if self.still <= _LONGEST:
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
        is_sudden = self.count >= _LEAST and abs(deviation) > limit
        self.error = error
        self.sudden = self.sudden + 1 if is_sudden else 0
        self.mended = self.mended + 1 if abs(error) < _MENDED else 0
        if not is_sudden:
            self.count = min(self.count + 1.0, _MEMORY)
            self.mean += deviation / self.count
            self.square += (deviation * (error - self.mean) - self.square) / self.count
        if self.finding and self.mended >= _MENDED_SEGMENTS:
            self.finding, self.mean = '', error
        elif self.sudden >= _SUDDEN_SEGMENTS or (self.count >= _LEAST and abs(self.mean) > _ERROR):
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
