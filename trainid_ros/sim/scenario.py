# SPDX-License-Identifier: Apache-2.0
"""Simulate a day on the line: runs, changes of the train during the day, and the records of its sensors.

The sensor models add noise, resolution, drift, map errors, stamp errors and lost messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import accumulate
from operator import attrgetter
from typing import Any, Final, Protocol

import numpy as np

from trainid_ros.interface.errors import InputError, check_settings, setting
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.sim.plant import STEP_NS, TICK_S, Decision, Driver, DriverModel, Gust, GustModel, Plant, StopEvent
from trainid_ros.sim.truth import Truth
from trainid_ros.train.effects import check_effects, effect_value
from trainid_ros.train.forces import G, specific_force
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import Davis, TrainFile

MAP_STEP_M: Final = 10.0
"""Distance between two values of the map error [m]."""
MAX_JITTER_NS: Final = 4_000_000
"""Maximum error of a stamp [ns]: topics keep their order, since they are measured a step of 20 ms apart."""
_MIN_ADHESION: Final = 10.0
"""Minimum adhesion, 1 % of the weight: a wheel that transmits less force does not slip [N/kN]."""


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
    """Turn true values into records; a lost message is None. A setting out of range raises InputError.

    ``dt`` is the time between two speed measurements [s], ``extent`` are the ends of the line [m].
    """

    def __init__(self, model: SensorModel, dt: float, extent: tuple[float, float], rng: np.random.Generator) -> None:
        check_settings(model)
        self.model, self._dt, self._rng, self._map_start = model, dt, rng, extent[0]
        count = max(2, math.ceil((extent[1] - extent[0]) / MAP_STEP_M) + 1)
        rho = math.exp(-MAP_STEP_M / model.map_error_length)
        # A stationary AR(1) sequence with correlation rho between adjacent values.
        (first, *rest), noise_std = rng.standard_normal(count).tolist(), math.sqrt(1.0 - rho * rho)
        path = accumulate(rest, lambda value, noise: rho * value + noise_std * noise, initial=first)
        self._map: list[float] = [model.map_error * value for value in path]
        self._position_error, self._last_position = 0.0, math.nan
        self._slip = self._slip_left_s = 0.0
        self._running_count = self._forced_count = 0

    def speed(self, stamp_ns: int, speed: float, position: float, force_per_weight: float) -> SpeedRecord | None:
        """Measure speed [m/s] and position [m]; ``force_per_weight`` [N/kN] causes wheel slip (> 0) or slide (< 0).

        A stationary wheel gives no pulses: the speed is exactly zero, and the position is corrected at the platform.
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
            measured, quantum = model.wheel_ratio * speed + slip + model.speed_noise * noise, model.speed_quantum
            measured = max(0.0, round(measured / quantum) * quantum if quantum > 0.0 else measured)
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
        """Read the gradient [per mille, + uphill in the direction of travel], radius [m] and tunnel from the map."""
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
        low, high = 0.6, 2.0  # duration of a burst [s]
        self._slip_left_s -= self._dt
        self._running_count += 1
        if abs(force_per_weight) < _MIN_ADHESION or force_per_weight * self._slip < 0.0:
            self._slip = self._slip_left_s = 0.0
        if abs(force_per_weight) < _MIN_ADHESION:
            return 0.0
        self._forced_count += 1
        if self._slip_left_s <= 0.0:
            self._slip = 0.0
            # The share refers to the entire running time, so it is larger in the time with force.
            share = min(0.9, self.model.slip_share * self._running_count / self._forced_count)
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


DEFAULT_START_NS: Final = 1_700_000_000 * NS_PER_S
"""Stamp of time zero [ns], 2023-11-14 22:13:20 UTC."""
TICK_NS: Final = round(TICK_S * NS_PER_S)
"""Time between two messages of a topic [ns]."""
MAX_RUN_S: Final = 3600.0
"""Maximum duration of a run from stop to stop [s]: what takes longer cannot be driven."""


@dataclass(frozen=True, slots=True)
class Change:
    """From a time on [s since the start] a new resistance, a new brake rate [1], or both."""

    time_s: float
    resistance: Davis | None = None
    brake_rate: float | None = None


@dataclass(frozen=True, slots=True)
class Scenario:
    """Definition of a simulation."""

    train_file: TrainFile  # The true train, line and effects
    runs: int = 4  # Number of runs from stop to stop; the train turns at the ends of the line
    changes: tuple[Change, ...] = ()  # Changes during the day, in increasing time
    passengers: float = 0.15  # Maximum load as a share of the mass [1]; each stop draws a load from 0 to this
    sensors: SensorModel = field(default_factory=SensorModel)  # Errors of the sensors
    driver: DriverModel = field(default_factory=DriverModel)  # Parameters of the driver
    gust: GustModel = field(default_factory=GustModel)  # Random gust resistance
    start_ns: int = DEFAULT_START_NS  # Stamp of time zero [ns], > 0
    stated: TrainFile | None = None  # The train as assumed by the driver; None for the true train


