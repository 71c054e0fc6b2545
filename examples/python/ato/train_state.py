# SPDX-License-Identifier: Apache-2.0
"""Speed and position of the train as its controller knows them: a wheel sensor, balises, and the model in between."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.interface.errors import check_settings, setting
from trainid_ros.interface.records import NS_PER_S

if TYPE_CHECKING:
    import numpy as np

    from trainid_ros.interface.records import GradientRecord, SpeedRecord
    from trainid_ros.train.line import LineProfile

# Distances of balises before each stop, in both directions [m].
BALISES: Final = (400.0, 150.0, 50.0, 12.0, 3.0)


@dataclass(frozen=True, slots=True)
class PositionModel:
    """How the controller measures speed and position."""

    balise_std: float = setting(0.02, 'standard deviation of the position read at a balise', 'm', 0.0, 1.0)
    speed_gain: float = setting(0.3, 'share of a speed error that one measurement corrects', '1', 0.01, 1.0)
    integral_gain: float = setting(0.06, 'acceleration per speed error, added with each measurement', '1/s', 0.0, 1.0)
    most_integral: float = setting(1.0, 'largest acceleration learned so', 'm/s^2', 0.0, 2.0)


class TrainState:
    """Speed and position, followed from measurement to measurement.

    Attributes:
        speed: Speed [m/s].
        position: Position of the front [m].
        direction: +1 while positions increase, -1 while they decrease.
        gradient_error: Gradient measured here less that of the line [per mille].
        unexplained: Acceleration that the measured speed shows beyond what is known of the train [m/s^2].

    """

    def __init__(self, model: PositionModel, profile: LineProfile, rng: np.random.Generator) -> None:
        """Start at rest at the first stop; InputError if a setting is out of range."""
        check_settings(model)
        self._model, self._profile, self._rng = model, profile, rng
        self.speed = 0.0
        self.position = profile.line.stops[0]
        self.direction = 1
        self.gradient_error = self.unexplained = 0.0
        self._passed = self.position
        self._acceleration, self._until_ns = 0.0, 0

    def predict(self, acceleration: float, now_ns: int, dt: float) -> None:
        """Move on from now [ns] by a time [s] at an acceleration [m/s^2]; a train at rest stays there."""
        before = self.speed
        self._acceleration, self._until_ns = acceleration, now_ns + round(dt * NS_PER_S)
        self.speed = max(0.0, before + acceleration * dt)
        self.position += self.direction * 0.5 * (before + self.speed) * dt

    def measure_speed(self, record: SpeedRecord) -> None:
        """Correct the speed; a wheel sensor that gives no pulses stands."""
        model = self._model
        if record.speed == 0.0:
            self.speed = 0.0
            return
        age_s = (self._until_ns - record.stamp_ns) / NS_PER_S
        error = record.speed + self._acceleration * age_s - self.speed
        self.speed += model.speed_gain * error
        most = model.most_integral
        self.unexplained = min(most, max(-most, self.unexplained + model.integral_gain * error))

    def measure_gradient(self, record: GradientRecord) -> None:
        """Take note of the gradient of the map, whose error reaches some way ahead."""
        self.gradient_error = record.gradient - self._profile.gradient(self.position, self.direction)

    def pass_balises(self, stop: float, position: float) -> None:
        """Correct the position [m] if the train has passed a balise before a stop [m] since the last call."""
        for distance in BALISES:
            balise = stop - self.direction * distance
            if (self._passed - balise) * self.direction < 0.0 <= (position - balise) * self.direction:
                self.position = position + self._model.balise_std * float(self._rng.standard_normal())
        self._passed = position

    def stand(self, position: float, direction: int) -> None:
        """Take over the position [m] of a stop, where it is known."""
        self.position, self.direction, self._passed = position, direction, position
        self.speed = self.unexplained = 0.0

    def gradient(self, ahead: float = 0.0) -> float:
        """Return the gradient a distance [m] ahead [per mille]."""
        position = self.position + self.direction * ahead
        return self._profile.gradient(position, self.direction) + self.gradient_error


def stopping_curve(distance: float, deceleration: float) -> float:
    """Return the speed [m/s] from which a deceleration [m/s^2] stops within a distance [m]."""
    return math.sqrt(2.0 * deceleration * max(0.0, distance))
