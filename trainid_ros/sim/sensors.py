# SPDX-License-Identifier: Apache-2.0
"""Sensor models: noise, resolution, drift, map errors, stamp errors, lost messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    SpeedRecord,
)
from trainid_ros.settings import check_settings, setting
from trainid_ros.train.davis import G

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAP_STEP_M: Final = 10.0
MAX_JITTER_NS: Final = 4_000_000
_SLIP_DURATION_S: Final = (0.6, 2.0)
_LOWEST_ADHESION: Final = 10.0
"""Lowest adhesion, 1 % of the weight: a wheel that transmits less force does not slip [N/kN]."""
_MAX_SLIP_SHARE: Final = 0.9
"""Maximum share of slip in the time with a force above the lowest adhesion [1]."""


@dataclass(frozen=True, slots=True)
class SensorModel:
    """Errors of the sensors."""

    speed_noise: float = setting(0.02, 'standard deviation of the speed noise', 'm/s', 0.0, 10.0)
    speed_quantum: float = setting(0.1 / 3.6, 'resolution of the speed', 'm/s', 0.0, 10.0)
    force_noise: float = setting(0.3, 'standard deviation of the force noise, per weight', 'N/kN', 0.0, 100.0)
    force_noise_relative: float = setting(0.003, 'additional force noise as a share of the force', '', 0.0, 1.0)
    wheel_ratio: float = setting(1.0, 'measured over true speed', '', 0.5, 2.0)
    position_drift: float = setting(0.03, 'random walk of the odometry error between stops', 'm/sqrt(s)', 0.0, 10.0)
    map_error: float = setting(0.2, 'standard deviation of the map error', 'per mille', 0.0, 50.0)
    map_error_length: float = setting(200.0, 'correlation length of the map error', 'm', 1.0, 1e5)
    mass_noise: float = setting(0.002, 'standard deviation of the relative error of each load weighing', '', 0.0, 0.5)
    dropout: float = setting(0.0, 'probability that a message is lost', '', 0.0, 1.0)
    stamp_jitter: float = setting(0.0005, 'standard deviation of the stamp jitter, clipped at 4 ms', 's', 0.0, 0.004)
    force_delay: float = setting(0.0, 'delay of the force stamps behind the force', 's', -1.5, 1.5)
    slip_share: float = setting(0.0, 'share of the running time with wheel slip or slide', '', 0.0, 0.5)
    slip_speed: float = setting(3.0, 'maximum speed error in slip or slide', 'm/s', 0.0, 10.0)


class Sensors:
    """Turn true values into records; a lost message is None."""

    def __init__(self, model: SensorModel, dt: float, extent: tuple[float, float], rng: np.random.Generator) -> None:
        """Draw the errors that are constant during the simulation.

        Args:
            model: Errors of the sensors.
            dt: Time between two speed measurements [s].
            extent: Lowest and highest position of the line [m].
            rng: Random generator; the sensors take ownership.

        Raises:
            InputError: A setting is out of range.

        """
        check_settings(model)
        self.model = model
        self._dt = dt
        self._rng = rng
        self._map_start = extent[0]
        count = max(2, math.ceil((extent[1] - extent[0]) / MAP_STEP_M) + 1)
        rho = math.exp(-MAP_STEP_M / model.map_error_length)
        self._map: list[float] = ar1_path(count, model.map_error, rho, rng).tolist()
        self._position_error = 0.0
        self._last_position = math.nan
        self._slip = 0.0
        self._slip_left_s = 0.0
        self._running_count = self._forced_count = 0

    def speed(self, stamp_ns: int, speed: float, position: float, force_per_weight: float) -> SpeedRecord | None:
        """Measure speed [m/s] and position [m]; ``force_per_weight`` [N/kN] causes wheel slip (> 0) or slide (< 0).

        A stationary wheel gives no pulses: its speed is measured as exactly zero, and the position is corrected
        at the platform.
        """
        model = self.model
        noise, drift = self._rng.standard_normal(2).tolist()
        moved = 0.0 if math.isnan(self._last_position) else position - self._last_position
        self._last_position = position
        if speed == 0.0:
            self._position_error = self._slip_left_s = 0.0
            measured = 0.0
        else:
            self._position_error += (model.wheel_ratio - 1.0) * moved
            self._position_error += model.position_drift * math.sqrt(self._dt) * drift
            slip = self._slip_speed(force_per_weight) if model.slip_share > 0.0 else 0.0
            measured = max(0.0, quantise(model.wheel_ratio * speed + slip + model.speed_noise * noise, model))
        stamp = self._stamp(stamp_ns)
        if self._lost():
            return None
        return SpeedRecord(stamp, measured, position + self._position_error)

    def force(self, stamp_ns: int, force: float, mass: float) -> ForceRecord | None:
        """Measure the wheel-rim force [N] of a train with a mass [kg]."""
        white, relative = self._rng.standard_normal(2).tolist()
        noise = self.model.force_noise * mass * G / 1000.0 * white
        noise += self.model.force_noise_relative * abs(force) * relative
        stamp = self._stamp(stamp_ns) + round(self.model.force_delay * NS_PER_S)
        return None if self._lost() else ForceRecord(stamp, force + noise)

    def gradient(
        self, stamp_ns: int, gradient: float, position: float, direction: int, *, radius: float, tunnel: bool
    ) -> GradientRecord | None:
        """Read the track data from the map, whose gradient error is the same at each passage.

        The gradient is in per mille, + uphill in the direction of travel; position and curve radius are in m.
        """
        measured = gradient + direction * self.map_error(position)
        stamp = self._stamp(stamp_ns)
        return None if self._lost() else GradientRecord(stamp, measured, radius, tunnel)

    def brake(self, stamp_ns: int, target_acceleration: float) -> BrakeRecord | None:
        """Record a brake command [m/s^2]; commands are not measurements and have neither noise nor jitter."""
        return None if self._lost() else BrakeRecord(stamp_ns, target_acceleration, emergency=False)

    def mass(self, stamp_ns: int, weighed: float) -> MassRecord | None:
        """Record the mass of the last load weighing [kg]."""
        return None if self._lost() else MassRecord(stamp_ns, weighed)

    def weigh(self, mass: float) -> float:
        """Return the weighed mass [kg]; it applies until the doors open again."""
        return mass * (1.0 + self.model.mass_noise * float(self._rng.standard_normal()))

    def map_error(self, position: float) -> float:
        """Return the gradient of the map minus the true one [per mille, + uphill in increasing position]."""
        place = min(max((position - self._map_start) / MAP_STEP_M, 0.0), len(self._map) - 1.0)
        i = min(int(place), len(self._map) - 2)
        return self._map[i] + (place - i) * (self._map[i + 1] - self._map[i])

    def _slip_speed(self, force_per_weight: float) -> float:
        """Return the speed error of the wheel [m/s]: > 0 for slip in traction, < 0 for slide in braking, else 0."""
        low, high = _SLIP_DURATION_S
        self._slip_left_s -= self._dt
        self._running_count += 1
        if abs(force_per_weight) < _LOWEST_ADHESION or force_per_weight * self._slip < 0.0:
            self._slip = self._slip_left_s = 0.0
        if abs(force_per_weight) < _LOWEST_ADHESION:
            return 0.0
        self._forced_count += 1
        if self._slip_left_s <= 0.0:
            self._slip = 0.0
            # The share refers to the entire running time, so it is larger in the time with force.
            share = min(_MAX_SLIP_SHARE, self.model.slip_share * self._running_count / self._forced_count)
            # Bursts end at a sample, on average half a sample late.
            starts = share / (1.0 - share) * self._dt / (0.5 * (low + high + self._dt))
            if float(self._rng.random()) < starts:
                self._slip_left_s = float(self._rng.uniform(low, high))
                size = float(self._rng.uniform(0.15, 1.0)) * self.model.slip_speed
                self._slip = math.copysign(size, force_per_weight)
        return self._slip

    def _stamp(self, stamp_ns: int) -> int:
        jitter = round(self.model.stamp_jitter * NS_PER_S * float(self._rng.standard_normal()))
        return stamp_ns + max(-MAX_JITTER_NS, min(MAX_JITTER_NS, jitter))

    def _lost(self) -> bool:
        return float(self._rng.random()) < self.model.dropout


def quantise(speed: float, model: SensorModel) -> float:
    """Round a speed [m/s] to the resolution of the sensor."""
    quantum = model.speed_quantum
    return round(speed / quantum) * quantum if quantum > 0.0 else speed


def ar1_path(count: int, std: float, rho: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a stationary AR(1) sequence, shape (count,), with correlation rho between adjacent values."""
    noise = rng.standard_normal(count)
    path = np.empty(count)
    value = float(noise[0])
    noise_std = math.sqrt(1.0 - rho * rho)
    for i in range(count):
        value = value if i == 0 else rho * value + noise_std * float(noise[i])
        path[i] = std * value
    return path
