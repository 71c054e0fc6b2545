# SPDX-License-Identifier: Apache-2.0
"""Simulated fleets: each train has errors of its own on all days, each day its weather, and some trains break."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import DAY_NS, NS_PER_S
from trainid_ros.sim.scenario import SensorModel, Simulation, simulate
from trainid_ros.sim.worlds import Unknowns, World, case_of, stated_train
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import Effect, TrainFile

FIRST_DAY_S: Final = 1_767_225_600
"""Time of the first day [s], 2026-01-01."""
# What the train files of all trains state, and what is the same on all trains.
_USUAL: Final = Unknowns(
    mass_std=0.03, force_std=0.02, map_std=0.3, gust_std=0.2, speed_quantum=0.2 / 3.6, brake_timing_std=0.2
)


class Fleet(NamedTuple):
    """What all trains of a fleet have in common."""

    world: World  # Type of railway
    file: TrainFile  # Train file of all trains
    seed: int  # Of the random numbers


class FleetTrain(NamedTuple):
    """What is true of one train of the fleet on all days."""

    number: int  # Its number
    unknowns: Unknowns  # Errors of its train file
    brake_ratio: float  # True over stated brake rate [1]


@dataclass(frozen=True, slots=True)
class FleetDay:
    """What all trains meet on one day: factors on a, c and the brake rate [1], and a headwind [m/s]."""

    number: int
    a_ratio: float = 1.0
    c_ratio: float = 1.0
    brake_ratio: float = 1.0
    headwind: float = 0.0
    is_wet: bool = False


class Fault(NamedTuple):
    """What is wrong with a train from a day on."""

    train: str  # Name of the train
    effects: tuple[Effect, ...]  # What is wrong, mostly one
    day: int  # First day with it, from 0


def train_name(number: int) -> str:
    """Return the name of a train."""
    return f'T{number:02d}'


def parse_fault(text: str, trains: int, days: int) -> Fault:
    """Parse ``TRAIN:EFFECT:key=value:DAY``, such as ``T03:wheel_diameter:ratio=1.02:8``; days count from 1.

    InputError if the form, the train, the effect or the day is wrong; a step needs a day before it.
    """
    train, _, rest = text.partition(':')
    effect, _, day = rest.rpartition(':')
    if not (train and effect and day.isdecimal()):
        raise InputError(f'fault {text!r} must have the form TRAIN:EFFECT:key=value:DAY')
    if train not in map(train_name, range(1, trains + 1)):
        raise InputError(f'fault {text!r}: the trains are {train_name(1)} to {train_name(trains)}')
    if not 2 <= int(day) <= days:
        raise InputError(f'fault {text!r}: day {day} is outside 2 to {days}; before it, the train must be healthy')
    return Fault(train, parse_effects([effect]), int(day) - 1)


def fleet_train(file: TrainFile) -> TrainFile:
    """Return the train file of a fleet, with the standard deviations of what differs from train to train."""
    return stated_train(file, _USUAL)


def draw_train(seed: int, number: int) -> FleetTrain:
    """Draw a train: the same seed and number give the same one."""
    rng = np.random.default_rng((seed, 1, number))
    mass, force, rate = (1.0 + std * float(np.clip(rng.standard_normal(), -2, 2)) for std in (0.02, 0.01, 0.03))
    delay, wheel, dead = rng.uniform(0.0, 0.2), rng.uniform(-0.005, 0.005), rng.uniform(-0.2, 0.2)
    a, c = 1.0 + rng.uniform(-0.1, 0.1, 2)
    own = replace(
        _USUAL, mass_ratio=mass, force_ratio=force, force_delay=float(delay), wheel_ratio=1.0 + float(wheel),
        brake_delay_error=float(dead), davis_ratios=(float(a), 1.0, float(c)),
    )  # fmt: skip
    return FleetTrain(number, own, rate)


def draw_day(seed: int, number: int) -> FleetDay:
    """Draw a day: temperature and air density; on one in five rain makes the rails wet for all trains."""
    rng = np.random.default_rng((seed, 2, number))
    warm, air, wind, rain = rng.standard_normal(4)
    is_wet = bool(rng.random() < 0.2)
    wet = 0.1 + 0.03 * float(rain) if is_wet else 0.0
    return FleetDay(
        number, 1.0 + 0.03 * float(warm) + wet, 1.0 + 0.03 * float(air), 1.0 - 0.3 * wet, 2.0 * float(wind), is_wet
    )


def drive(
    fleet: Fleet, train: FleetTrain, day: FleetDay, faults: Iterable[Effect] = (), runs: int = 4, number: int = 0
) -> Simulation:
    """Simulate a drive of a train, the given number of that day, with a number of runs from stop to stop."""
    rng = np.random.default_rng((fleet.seed, 3, train.number, day.number, number))
    a, b, c = train.unknowns.davis_ratios
    unknowns = replace(train.unknowns, davis_ratios=(a * day.a_ratio, b, c * day.c_ratio))
    scenario = case_of(fleet.world, fleet.file, unknowns, runs).scenario
    weather = (
        Effect('headwind', (('speed', day.headwind),)),
        Effect('brake_scale', (('ratio', train.brake_ratio * day.brake_ratio),)),
    )
    true = scenario.train_file
    # The map is wrong by the same on each day; what it is read wrong by is drawn anew.
    errors = np.random.default_rng((fleet.seed, 4)).standard_normal(len(true.line.gradient)).tolist()
    pairs = zip(true.line.gradient, errors, strict=True)
    line = replace(true.line, gradient=tuple((x, permille + _USUAL.map_std * error) for (x, permille), error in pairs))
    scenario = replace(
        scenario,
        train_file=replace(true, line=line, effects=_together((*true.effects, *weather, *faults))),
        sensors=replace(scenario.sensors, map_error=SensorModel().map_error),
        start_ns=(FIRST_DAY_S + 6 * 3600 + 1800 * number) * NS_PER_S + day.number * DAY_NS,
    )
    return simulate(scenario, rng)


def _together(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects with those that are a ratio alone multiplied by name."""
    found: dict[object, Effect] = {}
    for effect in effects:
        (name, value), *more = effect.parameters
        key = (effect.name, len(found)) if more or name != 'ratio' else effect.name
        ratio = value * found[key].parameters[0][1] if key in found else value
        found[key] = replace(effect, parameters=((name, ratio), *more))
    return tuple(found.values())
