# SPDX-License-Identifier: Apache-2.0
"""Check single records: finite, stamped, physically possible."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.records import GRADIENT, SPEED
from trainid_ros.results import Reason, Rejection

# Wider than any railway, so that only impossible values are rejected.
SPEED_LIMITS: Final = (0.0, 200.0)  # m/s
FORCE_LIMITS: Final = (-1e8, 1e8)  # N
GRADIENT_LIMITS: Final = (-200.0, 200.0)  # per mille
CURVE_RADIUS_LIMITS: Final = (5.0, 1e9)  # m; of curves only, straight track has radius 0
BRAKE_LIMITS: Final = (-10.0, 0.0)  # m/s^2
MASS_LIMITS: Final = (100.0, 1e9)  # kg
# Of the first number of a record, by topic.
_LIMITS: Final = (SPEED_LIMITS, FORCE_LIMITS, GRADIENT_LIMITS, BRAKE_LIMITS, MASS_LIMITS)


def find_fault(topic: int, stamp_ns: int, x: float, y: float) -> Rejection | None:
    """Return why a record, as a row of numbers, must be rejected, or None if it can be used."""
    if stamp_ns <= 0:
        return Rejection(stamp_ns, Reason.ZERO_STAMP, stamp_ns * 1e-9, 0.0)
    if topic == SPEED and math.isinf(y):
        return Rejection(stamp_ns, Reason.NOT_FINITE, y, math.nan)
    low, high = _LIMITS[topic]
    if not low <= x <= high:
        return _out_of_range(stamp_ns, x, low, high)
    if topic == GRADIENT and y != 0.0:
        low, high = CURVE_RADIUS_LIMITS
        if not low <= y <= high:
            return _out_of_range(stamp_ns, y, low, high)
    return None


def _out_of_range(stamp_ns: int, value: float, low: float, high: float) -> Rejection:
    if not math.isfinite(value):
        return Rejection(stamp_ns, Reason.NOT_FINITE, value, math.nan)
    return Rejection(stamp_ns, Reason.OUT_OF_RANGE, value, low if value < low else high)
