# SPDX-License-Identifier: Apache-2.0
"""Where a train stops under a brake command, by dead time, lag, brake rate, resistance and gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.train.forces import acceleration, davis, lag_response

if TYPE_CHECKING:
    from ato.knowledge import TrainValues
    from ato.train_state import TrainState

# Steps of the prediction [s]: while the brake builds up, afterwards, and below a speed [m/s].
_BUILD_UP_S: Final = 2.0
_MEDIUM_S: Final = 0.25
_LONG_S: Final = 0.5
_SHORT_S: Final = 0.1
_SLOW: Final = 1.5
# A command that takes longer does not stop the train [s]; the rest then counts as braked with this [m/s^2].
_MAX_BRAKING_S: Final = 150.0
_WEAKEST: Final = 0.1
# Rounding of times counted in periods [1].
_EPSILON: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Motion:
    """Speed [m/s], distance covered [m], and command after dead time and lag [m/s^2, <= 0]."""

    speed: float
    distance: float
    brake: float


class BrakePredictor:
    """Follow the commands given, and predict the motion under them and under a next one.

    Attributes:
        values: Resistance and brake by which it predicts.

    """

    def __init__(self, values: TrainValues, state: TrainState, rotary_mass: float, period: float) -> None:
        """Start with a released brake; commands follow each other by a period [s]."""
        self.values = values
        self._state, self._rotary_mass, self._period = state, rotary_mass, period
        self._acting = 0.0
        self._given = [0.0] * (math.ceil(values.brake.delay / period) + 1)

    @property
    def acceleration(self) -> float:
        """Acceleration by brake, resistance and gradient at this time [m/s^2]."""
        return self._acceleration(self._state.speed, self._state.gradient(), self._acting)

    def command(self, target: float) -> None:
        """Give a command [m/s^2, <= 0], and let the earlier ones act for one period."""
        self._given.append(target)
        brake = self.values.brake
        waiting = brake.delay / self._period
        whole = math.ceil(waiting - _EPSILON)
        del self._given[: -whole - 1]
        # The oldest command acts until the next one has waited for the dead time.
        share = whole - waiting
        for acts, part in ((self._given[0], 1.0 - share), (self._given[-whole], share)):
            self._acting = lag_response(self._acting, acts, brake.time_constant, part * self._period)

    def when_next_acts(self) -> Motion:
        """Return the motion at the time when a command given now begins to act."""
        motion = Motion(self._state.speed, 0.0, self._acting)
        waiting = self.values.brake.delay
        while waiting > _EPSILON:
            # Commands act in the order in which they were given, each for one period.
            whole = math.ceil(waiting / self._period - _EPSILON)
            target = self._given[-whole]
            dt = waiting - (whole - 1) * self._period
            motion = self._moved(motion, target, dt)
            waiting -= dt
        return motion

    def stop_distance(self, begin: Motion, target: float) -> float:
        """Return the distance [m] until the train stops under one command from then on; very long if it does not."""
        motion, time_s = begin, 0.0
        while motion.speed > 0.0:
            dt = _SHORT_S if motion.speed < _SLOW else _LONG_S if time_s > _BUILD_UP_S else _MEDIUM_S
            motion = self._moved(motion, target, dt)
            time_s += dt
            if time_s > _MAX_BRAKING_S:
                return motion.distance + 0.5 * motion.speed * motion.speed / _WEAKEST
        return motion.distance

    def _moved(self, begin: Motion, target: float, dt: float) -> Motion:
        """Return the motion after a time [s] by the midpoint rule; a train that stops stays there."""
        speed, tau = begin.speed, self.values.brake.time_constant
        gradient = self._state.gradient(begin.distance + 0.5 * dt * speed)
        middle = max(0.0, speed + 0.5 * dt * self._acceleration(speed, gradient, begin.brake))
        rate = self._acceleration(middle, gradient, lag_response(begin.brake, target, tau, 0.5 * dt))
        after = speed + dt * rate
        if after > 0.0:
            distance = begin.distance + 0.5 * dt * (speed + after)
            return Motion(after, distance, lag_response(begin.brake, target, tau, dt))
        rest = 0.5 * speed * speed / -rate if rate < 0.0 else 0.0
        return Motion(0.0, begin.distance + rest, begin.brake)

    def _acceleration(self, speed: float, gradient: float, brake: float) -> float:
        values = self.values
        # Without a force, the mass does not matter.
        by_track = acceleration(0.0, 1.0, self._rotary_mass, davis(values.resistance, speed) + gradient)
        return values.brake.rate_at(speed) * brake + by_track + self._state.unexplained
