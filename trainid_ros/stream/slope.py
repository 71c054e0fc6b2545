# SPDX-License-Identifier: Apache-2.0
"""Slope of the acceleration over traction or brake, and what a wrong slope looks like."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.stream.input_checks import is_near

# Plausible slopes of traction and brake [1]: loads, brake rates and resistances differ by less.
_TRACTION_RANGE = (0.55, 1.8)
_BRAKE_RANGE = (0.35, 2.2)
# Errors of map and resistance that do not grow with x [N/kN].
_OFFSET: Final = 8.0
# Memory [blocks].
_MEMORY: Final = 20.0
# A slope is known when its standard deviation is below this share of it, or of 1, after this many blocks.
_KNOWN: Final = 0.12
_MIN_BLOCKS: Final = 6.0
# Correlation below which y and x do not belong together [1], after this many blocks.
_UNRELATED: Final = 0.5
_UNRELATED_BLOCKS: Final = 12.0


@dataclass(slots=True)
class Slope:
    """Regression y = R x through the origin, with exponential forgetting.

    Attributes:
        yy: Sum of y^2 [(N/kN)^2].
        xx: Sum of x^2 [(N/kN)^2].
        yx: Sum of y x [(N/kN)^2].
        count: Effective number of blocks.

    """

    yy: float = 0.0
    xx: float = 0.0
    yx: float = 0.0
    count: float = 0.0

    def add(self, y: float, x: float) -> None:
        """Add the means of one block [N/kN]."""
        keep = 1.0 - 1.0 / _MEMORY
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

    def is_unrelated(self, noise: float) -> bool:
        """Return whether the speed certainly changes, or should, but not with x; ``noise`` is that of y [N/kN]."""
        if self.count < _UNRELATED_BLOCKS or max(self.yy, self.xx) < self.count * (4.0 * _OFFSET**2 + noise**2):
            return False
        return self.yx <= _UNRELATED * math.sqrt(self.yy * self.xx)

    def traction_finding(self, before: str, noise: float) -> str:
        """Return what the slope of traction says, ``before`` if it is not known."""
        if self.is_known:
            return _traction_text(self.value) if self._excess(_TRACTION_RANGE) > _OFFSET else ''
        if self.is_unrelated(noise):
            return 'the speed does not follow ato/force: one of them is stuck, late or of another train'
        return before

    def brake_finding(self, before: str, noise: float) -> str:
        """Return what the slope of the brake says, ``before`` if it is not known."""
        if self.is_known:
            return _brake_text(self.value) if self._excess(_BRAKE_RANGE) > _OFFSET else ''
        if self.is_unrelated(noise):
            return 'the speed does not follow ato/brake_command: one of them is stuck or of another train'
        return before

    def _excess(self, limits: tuple[float, float]) -> float:
        """Return by how much y is outside the limits of the slope, in root mean square [N/kN]."""
        outside = max(limits[0] - self.value, self.value - limits[1], 0.0)
        return outside * math.sqrt(self.xx / self.count)


def _traction_text(slope: float) -> str:
    if is_near(slope, 1e3):
        return 'ato/force looks like kN: it is about 1000 times too small for the acceleration'
    if is_near(slope, 1e-3):
        return 'ato/force is about 1000 times too large for the acceleration'
    if is_near(slope, 3.6):
        return f'ato/speed looks like km/h: the acceleration is {slope:.2g} times what ato/force gives'
    if slope < 0.0:
        return 'ato/force looks as if it had the wrong sign'
    return f'the acceleration is {slope:.2g} times what ato/force and mass give'


def _brake_text(slope: float) -> str:
    if is_near(slope, 9.81):
        return f'ato/brake_command looks like g: the train brakes {slope:.2g} times as much'
    if is_near(slope, 3.6):
        return f'ato/speed looks like km/h: the train brakes {slope:.2g} times as much as ato/brake_command'
    if slope < 0.0:
        return 'the train accelerates while ato/brake_command brakes'
    return f'the train brakes {slope:.2g} times as much as ato/brake_command'
