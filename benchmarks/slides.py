# SPDX-License-Identifier: Apache-2.0
"""Drives on rails with patches of low adhesion: sliding wheels, wheel slide protection, and what the axle shows.

Between wheel and rail a train transmits at most the adhesion of the place times its weight. What the brake asks for
beyond that makes the measured axle run away from the train, until the wheel slide protection lets it come back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from trainid_ros.interface.records import Record, SpeedRecord
from trainid_ros.sim.plant import TICK_S, Decision, Driver, Plant
from trainid_ros.sim.scenario import Scenario, Simulation, TrainDriver, simulate
from trainid_ros.train.forces import G
from trainid_ros.train.line import LineProfile

_AXLE: Final = 4.0
"""Acceleration of an axle that runs away or comes back [m/s^2]."""


@dataclass(frozen=True, slots=True)
class Patch:
    """Low adhesion on a part of the line."""

    start: float  # Where it begins [m]
    end: float  # Where it ends [m]
    adhesion: float  # Adhesion there, over the weight of the train [1]


@dataclass(frozen=True, slots=True)
class Moment:
    """The truth at one tick."""

    stamp_ns: int  # Time [ns]
    speed: float  # Speed of the train [m/s]
    axle: float  # Speed of the axle [m/s]
    adhesion: float  # Adhesion at the place [1], infinite outside of patches
    train: Plant  # A copy of the train


class SlidingDriver:
    """The driver of a scenario on rails with patches of low adhesion."""

    def __init__(self, driver: TrainDriver, plant: Plant, patches: Sequence[Patch], rng: np.random.Generator) -> None:
        self._driver, self._plant, self._patches, self._rng = driver, plant, patches, rng
        self._rate, self._slip, self._target, self._returns = plant.brake_rate, 0.0, 0.0, False
        self.moments: list[Moment] = []
        self.arrivals, self.stop = driver.arrivals, driver.stop

    def observe(self, record: Record) -> None:
        self._driver.observe(record)

    def may_depart(self, time_s: float) -> bool:
        return self._driver.may_depart(time_s)

    def depart(self, stop: float) -> None:
        self._driver.depart(stop)
        self.stop = stop

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Limit the brake by the adhesion, and let the axle run away where that is less."""
        adhesion = adhesion_at(self._patches, train.position)
        is_sliding = limit_brake(train, self._rate, adhesion)
        if not is_sliding or train.speed < 1.0:
            self._target, self._returns = 0.0, True
        elif self._target == 0.0 or (self._slip >= self._target and not self._returns):
            self._returns = self._target > 0.0
            self._target = self._target or float(self._rng.uniform(0.08, 0.25)) * train.speed
        elif self._returns and self._slip < 0.3 * self._target:
            self._target, self._returns = float(self._rng.uniform(0.08, 0.25)) * train.speed, False
        step = _AXLE * TICK_S
        self._slip = max(0.0, self._slip - step) if self._returns else min(self._target, self._slip + step)
        self._slip = min(self._slip, train.speed)
        self.moments.append(Moment(train.now_ns, train.speed, train.speed - self._slip, adhesion, train.twin()))
        return self._driver.decide(time_s, train)


def adhesion_at(patches: Sequence[Patch], position: float) -> float:
    """Return the adhesion at a position [m]; infinite outside of patches."""
    return min((patch.adhesion for patch in patches if patch.start <= position < patch.end), default=np.inf)


def limit_brake(train: Plant, rate: float, adhesion: float) -> bool:
    """Limit the brake rate of a train by the adhesion; return whether that is less than what the brake asks for."""
    most = adhesion * G / (1.0 + train._train.rotary_mass)
    asked = -rate * train._brake.shape_at(train.speed) * train.brake
    train.brake_rate = rate if asked <= most else rate * most / asked
    return asked > most


@dataclass(frozen=True, slots=True)
class SlideDrive:
    """A drive with what its axle showed, and the truth."""

    records: tuple[Record, ...]
    moments: tuple[Moment, ...]
    simulation: Simulation


def drive_with_slides(scenario: Scenario, patches: Sequence[Patch], rng: np.random.Generator) -> SlideDrive:
    """Drive a scenario over patches of low adhesion; the axle's speed and distance take the place of the train's."""
    made: list[SlidingDriver] = []
    slides = rng.spawn(1)[0]

    def make(plant: Plant, drive: np.random.Generator) -> TrainDriver:
        file = scenario.train_file
        driver = Driver(scenario.driver, scenario.stated or file, LineProfile(file.line, file.train.length), drive)
        made.append(SlidingDriver(driver, plant, patches, slides))
        return made[0]

    simulation = simulate(scenario, rng, make)
    moments = made[0].moments
    stamps = np.array([moment.stamp_ns for moment in moments], dtype=np.float64)
    lag = np.array([moment.speed - moment.axle for moment in moments])
    records: list[Record] = []
    lost_m, before_ns = 0.0, 0
    for record in simulation.records:
        if isinstance(record, SpeedRecord):
            slip = float(np.interp(record.stamp_ns, stamps, lag))
            lost_m = lost_m + slip * (record.stamp_ns - before_ns) * 1e-9 if before_ns else 0.0
            before_ns = record.stamp_ns
            if record.speed == 0.0:
                lost_m = 0.0
            record = replace(record, speed=max(0.0, record.speed - slip), position=record.position - lost_m)  # noqa: PLW2901
        records.append(record)
    return SlideDrive(tuple(records), tuple(moments), simulation)


def leaf_season(scenario: Scenario, rng: np.random.Generator, share: float = 0.3) -> tuple[Patch, ...]:
    """Return patches before a share of the stops, with the length of a braking and the adhesion of wet leaves."""
    patches = []
    for stop in scenario.train_file.line.stops:
        if rng.random() < share:
            length, ahead = float(rng.uniform(100.0, 400.0)), float(rng.uniform(0.0, 100.0))
            for side in (-1.0, 1.0):
                ends = sorted((stop + side * ahead, stop + side * (ahead + length)))
                patches.append(Patch(ends[0], ends[1], float(rng.uniform(0.03, 0.07))))
    return tuple(patches)
