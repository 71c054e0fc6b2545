# SPDX-License-Identifier: Apache-2.0
"""The driver: accelerates, holds a speed or coasts, and brakes in steps before lower limits and stops."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from benchmarks.worlds.vehicles import G

if TYPE_CHECKING:
    import numpy as np

    from benchmarks.worlds.tracks import Way
    from benchmarks.worlds.vehicles import Vehicle

TICK: Final = 0.2


@dataclass(frozen=True, slots=True)
class Habits:
    """How trains of a world are driven.

    Attributes:
        plan: Deceleration at which braking begins [m/s^2].
        level: Step of the brake command [m/s^2].
        patience: Least time between changes of the brake command [s].
        kinds: How speed is held, equally likely: ``pi`` by PI control, ``band`` by alternating power and coasting,
            ``coast`` by one long coasting.
        band: Width of the speed band of ``band`` [m/s].
        coast: Last part of the distance to a stop that may be coasted [m].
        fill: Cruising speed as a share of the limit.
        power: Traction levels as shares of the greatest effort.
        sway: Standard deviation of slow changes of the cruising speed [m/s].
        dwell: Time at a stop [s].
        tolerance: Distance short of the stop that is accepted [m].

    """

    plan: tuple[float, float]
    level: float
    patience: float
    kinds: tuple[str, ...]
    band: tuple[float, float]
    coast: tuple[float, float]
    fill: tuple[float, float]
    power: tuple[float, float]
    sway: float
    dwell: tuple[float, float]
    tolerance: float


HABITS: Final = {
    'metro': Habits((0.45, 0.75), 0.1, 0.8, ('pi', 'band', 'coast'), (1.5, 4.0), (100.0, 600.0), (0.88, 0.97),
                    (0.5, 1.0), 0.2, (20.0, 30.0), 12.0),
    'emu': Habits((0.4, 0.7), 0.1, 1.0, ('pi', 'band', 'coast'), (1.5, 4.5), (300.0, 2500.0), (0.88, 0.98),
                  (0.4, 1.0), 0.3, (25.0, 45.0), 20.0),
    'high_speed': Habits((0.3, 0.5), 0.1, 1.5, ('pi', 'pi', 'band', 'coast'), (2.0, 5.0), (3000.0, 14000.0),
                         (0.93, 0.99), (0.5, 1.0), 0.5, (90.0, 150.0), 40.0),
    'freight': Habits((0.10, 0.17), 0.05, 6.0, ('pi', 'band', 'band', 'coast'), (1.5, 4.0), (500.0, 3000.0),
                      (0.88, 0.97), (0.5, 1.0), 0.3, (90.0, 180.0), 90.0),
    'tram': Habits((0.6, 0.95), 0.15, 0.6, ('pi', 'band', 'coast'), (1.0, 3.0), (30.0, 150.0), (0.85, 0.98),
                   (0.4, 1.0), 0.2, (15.0, 25.0), 8.0),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Sight:
    """Input of the driver: time [s], way [m], speed [m/s], acceleration and brake deceleration [m/s^2]."""

    time: float
    way: float
    speed: float
    acceleration: float
    braking: float


class Driver:
    """Sets tractive effort [N] and brake command [m/s^2, >= 0] five times per second."""

    def __init__(self, vehicle: Vehicle, habits: Habits, rng: np.random.Generator) -> None:
        self._vehicle = vehicle
        self._habits = habits
        self._rng = rng
        self._lead = vehicle.brake_delay + 0.8 * vehicle.brake_lag
        self._limits: tuple[tuple[float, float], ...] = ()
        self._starts: list[float] = []

    def start(self, way: Way, stop: float, mass: float, time: float) -> None:
        """Begin the run to the stop at way ``stop`` [m] with a new random driving style; mass [kg], time [s]."""
        habits, rng = self._habits, self._rng
        self._limits, self._starts = way.limits, [start for start, _ in way.limits]
        self._stop, self._mass = stop, mass
        self._slope, self._offset = way.slope, way.offset
        self._plan = self._draw(habits.plan)
        self._kind = habits.kinds[int(rng.integers(len(habits.kinds)))]
        self._band, self._fill = self._draw(habits.band), self._draw(habits.fill)
        self._coast_from = self._draw(habits.coast) if rng.uniform() < 0.6 else 0.0
        self._brake, self._brake_since = 0.0, time
        self._mode, self._integral, self._sway = 'power', 0.0, 0.0
        self._redraw_at = time

    def act(self, sight: Sight) -> tuple[float, float]:
        """Return tractive effort [N] and brake command [m/s^2]."""
        here = max(bisect_right(self._starts, sight.way) - 1, 0)
        limit = self._limits[here][1]
        if sight.time >= self._redraw_at:
            self._level = self._draw(self._habits.power)
            self._sway = self._habits.sway * float(self._rng.normal())
            self._redraw_at = sight.time + float(self._rng.uniform(8.0, 25.0)) * (2.0 if self._kind == 'pi' else 1.0)
        target = max(min(self._fill * limit + self._sway, limit - 0.3), 2.0)
        need, stopping = self._need(sight, here, limit, target)
        self._set_brake(sight, need, stopping, target)
        if self._brake > 0.0:
            self._mode, self._integral = 'coast', 0.0
            return 0.0, self._brake
        return self._effort(sight, target), 0.0

    def _need(self, sight: Sight, here: int, limit: float, target: float) -> tuple[float, bool]:
        """Return the largest deceleration needed for stop and limits [m/s^2], and whether the stop needs it."""
        lead, speed = self._lead, sight.speed
        # Position at which a new command takes effect, with the present command until then.
        other = -sight.acceleration - sight.braking if self._brake > 0.0 else 0.0
        slowing = other + 0.5 * (sight.braking + self._brake) if self._brake > 0.0 else 0.0
        then = max(speed - slowing * lead, 0.0)
        at = sight.way + 0.5 * (speed + then) * lead
        need, stopping = then * then / (2.0 * max(self._stop - at, 0.5)), True
        reach = at + then * then / self._plan
        for i in range(here + 1, len(self._limits)):
            start, lower = self._limits[i]
            if start > reach:
                break
            aim = self._fill * lower
            if aim < then:
                value = (then * then - aim * aim) / (2.0 * max(start - at, 3.0))
                if value > need:
                    need, stopping = value, False
        if speed > limit + 0.2 or (self._brake > 0.0 and speed > target):
            hold = min(0.1 + 0.1 * (speed - target), 1.0) * min(self._plan / 0.5, 1.0) * 2.0
            if hold > need:
                need, stopping = hold, False
        return need, stopping

    def _set_brake(self, sight: Sight, need: float, stopping: bool, target: float) -> None:
        level = self._habits.level
        if self._brake <= 0.0:
            # The driver knows the gradient: downhill, braking begins earlier and harder.
            grade = self._slope[int(sight.way + self._offset)] * G / 1000.0
            if need > max(self._plan + min(grade, 0.0), 0.3 * self._plan) or sight.speed > target + 2.0:
                self._command(sight, max(need, 0.5 * self._plan) - grade)
            return
        if sight.time - self._brake_since < self._habits.patience:
            return
        released = not stopping and sight.speed < target - 0.3 and need < 0.3 * self._plan
        if released or (stopping and need < 0.4 * self._plan and sight.speed > 3.0):
            self._brake, self._brake_since = 0.0, sight.time
            return
        # Below 0.6 m/s the command stays unchanged if it stops the train.
        if sight.speed < 0.6 and sight.acceleration < -0.1 * self._plan:
            return
        command = max(need, 0.3 * self._plan) + sight.acceleration + sight.braking
        if abs(command - self._brake) > 0.7 * level:
            self._command(sight, command)

    def _command(self, sight: Sight, value: float) -> None:
        level = self._habits.level
        steps = min(max(round(value / level), 1), int(self._vehicle.kind.brake_max / level))
        self._brake, self._brake_since = steps * level, sight.time

    def _effort(self, sight: Sight, target: float) -> float:
        speed, vehicle = sight.speed, self._vehicle
        most = min(vehicle.max_force, vehicle.max_power / max(speed, 1.0))
        to_go = self._stop - sight.way
        if self._coast_from > to_go and speed > 0.6 * target and speed * speed > 0.3 * to_go * self._plan:
            self._mode = 'coast'
            return 0.0
        low = {'pi': 0.6, 'band': self._band, 'coast': 0.28 * target}[self._kind]
        if speed < target - low:
            self._mode = 'power'
        elif speed >= target - 0.1 and self._mode == 'power':
            self._mode = 'hold' if self._kind == 'pi' else 'coast'
            self._integral = 0.0
        elif speed > target + 0.8:
            self._mode = 'coast'
        if self._mode == 'hold':
            error = target - speed
            self._integral += 0.02 * error * TICK
            return min(max(self._mass * (0.15 * error + self._integral), 0.0), most)
        # Slow trains get at least 90 % power, so that none stalls on a gradient.
        level = self._level if speed > 0.6 * target else max(self._level, 0.9)
        return level * most if self._mode == 'power' else 0.0

    def _draw(self, limits: tuple[float, float]) -> float:
        return float(self._rng.uniform(*limits))
