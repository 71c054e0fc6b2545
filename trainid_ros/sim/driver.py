# SPDX-License-Identifier: Apache-2.0
"""ATO model that drives from stop to stop: power, coast, brake to speed limits and stops, dwell.

Braking follows speed-over-distance curves: ``v_ref(d) = sqrt(v_end^2 + 2 b d)``. The regulator uses
the train state predicted for the time when the brake acts (dead time plus lag), which keeps the loop well
damped; its feedback stops the train in place with a brake that is weaker or stronger than nominal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from trainid_ros.records import Record
from trainid_ros.settings import check_settings, setting
from trainid_ros.sim.plant import Plant
from trainid_ros.train.davis import G, davis, required_force
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import TrainFile

TICK_S: Final = 0.2
_LINEAR_M: Final = 1.0
_BRAKE_EXCESS: Final = -0.3
_RELEASE_EXCESS: Final = -0.8
# Largest gain of the regulator times dead time and lag of the brake: more would swing.
_MOST_GAIN: Final = 1.0


class Phase(Enum):
    """Driving phase."""

    DWELL = 'dwell'
    POWER = 'power'
    COAST = 'coast'
    BRAKE = 'brake'


@dataclass(frozen=True, slots=True)
class DriverModel:
    """Parameters of the driver."""

    acceleration: float = setting(0.9, 'maximum acceleration', 'm/s^2', 0.05, 2.0)
    deceleration: float = setting(0.65, 'deceleration of the braking curves', 'm/s^2', 0.05, 1.5)
    max_deceleration: float = setting(1.2, 'maximum brake command', 'm/s^2', 0.1, 3.0)
    jerk: float = setting(0.8, 'maximum jerk', 'm/s^3', 0.05, 10.0)
    speed_margin: float = setting(0.8, 'margin below speed limits', 'm/s', 0.0, 5.0)
    dwell_low: float = setting(22.0, 'minimum dwell time', 's', 0.0, 3600.0)
    dwell_high: float = setting(35.0, 'maximum dwell time', 's', 0.0, 3600.0)
    cruise_low: float = setting(5.0, 'minimum cruising time before coasting', 's', 0.0, 3600.0)
    cruise_high: float = setting(40.0, 'maximum cruising time before coasting', 's', 0.0, 3600.0)
    coast_floor: float = setting(0.82, 'share of the target speed at which coasting ends', '', 0.1, 1.0)
    holding: float = setting(0.6, 'brake command at standstill', 'm/s^2', 0.1, 3.0)
    brake_gain: float = setting(0.6, 'brake command per speed error', '1/s', 0.0, 3.0)
    brake_integral: float = setting(0.08, 'brake command per integral of the speed error', '1/s^2', 0.0, 1.0)
    stop_window: float = setting(
        1.0, 'distance before a stop within which a stationary train has arrived', 'm', 0.1, 4.5
    )


@dataclass(frozen=True, slots=True)
class Decision:
    """Demands until the next tick.

    Attributes:
        traction: Traction demand [N].
        brake: Brake command [m/s^2, <= 0].

    """

    traction: float
    brake: float


@dataclass(frozen=True, slots=True)
class StopEvent:
    """An arrival: time since the start [s], stopping point [m], overshoot beyond it [m]."""

    time_s: float
    stop: float
    error: float


class Driver:
    """Driver with a period of ``TICK_S``; ``phase``, ``stop`` and ``arrivals`` show its progress."""

    def __init__(
        self, model: DriverModel, train_file: TrainFile, profile: LineProfile, rng: np.random.Generator
    ) -> None:
        """Start with a dwell at the first stop.

        Args:
            model: Parameters of the driver.
            train_file: The train; its brake is taken as nominal.
            profile: Line profile for this train.
            rng: Random generator for dwell and coasting; the driver takes ownership.

        Raises:
            InputError: A setting is out of range.

        """
        check_settings(model)
        self.phase = Phase.DWELL
        self.arrivals: list[StopEvent] = []
        self.stop = math.nan
        self._model = model
        self._file = train_file
        self._profile = profile
        self._rng = rng
        self._lead = train_file.brake.delay + train_file.brake.time_constant
        # Share of the gains that a slow brake allows.
        self._share = min(1.0, _MOST_GAIN / max(model.brake_gain * self._lead, _MOST_GAIN))
        self._depart_s = 0.5 * self._draw(model.dwell_low, model.dwell_high)
        self._brake = -model.holding
        self._cruise_left_s = 0.0
        self._coasting_s = 0.0
        self._integral = 0.0
        self._rolling = False

    def observe(self, _record: Record) -> None:
        """Ignore the sensors: the driver knows the state of the train."""

    def may_depart(self, time_s: float) -> bool:
        """Return whether the dwell is over at a time [s]."""
        return self.phase is Phase.DWELL and not self._rolling and time_s >= self._depart_s

    def depart(self, stop: float) -> None:
        """Depart for the next stop [m]."""
        self.stop = stop
        self.phase = Phase.POWER
        self._cruise_left_s = self._draw(self._model.cruise_low, self._model.cruise_high)

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Return the demands until the next tick; the time is in s since the start."""
        if self.phase is not Phase.DWELL and self._is_at_stop(train):
            self.phase, self._rolling = Phase.DWELL, True
        if self.phase is Phase.DWELL:
            if self._rolling and train.speed == 0.0:
                self._arrive(time_s, train)
            return Decision(0.0, self._slew(-self._model.holding))
        allowed, slope = self._allowed(train)
        excess = max(0.0, train.speed + self._lead * train.acceleration) - allowed
        self._choose_phase(train, allowed, excess)
        if self.phase is Phase.BRAKE:
            return Decision(0.0, self._slew(-self._brake_effort(train, excess, slope)))
        traction = self._traction(train, allowed) if self.phase is Phase.POWER else 0.0
        return Decision(traction, self._slew(0.0))

    def _is_at_stop(self, train: Plant) -> bool:
        left = (self.stop - train.position) * train.direction
        return (train.speed < 0.3 and left < 0.2) or (train.speed == 0.0 and left < self._model.stop_window)

    def _arrive(self, time_s: float, train: Plant) -> None:
        self._rolling = False
        self._depart_s = time_s + self._draw(self._model.dwell_low, self._model.dwell_high)
        error = (train.position - self.stop) * train.direction
        self.arrivals.append(StopEvent(time_s, self.stop, error))

    def _allowed(self, train: Plant) -> tuple[float, float]:
        """Return the lowest reference speed [m/s] when the brake acts, and the deceleration [m/s^2] of its curve."""
        model = self._model
        run = max(0.0, self._lead * (train.speed + 0.5 * self._lead * train.acceleration))
        here = self._profile.speed_limit(train.position, train.direction)
        lowest, slope = min(here, self._file.train.max_speed) - model.speed_margin, 0.0
        reach = train.speed**2 / (2.0 * model.deceleration) + run + 50.0
        for distance, limit in self._profile.limits_ahead(train.position, train.direction, reach):
            end = limit - model.speed_margin
            curve = math.sqrt(end * end + 2.0 * model.deceleration * max(0.0, distance - run))
            if curve < lowest:
                lowest, slope = curve, model.deceleration
        left = (self.stop - train.position) * train.direction - run
        curve, steepness = self._stop_curve(left)
        return (curve, steepness) if curve < lowest else (lowest, slope)

    def _stop_curve(self, left: float) -> tuple[float, float]:
        b = self._model.deceleration
        if left > _LINEAR_M:
            return math.sqrt(2.0 * b * left), b
        # The square root has infinite slope at the stop: the last metre follows a straight line.
        slope = math.sqrt(2.0 * b / _LINEAR_M)
        speed = slope * max(0.0, left)
        return speed, slope * speed

    def _choose_phase(self, train: Plant, allowed: float, excess: float) -> None:
        model = self._model
        if excess > _BRAKE_EXCESS:
            if self.phase is not Phase.BRAKE:
                self._integral = 0.0
            self.phase = Phase.BRAKE
        elif self.phase is Phase.BRAKE and excess < _RELEASE_EXCESS:
            self.phase = Phase.POWER if train.speed < 0.5 else Phase.COAST
            self._coasting_s = 0.0
        elif self.phase is Phase.POWER and train.speed > allowed - model.speed_margin - 0.7:
            self._cruise_left_s -= TICK_S
            if self._cruise_left_s <= 0.0:
                self.phase, self._coasting_s = Phase.COAST, 0.0
        elif self.phase is Phase.COAST:
            self._coasting_s += TICK_S
            if self._coasting_s > 3.0 and train.speed < model.coast_floor * (allowed - model.speed_margin):
                self.phase = Phase.POWER
                self._cruise_left_s = self._draw(model.cruise_low, model.cruise_high)

    def _brake_effort(self, train: Plant, excess: float, slope: float) -> float:
        model = self._model
        self._integral = min(0.3, max(-0.3, self._integral + self._share * model.brake_integral * excess * TICK_S))
        retardation = self._resistance(train) * G / (1000.0 * (1.0 + self._file.train.rotary_mass))
        demand = slope + self._share * model.brake_gain * excess + self._integral - retardation
        return min(model.max_deceleration, max(0.0, demand / self._file.brake.shape_at(train.speed)))

    def _traction(self, train: Plant, allowed: float) -> float:
        vehicle, model = self._file.train, self._model
        error = allowed - model.speed_margin - train.speed
        target = min(model.acceleration, 0.5 * error)
        force = required_force(target, train.mass, vehicle.rotary_mass, self._resistance(train))
        return min(vehicle.traction_limit(train.speed), max(0.0, force))

    def _resistance(self, train: Plant) -> float:
        gradient = self._profile.gradient(train.position, train.direction)
        return davis(self._file.resistance, train.speed) + gradient

    def _slew(self, target: float) -> float:
        max_change = self._model.jerk * TICK_S
        change = min(max_change, max(-max_change, target - self._brake))
        # Commands have a resolution of 0.01 m/s^2, as on a train bus.
        self._brake = min(0.0, round(self._brake + change, 2))
        return self._brake

    def _draw(self, low: float, high: float) -> float:
        return float(self._rng.uniform(min(low, high), max(low, high)))
