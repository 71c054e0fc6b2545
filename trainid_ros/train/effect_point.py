# SPDX-License-Identifier: Apache-2.0
"""Inputs of an effect: position and motion of the train at one time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

COOLING_S: Final = 300.0
"""Cooling time constant of the brake [s]: a hot brake loses 63 % of its heat in this time."""
BRAKE_APPLIED: Final = -0.02
"""The brake counts as applied when its nominal acceleration is below this value [m/s^2]."""


def _zero(_: float) -> float:
    return 0.0


@dataclass(slots=True)
class TrackPoint:
    """Position and motion of the train at one time; unknown values have neutral defaults.

    Live estimators use one object for all times: an effect must not keep it.
    """

    time_s: float  # Time since the start [s]
    position: float  # Position of the train's front [m], NaN if unknown
    direction: int  # +1 while positions increase, -1 while they decrease
    speed: float  # Speed [m/s, >= 0]
    curve_radius: float = 0.0  # Radius that gives the mean curvature under the train [m], 0 = straight
    tunnel: bool = False  # True in a tunnel
    length: float = 0.0  # Length of the train [m]; 0 treats it as a point at its front
    distance_run: float = 0.0  # Distance run since the start [m]
    # Time since the brake was released [s]; 0 while it is applied, infinite before its first use
    since_release: float = math.inf
    traction: float = 0.0  # Reported traction, 1000 F/(M g) with the assumed mass M [N/kN]
    brake: float = 0.0  # Braking force of the assumed brake, including its rate, per assumed weight [N/kN, <= 0]
    heat: float = 0.0  # Heat stored in this brake after cooling [J per kg of train]
    acceleration: float = 0.0  # Acceleration [m/s^2]; 0 in live estimators, which measure only speed
    # ``brake`` a number of seconds ago; constant in live estimators, which shift its dead time instead
    brake_before: Callable[[float], float] = _zero
    # ``traction`` a number of seconds ago; only fits have future values (negative seconds)
    traction_before: Callable[[float], float] = _zero
    # Reported gradient [per mille] a number of metres ahead; negative metres are behind
    gradient_ahead: Callable[[float], float] = _zero


def heat_after(heat: float, brake: float, speed: float, duration: float) -> float:
    """Return the heat in a brake [J/kg] after braking at constant acceleration: the solution of h' = -brake v - h / T.

    Args:
        heat: Heat before [J/kg].
        brake: Acceleration by the assumed brake [m/s^2, <= 0].
        speed: Mean speed [m/s].
        duration: Time [s].
    """
    decay = math.exp(-duration / COOLING_S)
    return heat * decay - brake * speed * COOLING_S * (1.0 - decay)


def share_inside(at: TrackPoint, start: float, end: float) -> float:
    """Return the share [0 to 1] of the train between two positions [m]; 0 while its position is unknown."""
    if math.isnan(at.position):
        return 0.0
    if at.length <= 0.0:
        return 1.0 if start <= at.position < end else 0.0
    low = at.position - at.length if at.direction > 0 else at.position
    high = low + at.length
    if high <= start or low >= end:
        return 0.0
    return (min(high, end) - max(low, start)) / at.length
