# SPDX-License-Identifier: Apache-2.0
"""Distance by the speed against distance by the position, segment by segment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.stream.slope import is_near

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

    def add(self, by_speed: float, by_position: float) -> None:
        """Add the distances between two samples [m]; that by the position is NaN if it is not known."""
        # While the direction is not known, positions seem to run back.
        if not 0.0 <= by_position <= 3.0 * (self.by_speed + by_speed) + _JUMP or self.by_speed > _LONGEST:
            self.interrupt()
            return
        self.by_speed += by_speed
        self.by_position += by_position
        # A position may be updated less often than the speed: a segment ends where it changes.
        if by_position != 0.0 and self.by_speed >= _SEGMENT:
            if self.by_position > 0.0:
                self._close(self.by_speed / self.by_position - 1.0)
            self.interrupt()

    def _close(self, error: float) -> None:
        """Judge the error of a segment [1]."""
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
            self.finding = _text(error) if self.mended == 0 else self.finding


def _text(error: float) -> str:
    if is_near(1.0 + error, 3.6):
        return f'ato/speed looks like km/h: {1.0 + error:.2f} times what its position gives'
    return f'ato/speed is about {100.0 * error:+.0f} % off what its position gives'
