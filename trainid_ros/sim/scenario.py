# SPDX-License-Identifier: Apache-2.0
"""Simulation of a day on the line: runs, changes of the train during the day, and the resulting records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Final, Protocol, TypeVar

import numpy as np

from trainid_ros.errors import InputError
from trainid_ros.records import NS_PER_S, Record
from trainid_ros.sim.driver import TICK_S, Decision, Driver, DriverModel, StopEvent
from trainid_ros.sim.plant import STEP_NS, Gust, GustModel, Plant
from trainid_ros.sim.sensors import SensorModel, Sensors
from trainid_ros.sim.truth import Truth
from trainid_ros.train.davis import specific_force
from trainid_ros.train.effects import check_effects, effect_value
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Davis, TrainFile

DEFAULT_START_NS: Final = 1_700_000_000 * NS_PER_S
TICK_NS: Final = round(TICK_S * NS_PER_S)
MAX_RUN_S: Final = 3600.0
_MASS_EVERY: Final = 5
# Steps after a tick at which each topic is measured: topics have different stamps, as on a train.
_GRADIENT_STEP, _FORCE_STEP, _SPEED_STEP = 5, 7, 8


@dataclass(frozen=True, slots=True)
class Change:
    """From a time on [s since the start] a new resistance, a new brake rate [1], or both."""

    time_s: float
    resistance: Davis | None = None
    brake_rate: float | None = None


@dataclass(frozen=True, slots=True)
class Scenario:
    """Definition of a simulation.

    Attributes:
        train_file: The true train, line and effects.
        runs: Number of runs from stop to stop; the train turns at the ends of the line.
        changes: Changes during the day, in increasing time.
        passengers: Maximum load as a share of the mass [1]; each stop draws a load from 0 to this.
        sensors: Errors of the sensors.
        driver: Parameters of the driver.
        gust: Random gust resistance.
        start_ns: Stamp of time zero [ns], > 0.
        stated: The train as assumed by the driver; None for the true train.

    """

    train_file: TrainFile
    runs: int = 4
    changes: tuple[Change, ...] = ()
    passengers: float = 0.15
    sensors: SensorModel = field(default_factory=SensorModel)
    driver: DriverModel = field(default_factory=DriverModel)
    gust: GustModel = field(default_factory=GustModel)
    start_ns: int = DEFAULT_START_NS
    stated: TrainFile | None = None


@dataclass(frozen=True, slots=True)
class Simulation:
    """Records in the order of their stamps, the true values, the arrivals and the duration [s]."""

    records: tuple[Record, ...]
    truth: Truth
    arrivals: tuple[StopEvent, ...]
    duration_s: float


class TrainDriver(Protocol):
    """Who drives: a driver model, or a controller that sees the records of the sensors."""

    @property
    def arrivals(self) -> list[StopEvent]:
        """Stops so far."""

    @property
    def stop(self) -> float:
        """Stop that it drives to [m]."""

    def observe(self, record: Record) -> None:
        """Take in what a sensor has measured."""

    def may_depart(self, time_s: float) -> bool:
        """Return whether the dwell is over at a time [s]."""

    def depart(self, stop: float) -> None:
        """Depart for the next stop [m]."""

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Return the demands until the next tick."""


def simulate(
    scenario: Scenario,
    rng: np.random.Generator,
    make_driver: Callable[[Plant, np.random.Generator], TrainDriver] | None = None,
) -> Simulation:
    """Simulate a scenario; the same scenario and generator state give the same records.

    Driving, gusts, sensors and passengers draw from separate generators, so other sensors do not
    change the driving.

    Args:
        scenario: What to simulate.
        rng: Random generator.
        make_driver: Makes who drives; None for the driver of the scenario.

    Raises:
        InputError: The scenario cannot be driven; the message names the field.

    """
    check_scenario(scenario)
    return _Day(scenario, rng, make_driver).drive()


def check_scenario(scenario: Scenario) -> None:
    """Raise InputError, naming the field, if a scenario cannot be simulated."""
    stops = scenario.train_file.line.stops
    if len(stops) < 2:
        msg = f'line.stops has {len(stops)} stops; the simulator drives between at least 2'
        raise InputError(msg)
    if scenario.runs < 1:
        msg = f'runs = {scenario.runs} must be >= 1'
        raise InputError(msg)
    if scenario.start_ns <= 0:
        msg = f'start_ns = {scenario.start_ns} must be > 0: a zero stamp is not a valid time'
        raise InputError(msg)
    if not 0.0 <= scenario.passengers <= 2.0:
        msg = f'passengers = {scenario.passengers:g} is outside [0, 2] of the mass'
        raise InputError(msg)
    times = [change.time_s for change in scenario.changes]
    if times != sorted(times):
        msg = 'changes: their times must increase'
        raise InputError(msg)
    for change in scenario.changes:
        if change.brake_rate is not None and not change.brake_rate > 0.0:
            where = f'at {change.time_s:g} s'
            msg = f'changes: brake rate = {change.brake_rate:g} {where} must be > 0'
            raise InputError(msg)
    check_effects(scenario.train_file.effects)