@dataclass(frozen=True, slots=True)
class Simulation:
    """Records in the order of their stamps, the true values, the arrivals and the duration [s]."""

    records: tuple[Record, ...]
    truth: Truth
    arrivals: tuple[StopEvent, ...]
    duration_s: float


class TrainDriver(Protocol):
    """Who drives: a driver model, or a controller that sees the records of the sensors."""

    arrivals: list[StopEvent]  # Stops so far
    stop: float  # Stop that it drives to [m]

    def observe(self, record: Record) -> None:
        """Take in what a sensor has measured."""

    def may_depart(self, time_s: float) -> bool:
        """Return whether the dwell is over at a time [s]."""

    def depart(self, stop: float) -> None:
        """Depart for the next stop [m]."""

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Return the demands until the next tick."""


MakeDriver = Callable[[Plant, np.random.Generator], TrainDriver]


def simulate(scenario: Scenario, rng: np.random.Generator, make_driver: MakeDriver | None = None) -> Simulation:
    """Simulate a scenario; the same scenario and generator state give the same records.

    Driving, gusts, sensors and passengers draw from separate generators, so other sensors do not change the driving.
    ``make_driver`` makes who drives, if it is not the driver of the scenario. InputError, naming the field, if the
    scenario cannot be driven.
    """
    check_scenario(scenario)
    return _Day(scenario, rng, make_driver).drive()


def check_scenario(scenario: Scenario) -> None:
    """Raise InputError, naming the field, if a scenario cannot be simulated."""
    stops = scenario.train_file.line.stops
    if len(stops) < 2:
        raise InputError(f'line.stops has {len(stops)} stops; the simulator drives between at least 2')
    if scenario.runs < 1:
        raise InputError(f'runs = {scenario.runs} must be >= 1')
    if scenario.start_ns <= 0:
        raise InputError(f'start_ns = {scenario.start_ns} must be > 0: a zero stamp is not a valid time')
    if not 0.0 <= scenario.passengers <= 2.0:
        raise InputError(f'passengers = {scenario.passengers:g} is outside [0, 2] of the mass')
    times = [change.time_s for change in scenario.changes]
    if times != sorted(times):
        raise InputError('changes: their times must increase')
    for change in scenario.changes:
        if change.brake_rate is not None and not change.brake_rate > 0.0:
            raise InputError(f'changes: brake rate = {change.brake_rate:g} at {change.time_s:g} s must be > 0')
    check_effects(scenario.train_file.effects)


class _Day:
    """State of a running simulation."""

    def __init__(self, scenario: Scenario, rng: np.random.Generator, make_driver: MakeDriver | None) -> None:
        drive, gust, sense, self._load = rng.spawn(4)
        file = scenario.train_file
        self._scenario, self._effects, length = scenario, file.effects, file.train.length
        self._profile = profile_of(file)
        self._plant = Plant(file, self._profile, scenario.start_ns, scenario.driver.jerk)
        self._driver: TrainDriver
        if make_driver is None:
            self._driver = Driver(scenario.driver, scenario.stated or file, self._profile, drive)
        else:
            self._driver = make_driver(self._plant, drive)
        self._gust = Gust(scenario.gust, TICK_S, gust)
        extent = (file.line.stops[0] - length, file.line.stops[-1] + length)
        self._sensors = Sensors(self._sensor_model(), TICK_S, extent, sense)
        self._records: list[Record] = []
        self._resistance: list[tuple[float, float, float, float]] = []
        self._brake_rate: list[tuple[float, float]] = []
        self._rate_ratio = effect_value(self._effects, 'brake_scale', 'ratio', 1.0)
        if scenario.stated is not None:
            # The brake produces a force, so a train heavier than stated decelerates less.
            mass_ratios = [effect_value(f.effects, 'mass_error', 'ratio', 1.0) for f in (file, scenario.stated)]
            self._rate_ratio *= mass_ratios[1] / mass_ratios[0]
        steps = (dict(e.parameters) for e in self._effects if e.name == 'resistance_step')
        self._steps = tuple((step['time'], step['a']) for step in steps)
        # The initial values, all changes, and an empty change where an effect changes the true values.
        first = Change(0.0, file.resistance, file.brake.rate)
        changes = (first, *scenario.changes, *(Change(time_s) for time_s, _ in self._steps))
        self._pending = sorted(changes, key=attrgetter('time_s'))
        self._weighed, self._departed_s = file.train.mass, 0.0

    def drive(self) -> Simulation:
        """Simulate all runs and a final dwell."""
        self._board()
        tick = 0
        while not self._is_over(time_s := tick * TICK_NS / NS_PER_S):
            self._change(time_s)
            if self._driver.may_depart(time_s):
                self._depart(time_s)
            self._tick(tick, time_s)
            tick += 1
        records = sorted(self._records, key=attrgetter('stamp_ns'))
        truth = Truth(self._scenario.start_ns, tuple(self._resistance), tuple(self._brake_rate))
        return Simulation(tuple(records), truth, tuple(self._driver.arrivals), tick * TICK_NS / NS_PER_S)

    def _is_over(self, time_s: float) -> bool:
        if time_s - self._departed_s > MAX_RUN_S:
            raise InputError(
                f'the train does not reach stop {self._driver.stop:g} m within {MAX_RUN_S:g} s: '
                'check train.max_traction_force, line.gradient'
            )
        done = len(self._driver.arrivals) >= self._scenario.runs
        return done and self._driver.may_depart(time_s)

    def _tick(self, tick: int, time_s: float) -> None:
        plant, sensors = self._plant, self._sensors
        plant.gust = self._gust.step()
        decision = self._driver.decide(time_s, plant)
        plant.command(decision.brake)
        self._record(sensors.brake(plant.now_ns, decision.brake))
        if tick % 5 == 0:  # once a second
            self._record(sensors.mass(plant.now_ns, self._weighed))
        # Topics have different stamps, as on a train: each is measured some steps after the tick.
        for step in range(1, TICK_NS // STEP_NS + 1):
            plant.step(decision.traction)
            if step == 5:
                at, line = (plant.position, plant.direction), self._profile
                gradient, radius, tunnel = line.gradient(*at), line.curve_radius(*at), line.tunnel(*at)
                self._record(sensors.gradient(plant.now_ns, gradient, *at, radius=radius, tunnel=tunnel))
            elif step == 7:
                self._record(sensors.force(plant.now_ns, plant.reported_force, plant.mass))
            elif step == 8:
                force_per_weight = specific_force(plant.reported_force, plant.mass)
                self._record(sensors.speed(plant.now_ns, plant.speed, plant.position, force_per_weight))

    def _record(self, record: Record | None) -> None:
        """Keep what was measured, None if the message is lost, and show it to the driver."""
        if record is not None:
            self._records.append(record)
            self._driver.observe(record)

    def _depart(self, time_s: float) -> None:
        plant = self._plant
        stop = self._profile.next_stop(plant.position, plant.direction)
        if stop is None:
            # The train reverses in the tail track and departs from the same position with its other end in front.
            plant.direction = -plant.direction
            stop = self._profile.next_stop(plant.position, plant.direction)
        if stop is None:
            raise InputError(f'line.stops: no other stop from {plant.position:g} m')
        self._departed_s = time_s
        self._board()
        self._driver.depart(stop)

    def _board(self) -> None:
        load = float(self._load.uniform(0.0, 1.0)) * self._scenario.passengers
        self._plant.mass = self._scenario.train_file.train.mass * (1.0 + load)
        self._weighed = self._sensors.weigh(self._plant.mass)

    def _change(self, time_s: float) -> None:
        """Apply all changes due by now and record the true values."""
        while self._pending and self._pending[0].time_s <= time_s:
            change = self._pending.pop(0)
            self._plant.resistance = change.resistance or self._plant.resistance
            if change.brake_rate is not None:
                self._plant.brake_rate = change.brake_rate
                _append(self._brake_rate, (time_s, change.brake_rate * self._rate_ratio))
            davis = self._plant.resistance
            stepped = davis.a + sum(a for at, a in self._steps if at <= time_s)
            _append(self._resistance, (time_s, stepped, davis.b, davis.c))

    def _sensor_model(self) -> SensorModel:
        model = self._scenario.sensors
        return replace(
            model,
            wheel_ratio=model.wheel_ratio * effect_value(self._effects, 'wheel_diameter', 'ratio', 1.0),
            force_delay=model.force_delay + effect_value(self._effects, 'stamp_skew', 'delay', 0.0),
            slip_share=effect_value(self._effects, 'wheel_slip', 'share', model.slip_share),
            slip_speed=effect_value(self._effects, 'wheel_slip', 'speed', model.slip_speed),
        )


def _append(rows: list[Any], row: tuple[float, ...]) -> None:
    """Append a row of true values; omit one without a change, replace one with the same time."""
    if rows and rows[-1][1:] == row[1:]:
        return
    if rows and rows[-1][0] == row[0]:
        rows.pop()
    rows.append(row)
