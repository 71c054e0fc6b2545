# SPDX-License-Identifier: Apache-2.0
"""Simulated fleets: each train has errors of its own on all days, each day its weather, and some trains break."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.sim.plant import GustModel
from trainid_ros.sim.scenario import Scenario, SensorModel, Simulation, simulate
from trainid_ros.sim.worlds import World
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import Davis, Effect, TrainFile

DAY_S: Final = 86_400
FIRST_DAY_S: Final = 1_767_225_600
"""Time of the first day [s], 2026-01-01."""
_MAP_STD, _GUST_STD = 0.3, 0.2  # of the gradients in the map [per mille], and of gusts [N/kN]


@dataclass(frozen=True, slots=True)
class Fleet:
    """What all trains of a fleet have in common."""

    world: World  # Type of railway
    stated: TrainFile  # Train file of all trains
    seed: int  # Of the random numbers


@dataclass(frozen=True, slots=True)
class FleetTrain:
    """What is true of one train of the fleet, and not in the train file; ratios are true over stated [1]."""

    number: int  # Its number
    mass_ratio: float  # Of the mass
    force_ratio: float  # Of the force
    force_delay: float  # Delay of the stamps of the force [s]
    wheel_ratio: float  # Measured over true speed [1]
    brake_delay: float  # True minus stated dead time of the brake [s]
    brake_ratio: float  # Of the brake rate
    davis_ratios: tuple[float, float]  # Of a and c


@dataclass(frozen=True, slots=True)
class FleetDay:
    """What all trains meet on one day."""

    number: int  # Its number, from 0
    a_ratio: float = 1.0  # Factor on a [1]
    c_ratio: float = 1.0  # Factor on c [1]
    brake_ratio: float = 1.0  # Factor on the brake rate [1]
    headwind: float = 0.0  # Wind against rising position [m/s]
    is_wet: bool = False  # Whether it rains


@dataclass(frozen=True, slots=True)
class Fault:
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
    return replace(
        file,
        train=replace(file.train, mass_std=0.03, force_std=0.02),
        brake=replace(file.brake, timing_std=0.2),
        line=replace(file.line, gradient_std=_MAP_STD),
    )


def draw_train(seed: int, number: int) -> FleetTrain:
    """Draw a train: the same seed and number give the same one."""
    rng = np.random.default_rng((seed, 1, number))
    mass, force, rate = (1.0 + std * float(np.clip(rng.standard_normal(), -2, 2)) for std in (0.02, 0.01, 0.03))
    delay, wheel, dead = rng.uniform(0.0, 0.2), rng.uniform(-0.005, 0.005), rng.uniform(-0.2, 0.2)
    a, c = 1.0 + rng.uniform(-0.1, 0.1, 2)
    return FleetTrain(number, mass, force, float(delay), 1.0 + float(wheel), float(dead), rate, (float(a), float(c)))


def draw_day(seed: int, number: int, *, wet_share: float = 0.2) -> FleetDay:
    """Draw a day: temperature and air density; rain makes the rails wet for all trains."""
    rng = np.random.default_rng((seed, 2, number))
    warm, air, wind, rain = rng.standard_normal(4)
    is_wet = bool(rng.random() < wet_share)
    wet = 0.1 + 0.03 * float(rain) if is_wet else 0.0
    return FleetDay(
        number, 1.0 + 0.03 * float(warm) + wet, 1.0 + 0.03 * float(air), 1.0 - 0.3 * wet, 2.0 * float(wind), is_wet
    )


def drive(
    fleet: Fleet, train: FleetTrain, day: FleetDay, faults: Iterable[Effect] = (), runs: int = 4, number: int = 0
) -> Simulation:
    """Simulate a drive of a train, the given number of that day, with a number of runs from stop to stop."""
    rng = np.random.default_rng((fleet.seed, 3, train.number, day.number, number))
    scenario = Scenario(
        train_file=_true_train(fleet, train, day, faults),
        runs=runs,
        passengers=fleet.world.passengers,
        sensors=SensorModel(
            speed_quantum=0.2 / 3.6, wheel_ratio=train.wheel_ratio, force_delay=train.force_delay
        ),
        driver=fleet.world.driver,
        gust=GustModel(_GUST_STD),
        start_ns=(FIRST_DAY_S + day.number * DAY_S + 6 * 3600 + 1800 * number) * NS_PER_S,
        stated=fleet.stated,
    )  # fmt: skip
    return simulate(scenario, rng)


def _true_train(fleet: Fleet, train: FleetTrain, day: FleetDay, faults: Iterable[Effect]) -> TrainFile:
    file = fleet.stated
    own = (
        Effect('headwind', (('speed', day.headwind),)),
        Effect('mass_error', (('ratio', train.mass_ratio),)),
        Effect('traction_scale', (('ratio', train.force_ratio),)),
        Effect('brake_scale', (('ratio', train.brake_ratio * day.brake_ratio),)),
    )
    davis, (a, c) = file.resistance, train.davis_ratios
    return replace(
        file,
        resistance=Davis(davis.a * a * day.a_ratio, davis.b, davis.c * c * day.c_ratio),
        brake=replace(file.brake, delay=max(0.0, file.brake.delay + train.brake_delay)),
        line=replace(file.line, gradient=_true_gradient(fleet.seed, file)),
        effects=_together((*file.effects, *own, *faults)),
    )


def _together(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects with those that are a ratio alone multiplied by name."""
    found: dict[object, Effect] = {}
    for effect in effects:
        is_ratio = [name for name, _ in effect.parameters] == ['ratio']
        key = effect.name if is_ratio else (effect.name, len(found))
        if key in found:
            ratio = effect.parameters[0][1] * found[key].parameters[0][1]
            effect = replace(effect, parameters=(('ratio', ratio),))  # noqa: PLW2901
        found[key] = effect
    return tuple(found.values())


def _true_gradient(seed: int, file: TrainFile) -> tuple[tuple[float, float], ...]:
    """Return the gradients of the line: those of the map and its errors, the same on each day."""
    errors = np.random.default_rng((seed, 4)).standard_normal(len(file.line.gradient))
    pairs = zip(file.line.gradient, errors.tolist(), strict=True)
    return tuple((at, permille + _MAP_STD * error) for (at, permille), error in pairs)
