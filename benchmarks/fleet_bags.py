# SPDX-License-Identifier: Apache-2.0
"""Simulated fleets: each train has errors of its own, each day its weather, and some trains break."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.sim.plant import GustModel
from trainid_ros.sim.scenario import Scenario, SensorModel, Simulation, simulate
from trainid_ros.sim.worlds import WORLDS, world_train
from trainid_ros.train.train_file import Davis, Effect, TrainFile

WORLD: Final = WORLDS['metro']
FAULTS: Final = ('dragging_brake', 'worn_pads', 'wheel_diameter', 'wrong_weighing')
DAY_S: Final = 86_400
FIRST_DAY_S: Final = 1_767_225_600  # 2026-01-01
_MAP_STD, _GUST_STD = 0.3, 0.2


@dataclass(frozen=True, slots=True)
class FleetTrain:
    """What is true of one train of the fleet, and not in the train file; ratios true over stated."""

    number: int
    mass_ratio: float
    force_ratio: float
    force_delay: float
    wheel_ratio: float
    brake_delay: float
    brake_ratio: float
    davis_ratios: tuple[float, float]


@dataclass(frozen=True, slots=True)
class FleetDay:
    """What all trains meet on one day: ratios of a, c and the brake rate, headwind [m/s]."""

    number: int
    a_ratio: float = 1.0
    c_ratio: float = 1.0
    brake_ratio: float = 1.0
    headwind: float = 0.0
    is_wet: bool = False


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a train from a day on: one of FAULTS, and how much of its usual range, from 0 to 1."""

    kind: str
    size: float
    onset: int


def stated_train() -> TrainFile:
    """Return the train file of the whole fleet."""
    file = world_train(WORLD)
    return replace(
        file,
        train=replace(file.train, mass_std=0.03, force_std=0.02),
        brake=replace(file.brake, timing_std=0.2),
        line=replace(file.line, gradient_std=_MAP_STD),
    )


def draw_train(seed: int, number: int) -> FleetTrain:
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
    seed: int, train: FleetTrain, day: FleetDay, fault: Fault | None = None, runs: int = 6, run: int = 0
) -> Simulation:
    """Simulate one drive of a train; a fault acts if it is given."""
    rng = np.random.default_rng((seed, 3, train.number, day.number, run))
    true, wheel_ratio = _true_train(seed, train, day, fault)
    sensors = SensorModel(
        speed_quantum=0.2 / 3.6,
        wheel_ratio=wheel_ratio,
        force_delay=train.force_delay,
    )
    scenario = Scenario(
        train_file=true,
        runs=runs,
        passengers=WORLD.passengers,
        sensors=sensors,
        driver=WORLD.driver,
        gust=GustModel(_GUST_STD),
        start_ns=(FIRST_DAY_S + day.number * DAY_S + 6 * 3600 + 1800 * run) * NS_PER_S,
        stated=stated_train(),
    )
    return simulate(scenario, rng)


def _true_train(seed: int, train: FleetTrain, day: FleetDay, fault: Fault | None) -> tuple[TrainFile, float]:
    """Return the true train and the ratio of measured to true speed."""
    file, mass, wheel = stated_train(), train.mass_ratio, train.wheel_ratio
    rate = train.brake_ratio * day.brake_ratio
    effects = [*file.effects, Effect('headwind', (('speed', day.headwind),))]
    if fault is not None:
        match fault.kind:
            case 'dragging_brake':
                effects.append(Effect(fault.kind, (('permille', 1.0 + 2.0 * fault.size), ('time', 40.0))))
            case 'worn_pads':
                rate *= 0.94 - 0.09 * fault.size
            case 'wheel_diameter':
                wheel *= 1.012 + 0.018 * fault.size
            case 'wrong_weighing':
                mass *= 1.05 + 0.07 * fault.size
    effects += [
        Effect('mass_error', (('ratio', mass),)),
        Effect('traction_scale', (('ratio', train.force_ratio),)),
        Effect('brake_scale', (('ratio', rate),)),
    ]
    davis, (a, c) = file.resistance, train.davis_ratios
    true = replace(
        file,
        resistance=Davis(davis.a * a * day.a_ratio, davis.b, davis.c * c * day.c_ratio),
        brake=replace(file.brake, delay=max(0.0, file.brake.delay + train.brake_delay)),
        line=replace(file.line, gradient=_true_gradient(seed, file)),
        effects=tuple(effects),
    )
    return true, wheel


def _true_gradient(seed: int, file: TrainFile) -> tuple[tuple[float, float], ...]:
    """Return the gradients of the line: those of the map and its errors, the same on each day."""
    errors = np.random.default_rng((seed, 4)).standard_normal(len(file.line.gradient))
    pairs = zip(file.line.gradient, errors.tolist(), strict=True)
    return tuple((at, permille + _MAP_STD * error) for (at, permille), error in pairs)
