# SPDX-License-Identifier: Apache-2.0
"""Functions of single numbers and records that are fast, and exact to the last bit, in compiled modules too."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.interface.records import GRADIENT, NS_PER_S, SPEED
from trainid_ros.interface.results import Reason, Rejection

# The largest finite float [1].
_LARGEST: Final = 1.7976931348623157e308
# A float holds all integers up to here.
_EXACT: Final = 2**53


def is_finite(x: float) -> bool:
    """Return whether a number is neither NaN nor infinite; without a call, as this is asked for every sample."""
    return -_LARGEST <= x <= _LARGEST


def seconds(ns: int) -> float:
    """Return nanoseconds as seconds; compiled, a quotient of larger integers would be rounded twice."""
    if -_EXACT < ns < _EXACT:
        return ns / NS_PER_S
    return float(ns // NS_PER_S) + float(ns % NS_PER_S) / NS_PER_S


# Limits of the first number of a record, by topic: wider than any railway, so that only impossible values are rejected.
_LIMITS: tuple[tuple[float, float], ...] = (
    (0.0, 200.0),  # speed [m/s]
    (-1e8, 1e8),  # force [N]
    (-200.0, 200.0),  # gradient [per mille]
    (-10.0, 0.0),  # target acceleration [m/s^2]
    (100.0, 1e9),  # mass [kg]
)
# Limit of positions, which may be NaN [m].
_MAX_POSITION: Final = 1e9
# Limits of the radius of curves [m]; straight track has radius 0.
_MIN_RADIUS: Final = 5.0
_MAX_RADIUS: Final = 1e9


def find_fault(topic: int, stamp_ns: int, x: float, y: float) -> Rejection | None:
    """Return why a record, as a row of numbers, must be rejected, or None if it can be used."""
    if stamp_ns <= 0:
        return Rejection(stamp_ns, Reason.ZERO_STAMP, stamp_ns * 1e-9, 0.0)
    if topic == SPEED and abs(y) > _MAX_POSITION:
        return _out_of_range(stamp_ns, y, -_MAX_POSITION, _MAX_POSITION)
    low, high = _LIMITS[topic]
    if not low <= x <= high:
        return _out_of_range(stamp_ns, x, low, high)
    if topic == GRADIENT and y != 0.0 and not _MIN_RADIUS <= y <= _MAX_RADIUS:
        return _out_of_range(stamp_ns, y, _MIN_RADIUS, _MAX_RADIUS)
    return None


def _out_of_range(stamp_ns: int, value: float, low: float, high: float) -> Rejection:
    if not is_finite(value):
        return Rejection(stamp_ns, Reason.NOT_FINITE, value, math.nan)
    return Rejection(stamp_ns, Reason.OUT_OF_RANGE, value, low if value < low else high)
