# SPDX-License-Identifier: Apache-2.0
"""Motion of a train from stop to stop, in steps of 20 ms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.worlds.driving import TICK, Driver, Sight
from benchmarks.worlds.vehicles import G

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.worlds.conditions import BrakeRate, Coefficients, Resistance
    from benchmarks.worlds.driving import Habits
    from benchmarks.worlds.tracks import Way
    from benchmarks.worlds.unknowns import Errors
    from benchmarks.worlds.vehicles import Vehicle

STEP: Final = 0.02
STEPS_PER_TICK: Final = round(TICK / STEP)
# Brake command at a stop [m/s^2].
HOLD: Final = 0.4
# Traction is locked until the brake has released to this deceleration [m/s^2].
RELEASED: Final = 0.03


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
    """The true motion every 20 ms.

    Attributes:
        time: Time [s].
        way: Way of the front in the direction of travel [m].
        direction: Index of the way in the plan.
        speed: Speed [m/s].
        force: Tractive effort [N].
        command: Brake command [m/s^2, >= 0].
        nominal: Deceleration of a nominal brake after dead time and lag [m/s^2].
        rate: True brake rate [1].
        leg: Number of the run between stops.
        stops: Way of each stop minus that of its stopping point [m].

    """

    time: NDArray[np.float64]
    way: NDArray[np.float64]
    direction: NDArray[np.int64]
    speed: NDArray[np.float64]
    force: NDArray[np.float64]
    command: NDArray[np.float64]
    nominal: NDArray[np.float64]
    rate: NDArray[np.float64]
    leg: NDArray[np.int64]
    stops: tuple[float, ...]


class Motion:
    """State of the moving train, integrated in steps of 20 ms."""

    def __init__(self, plan: Plan) -> None:
        vehicle, errors = plan.vehicle, plan.errors
        self.plan = plan
        self.tick = 0
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
        a, b, c = self.plan.resistance.at(self.time)
        before = self.speed
        self._steps(way, (a + self.plan.gusts[self.tick], b, c), self.plan.masses[leg], effort, command)
        self.acceleration = (self.speed - before) / TICK
        self.ticks.append((self.plan.ways.index(way), leg))
        self.tick += 1

    def _steps(self, way: Way, davis: Coefficients, mass: float, effort: float, command: float) -> None:
        a, b, c = davis
        base = self.plan.brake_rate.at(self.time)
        per_newton = 1000.0 / (mass * G)
        inertia = G / 1000.0 / (1.0 + self.plan.vehicle.kind.rotary_mass)
        slope, offset = way.slope, way.offset + 0.5
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
    """Stand with the brake applied."""
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
