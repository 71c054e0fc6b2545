# SPDX-License-Identifier: Apache-2.0
"""What the train's sensors make of the truth: noise, resolution, drift, map errors, lost messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from trainid_ros.core.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    SpeedRecord,
)
from trainid_ros.core.settings import check_settings, setting
from trainid_ros.sim.gusts import ar1_path
from trainid_ros.train.davis import G

MAP_STEP_M: Final = 10.0
MOST_JITTER_NS: Final = 4_000_000
_SLIP_DURATION_S: Final = (0.6, 2.0)
_SLIPPERY: Final = 10.0
"""The poorest rails bear 1 % of the weight: a wheel that has to carry over less does not slip [N/kN]."""
_MOST_SLIPPING: Final = 0.9
"""Largest share of the time under force in which wheels slip."""


@dataclass(frozen=True, slots=True)
class SensorModel:
    """How good the sensors are."""

    speed_noise: float = setting(0.02, 'standard deviation of the speed noise', 'm/s', 0.0, 10.0)
    speed_quantum: float = setting(0.1 / 3.6, 'resolution of the speed', 'm/s', 0.0, 10.0)
    force_noise: float = setting(0.3, 'standard deviation of the force noise, per weight', 'N/kN', 0.0, 100.0)
    force_noise_relative: float = setting(0.003, 'further force noise as a share of the force', '', 0.0, 1.0)
    wheel_ratio: float = setting(1.0, 'measured over true speed', '', 0.5, 2.0)
    position_drift: float = setting(0.03, 'random walk of the odometry between stops', 'm/sqrt(s)', 0.0, 10.0)
    map_error: float = setting(0.2, 'standard deviation of the map error', 'per mille', 0.0, 50.0)
    map_error_length: float = setting(200.0, 'correlation length of the map error', 'm', 1.0, 1e5)
    mass_noise: float = setting(0.002, 'relative error of each load weighing', '', 0.0, 0.5)
    dropout: float = setting(0.0, 'probability that a message is lost', '', 0.0, 1.0)
    stamp_jitter: float = setting(0.0005, 'standard deviation of the stamps, cut at 4 ms', 's', 0.0, 0.004)
    force_delay: float = setting(0.0, 'how much later than the force its stamps are', 's', -1.5, 1.5)
    slip_share: float = setting(0.0, 'share of the running time with wheel slip or slide', '', 0.0, 0.5)
    slip_speed: float = setting(3.0, 'greatest speed error in slip or slide', 'm/s', 0.0, 10.0)


class Sensors:
    """Makes records of true values; a lost message is None."""

    def __init__(self, model: SensorModel, dt: float, extent: tuple[float, float], rng: np.random.Generator) -> None:
        """Draw the errors that stay for the whole simulation.

        Args:
            model: How good the sensors are.
            dt: Time between two speed measurements [s].
            extent: Lowest and highest position of the line [m].
            rng: Source of randomness, owned from here on.

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
        self._running = self._forced = 0

    def speed(self, stamp_ns: int, speed: float, position: float, pull: float) -> SpeedRecord | None:
        """Measure speed and position; ``pull`` is the force per weight [N/kN]: what makes wheels slip, either way.

        A standing wheel gives no pulses: it is measured as exactly zero, and the platform corrects the
        position.
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
            slip = self._slip_speed(pull) if model.slip_share > 0.0 else 0.0
            measured = max(0.0, quantise(model.wheel_ratio * speed + slip + model.speed_noise * noise, model))
        stamp = self._stamp(stamp_ns)
        if self._lost():
            return None
        return SpeedRecord(stamp, measured, position + self._position_error)

    def force(self, stamp_ns: int, force: float, mass: float) -> ForceRecord | None:
        """Measure the wheel-rim force."""
        white, relative = self._rng.standard_normal(2).tolist()
        noise = self.model.force_noise * mass * G / 1000.0 * white
        noise += self.model.force_noise_relative * abs(force) * relative
        stamp = self._stamp(stamp_ns) + round(self.model.force_delay * NS_PER_S)
        return None if self._lost() else ForceRecord(stamp, force + noise)

    def gradient(
        self, stamp_ns: int, gradient: float, position: float, direction: int, *, radius: float, tunnel: bool
    ) -> GradientRecord | None:
        """Look up the track in the map, whose error is the same at each passage."""
        felt = gradient + direction * self.map_error(position)
        stamp = self._stamp(stamp_ns)
        return None if self._lost() else GradientRecord(stamp, felt, radius, tunnel)

    def brake(self, stamp_ns: int, target_acceleration: float) -> BrakeRecord | None:
        """Pass a command on; commands are no measurements and carry neither noise nor jitter."""
        return None if self._lost() else BrakeRecord(stamp_ns, target_acceleration, emergency=False)

    def mass(self, stamp_ns: int, weighed: float) -> MassRecord | None:
        """Pass on what the last load weighing gave."""
        return None if self._lost() else MassRecord(stamp_ns, weighed)

    def weigh(self, mass: float) -> float:
        """Weigh the load; the result stands until the doors open again [kg]."""
        return mass * (1.0 + self.model.mass_noise * float(self._rng.standard_normal()))

    def map_error(self, position: float) -> float:
        """Return what the map's gradient exceeds the true one by, in rising position [per mille]."""
        place = min(max((position - self._map_start) / MAP_STEP_M, 0.0), len(self._map) - 1.0)
        i = min(int(place), len(self._map) - 2)
        return self._map[i] + (place - i) * (self._map[i + 1] - self._map[i])

    def _slip_speed(self, pull: float) -> float:
        """Return what the wheel turns too fast [m/s]: it slips when pulling, slides when braking, else rolls."""
        low, high = _SLIP_DURATION_S
        self._slip_left_s -= self._dt
        self._running += 1
        if abs(pull) < _SLIPPERY or pull * self._slip < 0.0:
            self._slip = self._slip_left_s = 0.0
        if abs(pull) < _SLIPPERY:
            return 0.0
        self._forced += 1
        if self._slip_left_s <= 0.0:
            self._slip = 0.0
            # The share is one of all the time, so it is larger while there is force.
            share = min(_MOST_SLIPPING, self.model.slip_share * self._running / self._forced)
            # Bursts end with a sample, half of one late in the mean.
            starts = share / (1.0 - share) * self._dt / (0.5 * (low + high + self._dt))
            if float(self._rng.random()) < starts:
                self._slip_left_s = float(self._rng.uniform(low, high))
                self._slip = math.copysign(float(self._rng.uniform(0.15, 1.0)) * self.model.slip_speed, pull)
        return self._slip

    def _stamp(self, stamp_ns: int) -> int:
        jitter = round(self.model.stamp_jitter * NS_PER_S * float(self._rng.standard_normal()))
        return stamp_ns + max(-MOST_JITTER_NS, min(MOST_JITTER_NS, jitter))

    def _lost(self) -> bool:
        return float(self._rng.random()) < self.model.dropout


def quantise(speed: float, model: SensorModel) -> float:
    """Return a speed rounded to the resolution of the sensor [m/s]."""
    quantum = model.speed_quantum
    return round(speed / quantum) * quantum if quantum > 0.0 else speed