class _Day:
    """State of a running simulation."""

    def __init__(
        self,
        scenario: Scenario,
        rng: np.random.Generator,
        make_driver: Callable[[Plant, np.random.Generator], TrainDriver] | None,
    ) -> None:
        drive, gust, sense, self._load = rng.spawn(4)
        file = scenario.train_file
        self._scenario = scenario
        self._effects = file.effects
        self._profile = LineProfile(file.line, file.train.length)
        self._plant = Plant(file, self._profile, scenario.start_ns, scenario.driver.jerk)
        self._driver: TrainDriver
        if make_driver is None:
            self._driver = Driver(scenario.driver, scenario.stated or file, self._profile, drive)
        else:
            self._driver = make_driver(self._plant, drive)
        self._gust = Gust(scenario.gust, TICK_S, gust)
        length = file.train.length
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
        self._pending = self._all_changes()
        self._weighed = file.train.mass
        self._departed_s = 0.0

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
            where = f'stop {self._driver.stop:g} m within {MAX_RUN_S:g} s'
            msg = f'the train does not reach {where}: check train.max_traction_force, line.gradient'
            raise InputError(msg)
        done = len(self._driver.arrivals) >= self._scenario.runs
        return done and self._driver.may_depart(time_s)

    def _tick(self, tick: int, time_s: float) -> None:
        plant, sensors = self._plant, self._sensors
        plant.gust = self._gust.step()
        decision = self._driver.decide(time_s, plant)
        plant.command(decision.brake)
        self._record(sensors.brake(plant.now_ns, decision.brake))
        if tick % _MASS_EVERY == 0:
            self._record(sensors.mass(plant.now_ns, self._weighed))
        for step in range(1, TICK_NS // STEP_NS + 1):
            plant.step(decision.traction)
            if step == _GRADIENT_STEP:
                self._record(self._gradient())
            elif step == _FORCE_STEP:
                self._record(sensors.force(plant.now_ns, plant.reported_force, plant.mass))
            elif step == _SPEED_STEP:
                force_per_weight = specific_force(plant.reported_force, plant.mass)
                self._record(sensors.speed(plant.now_ns, plant.speed, plant.position, force_per_weight))

    def _record(self, record: Record | None) -> None:
        """Keep what was measured, None if the message is lost, and show it to the driver."""
        if record is not None:
            self._records.append(record)
            self._driver.observe(record)

    def _gradient(self) -> Record | None:
        at, direction = self._plant.position, self._plant.direction
        return self._sensors.gradient(
            self._plant.now_ns,
            self._profile.gradient(at, direction),
            at,
            direction,
            radius=self._profile.curve_radius(at, direction),
            tunnel=self._profile.tunnel(at, direction),
        )

    def _depart(self, time_s: float) -> None:
        plant = self._plant
        stop = self._profile.next_stop(plant.position, plant.direction)
        if stop is None:
            # The train reverses in the tail track and departs from the same position with its other end in front.
            plant.direction = -plant.direction
            stop = self._profile.next_stop(plant.position, plant.direction)
        if stop is None:
            msg = f'line.stops: no other stop from {plant.position:g} m'
            raise InputError(msg)
        self._departed_s = time_s
        self._board()
        self._driver.depart(stop)

    def _board(self) -> None:
        load = float(self._load.uniform(0.0, 1.0)) * self._scenario.passengers
        self._plant.mass = self._scenario.train_file.train.mass * (1.0 + load)
        self._weighed = self._sensors.weigh(self._plant.mass)

    def _all_changes(self) -> list[Change]:
        """Return the initial values, all changes, and an empty change where an effect changes the true values."""
        file = self._scenario.train_file
        first = Change(0.0, file.resistance, file.brake.rate)
        steps = [Change(time_s) for time_s, _ in self._steps]
        return sorted((first, *self._scenario.changes, *steps), key=attrgetter('time_s'))

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
        ratio = effect_value(self._effects, 'wheel_diameter', 'ratio', 1.0)
        return replace(
            model,
            wheel_ratio=model.wheel_ratio * ratio,
            force_delay=model.force_delay + effect_value(self._effects, 'stamp_skew', 'delay', 0.0),
            slip_share=effect_value(self._effects, 'wheel_slip', 'share', model.slip_share),
            slip_speed=effect_value(self._effects, 'wheel_slip', 'speed', model.slip_speed),
        )


_Row = TypeVar('_Row', tuple[float, float], tuple[float, float, float, float])


def _append(rows: list[_Row], row: _Row) -> None:
    """Append a row of true values; omit one without a change, replace one with the same time."""
    if rows and rows[-1][1:] == row[1:]:
        return
    if rows and rows[-1][0] == row[0]:
        rows.pop()
    rows.append(row)
