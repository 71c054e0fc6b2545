# SPDX-License-Identifier: Apache-2.0
"""Check the unit and the sign of the gradient by how it slows the train, without a line to compare it with.

While no brake acts, the mean acceleration over some seconds is

    (1 + gamma) dv/dt = p F - g k i / 1000 - (a + b v + c v^2)

The regression leaves gain p of the force and resistance free, so that neither mass nor train file is needed. The slope
k is about 1 if the gradient i is in per mille, and 10 if it is in per cent. Nothing is said unless the gradient
explains a good part of what force and speed leave: on a flat line, or with much noise, its unit does not show.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.interface.records import GRADIENT_TOPIC
from trainid_ros.train.forces import G

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.stream.samples import Sample

    Array = NDArray[np.float64]

# Accelerations are means over at least this time [s], so that noise of the speed matters little.
_BLOCK_S: Final = 2.0
# Time after which a brake that was released does not act [s].
_RELEASED_S: Final = 4.0
# Share by which rotating masses raise the inertia of a usual train [1].
_USUAL_ROTARY: Final = 0.08
_FEWEST: Final = 15
# Residuals over this time in motion may be alike, as in a gust [s].
_ALIKE_S: Final = 20.0
# Multiple of its standard deviation that a slope has at least, share of the variance that the gradient explains at
# least [1], and least standard deviation of the gradient in its right unit [per mille].
_SIGMAS: Final = 8.0
_SHARE: Final = 0.2
_LEAST_STD: Final = 1.0
# Slope beyond which a gradient is certainly too small [1]: a speed in km/h gives 3.6. It exceeds that by so many
# standard deviations.
_TOO_SMALL: Final = 5.0
_BEYOND: Final = 3.0
# Factor within which a slope is that of a unit, or of a wrong sign [1].
_NEAR: Final = 1.6
# Slope of a gradient that is ten times too large [1]. Noise makes slopes small too, but no noise has this standard
# deviation [per mille].
_TOO_LARGE: Final = 0.1
_LARGE_STD: Final = 30.0
# Per mille in each unit.
_UNITS: Final = {'per cent': 10.0, 'degrees': 1000.0 * math.pi / 180.0, 'a ratio or radians': 1000.0}


class _Block(NamedTuple):
    """Means over some seconds without brake."""

    seconds: float  # How long
    acceleration: float  # In m/s^2
    gradient: float  # In per mille, as it is reported
    force: float  # Force by weight [N/kN]
    speed: float  # In m/s
    square: float  # Of the speed [m^2/s^2]


class _Slope(NamedTuple):
    """How the gradient slows the train."""

    value: float  # Slope k [1]
    std: float  # Its standard deviation [1]
    gradient_std: float  # Standard deviation of the gradient that force and speed do not explain [per mille]
    share: float  # Share of the variance that the gradient then explains [1]


class GradientCheck:
    """What the samples of a drive say about the unit of the gradient."""

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._released_s = 0.0
        self._sums = [0.0] * len(_Block._fields)

    def add(self, sample: Sample, before: float, traction: float) -> None:
        """Add a sample in motion that an estimator could use.

        Args:
            sample: The sample.
            before: The speed before [m/s].
            traction: Its force by its weight [N/kN].
        """
        dt, speed = sample.dt, 0.5 * (before + sample.speed)
        self._released_s = 0.0 if sample.brake_command < 0.0 else self._released_s + dt
        values = (1.0, (sample.speed - before) / dt, sample.gradient_mean, traction, speed, speed * speed)
        if self._released_s < _RELEASED_S or not math.isfinite(sum(values)):
            self._begin()
            return
        self._sums = [total + dt * value for total, value in zip(self._sums, values, strict=True)]
        if (seconds := self._sums[0]) >= _BLOCK_S:
            self._blocks.append(_Block(seconds, *(total / seconds for total in self._sums[1:])))
            self._begin()

    def interrupt(self) -> None:
        """Take note that samples are missing: a brake may have acted meanwhile."""
        self._released_s = 0.0
        self._begin()

    def _begin(self) -> None:
        self._sums = [0.0] * len(_Block._fields)

    def finding(self) -> str:
        """Return what is wrong with the gradient, '' if nothing is, or if it does not show."""
        if len(self._blocks) < _FEWEST or (slope := _slope(np.array(self._blocks))) is None:
            return ''
        size = abs(slope.value)
        if size < _SIGMAS * slope.std or slope.share < _SHARE or size * slope.gradient_std < _LEAST_STD:
            return ''
        how = f'the train is slowed {slope.value:.2g} times as much as by so many per mille'
        sign = ', with the wrong sign' if slope.value < 0.0 else ''
        if size - _BEYOND * slope.std > _TOO_SMALL:
            unit = min(_UNITS, key=lambda name: abs(math.log(size / _UNITS[name])))
            what = f'like {unit}' if _is_near(size, _UNITS[unit]) else 'too small'
            return f'{GRADIENT_TOPIC.name} looks {what}{sign}: {how}'
        if _is_near(size, _TOO_LARGE) and slope.gradient_std > _LARGE_STD:
            return f'{GRADIENT_TOPIC.name} looks ten times too large{sign}: {how}'
        if sign and _is_near(size, 1.0):
            return f'{GRADIENT_TOPIC.name} looks as if it had the wrong sign: the train gains speed uphill'
        return ''


def _is_near(size: float, expected: float) -> bool:
    return abs(math.log(size / expected)) < math.log(_NEAR)


def _slope(blocks: Array) -> _Slope | None:
    """Return the slope of blocks as rows; None where the gradient does not change apart from force and speed."""
    seconds, acceleration, gradient, *others = blocks.T
    design = np.column_stack([*others, np.ones(len(blocks))])
    design /= np.maximum(np.abs(design).max(axis=0), 1e-300)
    both = np.column_stack([acceleration, gradient])
    y, x = (both - design @ np.linalg.lstsq(design, both, rcond=1e-9)[0]).T
    square = float(x @ x)
    if square <= 1e-9 * float(gradient @ gradient):
        return None
    slope = float(x @ y) / square
    rest = y - slope * x
    # Residuals that are near in time are not independent.
    groups = np.floor(np.cumsum(seconds) / _ALIKE_S).astype(np.intp)
    sums = np.bincount(groups, weights=x * rest)
    std = math.sqrt(float(sums @ sums) * sums.size / max(sums.size - 1, 1)) / square
    scale = -1000.0 * (1.0 + _USUAL_ROTARY) / G
    explained = slope * slope * square
    share = explained / total if (total := explained + float(rest @ rest)) > 0.0 else 0.0
    return _Slope(scale * slope, abs(scale) * std, math.sqrt(square / len(blocks)), share)
