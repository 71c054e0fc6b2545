# SPDX-License-Identifier: Apache-2.0
"""The driver: accelerates, holds the speed or alternates power and coasting, obeys restrictions, brakes to the stop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.hidden_cases.hidden import G

if TYPE_CHECKING:
    from benchmarks.hidden_cases.world import Leg, Vehicle

HOLD = -0.4
_JERK = 0.6


class Driver:
    """Decides every 0.2 s on traction [m/s^2, force over weighed mass] and brake command [m/s^2]."""

    def __init__(self, vehicle: Vehicle, leg: Leg, davis: tuple[float, float, float]) -> None:
        self._leg = leg
        self._lead = vehicle.brake_dead + vehicle.brake_lag + 0.2
        self._davis = davis
        self._stopping = self._slowing = self._resting = self._nearing = False
        self._last = 0.0

    def decide(self, front: float, speed: float, gradient: float) -> tuple[float, float]:
        """Return the demanded traction and brake command [m/s^2].

        Position of the front [m], speed [m/s], gradient in the direction of travel [per mille].
        """
        leg = self._leg
        left = leg.heading * (leg.end - front)
        if self._stopping or left <= speed * self._lead + speed * speed / (2.0 * leg.brake):
            return 0.0, self._stop(left, speed, gradient)
        limit = self._limit(front, speed)
        if self._slows(speed, limit):
            return 0.0, -0.5 if speed > limit + 2.0 else -0.3
        return self._pull(left, speed, limit, gradient), 0.0

    def _stop(self, left: float, speed: float, gradient: float) -> float:
        if not self._stopping or (left > 4.0 and speed > 1.5):
            wanted = speed * speed / (2.0 * max(left - 0.3 * speed, 1.0)) - G * gradient / 1000.0
            self._last = -round(min(1.2, max(0.2, wanted)), 2)
        self._stopping = True
        return self._last

    def _limit(self, front: float, speed: float) -> float:
        leg = self._leg
        if leg.restriction is None:
            return leg.cruise
        begin, end, slow = leg.restriction
        ahead = leg.heading * (begin - front)
        if leg.heading * (end - front) < 0.0 or slow >= leg.cruise:
            return leg.cruise
        near = speed * self._lead + max(0.0, speed * speed - slow * slow) / (2.0 * 0.45)
        self._nearing = self._nearing or ahead < near
        return slow if self._nearing else leg.cruise

    def _slows(self, speed: float, limit: float) -> bool:
        self._slowing = speed > (limit - 0.2 if self._slowing else limit + 0.8)
        return self._slowing

    def _pull(self, left: float, speed: float, limit: float, gradient: float) -> float:
        leg = self._leg
        if left < leg.coast_from and speed > 0.5 * limit:
            return 0.0
        if leg.on_off:
            if speed >= limit:
                self._resting = True
            elif speed < limit - 1.8:
                self._resting = False
            return 0.0 if self._resting else 2.0
        a, b, c = self._davis
        steady = G / 1000.0 * (a + b * speed + c * speed * speed + gradient)
        return max(0.0, steady + 0.4 * (limit - speed))


def slew(now: float, wanted: float, step: float) -> float:
    """Return the traction one step later, limited by jerk [m/s^2]."""
    most = _JERK * step
    return min(now + most, max(now - 2.0 * most, wanted))
