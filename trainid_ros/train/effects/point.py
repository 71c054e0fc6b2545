# SPDX-License-Identifier: Apache-2.0
"""All that an effect may depend on: where and how the train runs at one moment."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

COOLING_S: Final = 300.0
"""Time in which a hot brake loses 63 % of its heat."""
BRAKE_APPLIED: Final = -0.02
"""A nominal brake counts as applied below this acceleration [m/s^2]."""


def _nothing(_: float) -> float:
    return 0.0


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """Where and how the train runs at one moment; what is not known is neutral.

    Attributes:
        time_s: Time since the start [s].
        position: Position of the train's front [m], NaN if unknown.
        direction: +1 while positions rise, -1 while they fall.
        speed: Speed [m/s, >= 0].
        curve_radius: Radius that gives the mean curvature under the train [m], 0 = straight.
        tunnel: True in a tunnel.
        length: Length of the train [m]; 0 places all of it at its front.
        distance_run: Distance run since the start [m].
        since_release: Time since the brake was released [s]; 0 while it is applied, infinite while it has not been.
        traction: Reported traction, 1000 F/(M g) with the believed mass M [N/kN].
        brake: Force of a brake as believed, its rate included, per believed weight [N/kN, <= 0].
        heat: Heat that this brake has put into itself, less what has cooled [J per kg of train].
        acceleration: Acceleration [m/s^2]; live estimators, which measure speed alone, leave it 0.
        brake_before: ``brake`` so many seconds ago; steady for live estimators, which shift its dead time instead.
        traction_before: ``traction`` so many seconds ago; fits alone know those ahead (negative seconds).
        gradient_ahead: Gradient as reported so many metres further ahead [per mille]; negative metres lie behind.

    """

    time_s: float
    position: float
    direction: int
    speed: float
    curve_radius: float = 0.0
    tunnel: bool = False
    length: float = 0.0
    distance_run: float = 0.0
    since_release: float = math.inf
    traction: float = 0.0
    brake: float = 0.0
    heat: float = 0.0
    acceleration: float = 0.0
    brake_before: Callable[[float], float] = _nothing
    traction_before: Callable[[float], float] = _nothing
    gradient_ahead: Callable[[float], float] = _nothing


def heat_after(heat: float, brake: float, speed: float, duration: float) -> float:
    """Return the heat in a brake [J/kg] after a constant braking acceleration at a speed: h' = -brake v - h / T.

    Args:
        heat: Heat before [J/kg].
        brake: Acceleration by the brake as believed [m/s^2, <= 0].
        speed: Mean speed [m/s].
        duration: Time [s].

    """
    left = math.exp(-duration / COOLING_S)
    return heat * left - brake * speed * COOLING_S * (1.0 - left)


def share_inside(at: TrackPoint, start: float, end: float) -> float:
    """Return the share of the train that is between two positions, 0 to 1; 0 while its position is unknown."""
    if math.isnan(at.position):
        return 0.0
    if at.length <= 0.0:
        return 1.0 if start <= at.position < end else 0.0
    low = at.position - at.length if at.direction > 0 else at.position
    high = low + at.length
    if high <= start or low >= end:
        return 0.0
    return (min(high, end) - max(low, start)) / at.length
