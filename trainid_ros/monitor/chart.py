# SPDX-License-Identifier: Apache-2.0
"""An estimate over time in characters: a line of blocks, or several lines with the band of two standard deviations."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.monitor.view import Point

BAND_STD: Final = 2.0
_LEVELS: Final = '▁▂▃▄▅▆▇█'
_ASCII_LEVELS: Final = '_.-~=+*#'
_EMPTY: Final = ' '
# Bands that are wider than this many of the narrowest one are cut off [1].
_WIDEST: Final = 3.0
# Values that differ less than this share of their size are drawn as a level line [1].
_LEAST_SPAN: Final = 1e-3
# Larger values are not drawn: messages may hold any number.
_LARGEST: Final = 1e100


class Marks(NamedTuple):
    """Characters of a chart: levels of a single line from low to high, the value and the band of several lines."""

    levels: str
    value: str
    band: str


UNICODE: Final = Marks(_LEVELS, '●', '░')
ASCII: Final = Marks(_ASCII_LEVELS, 'o', ':')


class Chart(NamedTuple):
    """Lines of a chart, the top one first, and the values of its upper and lower edge."""

    lines: tuple[str, ...]
    high: float
    low: float


def chart(points: Sequence[Point], columns: int, rows: int, span_s: float, marks: Marks = UNICODE) -> Chart:
    """Draw the last time of an estimate.

    Args:
        points: Past values, the oldest first.
        columns: Characters in a line.
        rows: Lines; a single one shows the value alone.
        span_s: Time that the columns cover [s].
        marks: Characters to use.

    Returns:
        The chart; empty lines where no value is in that time.

    """
    binned = _binned(points, columns, span_s)
    drawn = [point for point in binned if point is not None]
    if not drawn:
        return Chart((_EMPTY * columns,) * rows, math.nan, math.nan)
    low, high = _range(drawn, with_band=rows > 1)
    lines = [''.join(_cell(point, row, rows, low, high, marks) for point in binned) for row in range(rows)]
    return Chart(tuple(reversed(lines)), high, low)


def _binned(points: Sequence[Point], columns: int, span_s: float) -> list[Point | None]:
    """Return the last point in the time of each column, None where there is none."""
    binned: list[Point | None] = [None] * columns
    for point in points:
        column = columns - 1 - int(point.ago_s / span_s * columns)
        if 0 <= column < columns and abs(point.value) < _LARGEST:
            binned[column] = point
    return binned


def _range(drawn: Sequence[Point], *, with_band: bool) -> tuple[float, float]:
    """Return the lower and upper edge: all values, and their bands unless much wider than the narrowest."""
    values = [point.value for point in drawn]
    if with_band:
        widest = _WIDEST * min(map(_deviation, drawn))
        for point in drawn:
            half = BAND_STD * min(_deviation(point), widest)
            values += [point.value - half, point.value + half]
    low, high = min(values), max(values)
    least = _LEAST_SPAN * max(abs(low), abs(high), _LEAST_SPAN)
    middle, half = 0.5 * (low + high), max(0.5 * (high - low), least)
    return middle - half, middle + half


def _deviation(point: Point) -> float:
    return point.std if abs(point.std) < _LARGEST else 0.0


def _cell(point: Point | None, row: int, rows: int, low: float, high: float, marks: Marks) -> str:
    """Return the character of a column; row 0 is the lowest one."""
    if point is None:
        return _EMPTY
    place = (point.value - low) / (high - low) * rows
    if rows == 1:
        return marks.levels[min(int(place * len(marks.levels)), len(marks.levels) - 1)]
    if row == min(int(place), rows - 1):
        return marks.value
    half = BAND_STD * _deviation(point) / (high - low) * rows
    return marks.band if place - half < row + 1 and place + half > row else _EMPTY
