# SPDX-License-Identifier: Apache-2.0
"""Check single records: finite, stamped, physically possible."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.core.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord
from trainid_ros.core.results import Reason, Rejection

# Wider than any railway, so that only impossible values are rejected.
SPEED_LIMITS: Final = (0.0, 200.0)  # m/s
FORCE_LIMITS: Final = (-1e8, 1e8)  # N
GRADIENT_LIMITS: Final = (-200.0, 200.0)  # per mille
CURVE_RADIUS_LIMITS: Final = (5.0, 1e9)  # m; of curves only, straight track has radius 0
BRAKE_LIMITS: Final = (-10.0, 0.0)  # m/s^2
MASS_LIMITS: Final = (100.0, 1e9)  # kg


def find_fault(record: Record) -> Rejection | None:
    """Return why a record must be rejected, or None if it can be used."""
    if record.stamp_ns <= 0:
        return Rejection(record.stamp_ns, Reason.ZERO_STAMP, record.stamp_ns * 1e-9, 0.0)
    if isinstance(record, SpeedRecord) and math.isinf(record.position):
        return Rejection(record.stamp_ns, Reason.NOT_FINITE, record.position, math.nan)
    for value, limits in _checked(record):
        if not math.isfinite(value):
            return Rejection(record.stamp_ns, Reason.NOT_FINITE, value, math.nan)
        if value < limits[0] or value > limits[1]:
            nearest = limits[0] if value < limits[0] else limits[1]
            return Rejection(record.stamp_ns, Reason.OUT_OF_RANGE, value, nearest)
    return None


def _checked(record: Record) -> tuple[tuple[float, tuple[float, float]], ...]:
    match record:
        case SpeedRecord():
            return ((record.speed, SPEED_LIMITS),)
        case ForceRecord():
            return ((record.force, FORCE_LIMITS),)
        case GradientRecord():
            curve = ((record.curve_radius, CURVE_RADIUS_LIMITS),) if record.curve_radius != 0.0 else ()
            return (record.gradient, GRADIENT_LIMITS), *curve
        case BrakeRecord():
            return ((record.target_acceleration, BRAKE_LIMITS),)
        case MassRecord():
            return ((record.mass, MASS_LIMITS),)
