# SPDX-License-Identifier: Apache-2.0
"""Motion of a train from stop to stop, in steps of 20 ms, and its driver.

The driver accelerates, holds a speed or coasts, and brakes in steps before lower limits and stops.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.tracks import Way
from benchmarks.worlds.unknowns import BrakeRate, Coefficients, Errors, G, Resistance, Vehicle

TICK: Final = 0.2
STEP: Final = 0.02
STEPS_PER_TICK: Final = round(TICK / STEP)
# Brake command at a stop [m/s^2].
HOLD: Final = 0.4
# Traction is locked until the brake has released to this deceleration [m/s^2].
RELEASED: Final = 0.03


@dataclass(frozen=True, slots=True)
class Habits:
    """How trains of a world are driven."""

    plan: tuple[float, float]  # Deceleration at which braking begins [m/s^2]
    level: float  # Step of the brake command [m/s^2]
    patience: float  # Least time between changes of the brake command [s]
    kinds: tuple[str, ...]  # How speed is held, equally likely: PI control, power and coasting in turn, one coasting
    band: tuple[float, float]  # Width of the speed band of ``band`` [m/s]
    coast: tuple[float, float]  # Last part of the distance to a stop that may be coasted [m]
    fill: tuple[float, float]  # Cruising speed as a share of the limit
    power: tuple[float, float]  # Traction levels as shares of the greatest effort
    sway: float  # Standard deviation of slow changes of the cruising speed [m/s]
    dwell: tuple[float, float]  # Time at a stop [s]
    tolerance: float  # Distance short of the stop that is accepted [m]


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


@dataclass(frozen=True, slots=True)
class Plan:
    """Inputs of a drive: train, ways in both directions, conditions and drawn loads."""

    vehicle: Vehicle
    habits: Habits
    ways: tuple[Way, Way]
    first: int
    start: int
    resistance: Resistance
    brake_rate: BrakeRate
    gusts: list[float]
    masses: list[float]
    errors: Errors
    duration: float


@dataclass(frozen=True, slots=True)
class Log:
    time: NDArray[np.float64]  # Time [s]
    way: NDArray[np.float64]  # Way of the front in the direction of travel [m]
    direction: NDArray[np.int64]  # Index of the way in the plan
    speed: NDArray[np.float64]  # Speed [m/s]
    force: NDArray[np.float64]  # Tractive effort [N]
    command: NDArray[np.float64]  # Brake command [m/s^2, >= 0]
    nominal: NDArray[np.float64]  # Deceleration of a nominal brake after dead time and lag [m/s^2]
    rate: NDArray[np.float64]  # True brake rate [1]
    leg: NDArray[np.int64]  # Number of the run between stops
    stops: tuple[float, ...]  # Way of each stop minus that of its stopping point [m]


class Motion:
    """State of the moving train, integrated in steps of 20 ms."""

    def __init__(self, plan: Plan) -> None:
        vehicle, errors = plan.vehicle, plan.errors
        self.plan = plan
        self.tick = self.leg = 0
        self.line = plan.ways[plan.first]
        self.way = 0.0
        self.speed = self.force = self.nominal = self.acted = self.acceleration = 0.0
        self.dead_steps = round(vehicle.brake_delay / STEP)
        self.commands = [HOLD] * (self.dead_steps + 1)
        self.brake_gain = 1.0 - math.exp(-STEP / vehicle.brake_lag)
        self.force_gain = 1.0 - math.exp(-STEP / vehicle.kind.traction_lag)
        self.step = errors.brake_step * vehicle.kind.brake_max
        self.rows: list[tuple[float, float, float, float, float]] = []
        self.ticks: list[tuple[int, int]] = []
        self.stops: list[float] = []

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self.tick * TICK

    def advance(self, way: Way, leg: int, effort: float, command: float) -> None:
        """Advance by one tick of the driver with an effort [N] and a brake command [m/s^2]."""
        self.line, self.leg, before = way, leg, self.speed
        self._steps(self.davis(), self.mass(), *self.acts(effort, command))
        self.acceleration = (self.speed - before) / TICK
        self.ticks.append((self.plan.ways.index(way), leg))
        self.tick += 1

    def acts(self, effort: float, command: float) -> tuple[float, float]:
        """Return the effort and the command that are carried out, of those of the driver."""
        return effort, command

    def davis(self) -> Coefficients:
        """Return a, b, c with the gust of this tick [N/kN, v in m/s]."""
        a, b, c = self.plan.resistance.at(self.time)
        return a + self.plan.gusts[self.tick], b, c

    def mass(self) -> float:
        """Return the true mass [kg]."""
        return self.plan.masses[self.leg]

    def _steps(self, davis: Coefficients, mass: float, effort: float, command: float) -> None:
        a, b, c = davis
        base = self.plan.brake_rate.at(self.time)
        per_newton = 1000.0 / (mass * G)
        inertia = G / 1000.0 / (1.0 + self.plan.vehicle.kind.rotary_mass)
        slope, offset = self.line.slope, self.line.offset + 0.5
        x, v, force, nominal, acted = self.way, self.speed, self.force, self.nominal, self.acted
        step, dead, commands, rows = self.step, self.dead_steps, self.commands, self.rows
        brake_gain, force_gain, lasting = self.brake_gain, self.force_gain, 0.5 * STEP
        for _ in range(STEPS_PER_TICK):
            commands.append(command)
            late = commands[-1 - dead]
            rate = base
            if nominal > 1e-4:
                rate = self.rate_at(base, v, nominal, acted)
            rows.append((x, v, force, nominal, rate))
            slowing = rate * nominal
            nominal += (late - nominal) * brake_gain
            if step:
                acted = round(nominal / step) * step
            force += (effort - force) * force_gain
            if v > 0.0 or force > 0.0:
                acceleration = inertia * (force * per_newton - a - (b + c * v) * v - slope[int(x + offset)]) - slowing
                # The train never rolls back; resistance acts in motion only.
                new = max(v + acceleration * STEP, 0.0)
                x += (v + new) * lasting
                v = new
        self.way, self.speed, self.force, self.nominal, self.acted = x, v, force, nominal, acted

    def rate_at(self, base: float, speed: float, nominal: float, acted: float) -> float:
        """Return the true brake rate [1]: falls with speed, dips at blending, and acts in steps."""
        errors = self.plan.errors
        if not errors.brake_speed:
            return base
        share = min(speed / self.plan.vehicle.kind.max_speed, 1.0)
        rate = base * (1.0 + errors.brake_speed * (0.08 - 0.15 * share))
        away = (speed - errors.blend_speed) / 0.5
        if -2.0 < away < 2.0:
            rate *= 1.0 - errors.blend_dip * (1.0 - 0.25 * away * away)
        return rate * acted / nominal if nominal > 0.1 else rate


def simulate(plan: Plan, rng: np.random.Generator, kind: type[Motion] = Motion) -> Log:
    """Drive from stop to stop until the duration is over; the train reverses at the end of the line."""
    motion, driver = kind(plan), Driver(plan.vehicle, plan.habits, rng)
    side, at, leg = plan.first, plan.start, 0
    motion.way = plan.ways[side].stops[at]
    dwell(motion, plan.ways[side], leg, 10.0)
    while motion.time < plan.duration:
        way = plan.ways[side]
        if at == len(way.stops) - 1:
            side, at = 1 - side, 0
            way = plan.ways[side]
            motion.way = way.stops[0] + (plan.ways[1 - side].stops[-1] - motion.way)
        at += 1
        run(motion, driver, way, leg, at)
        leg += 1
        dwell(motion, way, leg, float(rng.uniform(*plan.habits.dwell)))
    return _log(motion)


def run(motion: Motion, driver: Driver, way: Way, leg: int, to: int) -> None:
    """Drive to a stop; a train that halts short of it starts again."""
    stop = way.stops[to]
    driver.start(way, stop, motion.plan.masses[leg], motion.time)
    while True:
        sight = Sight(motion.time, motion.way, motion.speed, motion.acceleration, motion.nominal)
        effort, command = driver.act(sight)
        if motion.nominal > RELEASED:
            effort = 0.0
        moved = motion.speed > 0.0
        motion.advance(way, leg, effort, command)
        if motion.speed == 0.0 and moved:
            if stop - motion.way < motion.plan.habits.tolerance:
                break
            driver.start(way, stop, motion.plan.masses[leg], motion.time)
    motion.stops.append(motion.way - stop)


def dwell(motion: Motion, way: Way, leg: int, duration: float) -> None:
    until = motion.time + duration
    while motion.time < until:
        motion.advance(way, leg, 0.0, HOLD)


def _log(motion: Motion) -> Log:
    rows = np.array(motion.rows)
    ticks = np.repeat(np.array(motion.ticks), STEPS_PER_TICK, axis=0)
    return Log(
        time=np.arange(len(rows), dtype=np.float64) * STEP,
        way=rows[:, 0],
        direction=ticks[:, 0],
        speed=rows[:, 1],
        force=rows[:, 2],
        command=np.array(motion.commands[motion.dead_steps + 1 :]),
        nominal=rows[:, 3],
        rate=rows[:, 4],
        leg=ticks[:, 1],
        stops=tuple(motion.stops),
    )
