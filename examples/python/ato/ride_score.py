# SPDX-License-Identifier: Apache-2.0
"""Score of a ride: jerk, the deceleration with which it ends, overspeed and speed errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from trainid_ros.sim.plant import TICK_S

if TYPE_CHECKING:
    from trainid_ros.sim.plant import Plant


@dataclass(frozen=True, slots=True)
class _Moment:
    """Position [m], speed [m/s] and acceleration [m/s^2] at a tick."""

    position: float
    speed: float
    acceleration: float


class RideScore:
    """Follow the true train from tick to tick.

    Attributes:
        jerks: Mean jerk of each tick in motion and of that in which the train comes to rest [m/s^3].
        final_decelerations: Deceleration at the last tick before each standstill [m/s^2].
        speed_errors: Speed less that allowed, while it is regulated to [m/s].
        overspeed: Highest speed above a limit, 0 if none [m/s].

    """

    def __init__(self) -> None:
        """Start at rest."""
        self.jerks: list[float] = []
        self.final_decelerations: list[float] = []
        self.speed_errors: list[float] = []
        self.overspeed = 0.0
        self._last = _Moment(math.nan, 0.0, 0.0)

    def skip(self, train: Plant) -> None:
        """Take note of a tick that does not count."""
        self._last = _moment(train)

    def add(self, train: Plant, allowed: float | None) -> None:
        """Count a tick; with the speed allowed [m/s] if the controller regulates to it."""
        last, now = self._last, _moment(train)
        self.jerks.append((now.acceleration - last.acceleration) / TICK_S)
        if now.speed == 0.0 < last.speed:
            self.final_decelerations.append(-last.acceleration)
        self.overspeed = max(self.overspeed, _overspeed(last, train))
        if allowed is not None:
            self.speed_errors.append(train.speed - allowed)
        self._last = now


def _moment(train: Plant) -> _Moment:
    # In the step in which the train comes to rest, its mean acceleration is neither that before nor that at rest.
    acceleration = train.acceleration if train.speed > 0.0 else 0.0
    return _Moment(train.position, train.speed, acceleration)


def _overspeed(last: _Moment, train: Plant) -> float:
    """Return the highest speed above a limit since the last tick [m/s]: where limits begin, and at the end."""
    profile, direction = train.profile, train.direction
    most = train.speed - profile.speed_limit(train.position, direction)
    run = (train.position - last.position) * direction
    if run > 0.0:
        for distance, limit in profile.limits_ahead(last.position, direction, run):
            # At a constant acceleration, the square of the speed is linear in the distance.
            square = last.speed**2 + (train.speed**2 - last.speed**2) * distance / run
            most = max(most, math.sqrt(square) - limit)
    return most
