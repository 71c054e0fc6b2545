# SPDX-License-Identifier: Apache-2.0
"""Types of railway in the simulator, random errors and omissions of a train file as in field data, and fleets.

Each type has a train on its line, a load and a driver. From a stated train file and a random generator come the true
scenario and the train file that the engineer has: the same values, with the standard deviations of mass, force and
map. Each unknown draws from its own generator, so it has the same values alone and in combination with others.

In a fleet each train has errors of its own on all days, each day its weather, and some trains break.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import shared_path
from trainid_ros.interface.records import DAY_NS, NS_PER_S
from trainid_ros.sim.plant import DriverModel, GustModel
from trainid_ros.sim.scenario import Change, Scenario, SensorModel, Simulation, check_scenario, simulate
from trainid_ros.train.effects import effect_value, parse_effects
from trainid_ros.train.fields import did_you_mean
from trainid_ros.train.train_file import Davis, Effect, NamedValues, TrainFile, load_train_file


@dataclass(frozen=True, slots=True)
class World:
    """A type of railway."""

    train: str  # Name of its train file in ``config/trains``
    passengers: float  # Maximum load as a share of the mass [1]
    driver: DriverModel  # Parameters of the driver
    mean_speed: float  # Typical mean speed from stop to stop, without dwell [m/s]


WORLDS: Final[Mapping[str, World]] = MappingProxyType({
    'metro': World('yizhuang', 0.25, DriverModel(), 14.0),
    'emu': World('emu', 0.15, DriverModel(
        acceleration=0.8, deceleration=0.6, dwell_low=30.0, dwell_high=60.0, cruise_low=15.0, cruise_high=80.0,
    ), 21.0),
    'high_speed': World('high_speed', 0.08, DriverModel(
        acceleration=0.5, deceleration=0.5, max_deceleration=1.0, jerk=0.5,
        dwell_low=60.0, dwell_high=120.0, cruise_low=30.0, cruise_high=200.0,
    ), 37.0),
    # A brake with 7 s of dead time and lag allows only low gains and stops less accurately.
    'freight': World('freight', 0.05, DriverModel(
        acceleration=0.3, deceleration=0.15, max_deceleration=0.6, jerk=0.3,
        dwell_low=60.0, dwell_high=120.0, cruise_low=40.0, cruise_high=200.0, coast_floor=0.85,
        holding=0.4, brake_gain=0.15, brake_integral=0.005, stop_window=4.0,
    ), 16.0),
    'tram': World('tram', 0.3, DriverModel(
        acceleration=1.1, deceleration=0.9, max_deceleration=1.6, jerk=1.2, speed_margin=0.5,
        dwell_low=15.0, dwell_high=30.0, cruise_low=2.0, cruise_high=12.0, coast_floor=0.75,
    ), 7.7),
})  # fmt: skip


def find_world(name: str) -> World:
    """Return a world by its name; raise InputError if there is none."""
    if name not in WORLDS:
        raise InputError(f'world {name!r} is not known; {did_you_mean(name, WORLDS)}')
    return WORLDS[name]


def world_train(world: World) -> TrainFile:
    """Return the train file of a world; raise InputError if it is not part of this installation."""
    return load_train_file(shared_path(f'config/trains/{world.train}.yaml'))


def usual_duration(world: World, stops: tuple[float, ...], runs: int) -> float:
    """Return the approximate duration [s] of a number of runs over these stops [m], including dwell."""
    if len(stops) < 2:
        return 0.0
    there = [after - before for before, after in pairwise(stops)]
    round_trip = [*there, *reversed(there)]
    distance = sum(round_trip[i % len(round_trip)] for i in range(runs))
    return distance / world.mean_speed + runs * 0.5 * (world.driver.dwell_low + world.driver.dwell_high)


_CURVE: Final = 'curve_resistance'


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Differences of truth and records from the train file; the defaults are those of ``clean``. Ratios are in [1]."""

    # Stated relative standard deviation of the mass; that of each weighing if the mass is exact
    mass_std: float = SensorModel().mass_noise
    mass_ratio: float = 1.0  # True over stated (and weighed) mass
    force_std: float = 0.0  # Stated relative standard deviation of the force gain
    force_ratio: float = 1.0  # True over reported traction
    force_delay: float = 0.0  # Delay of the force stamps behind the force [s]
    curve_std: float = 0.0  # Stated relative standard deviation of the curve coefficient
    curve_ratio: float = 1.0  # True over stated curve coefficient
    map_std: float = 0.0  # Standard deviation of the map error [per mille]; stated correctly in the train file
    map_length: float = SensorModel().map_error_length  # Correlation length of the map error [m]
    wheel_ratio: float = 1.0  # Measured over true speed
    gust_std: float = GustModel().std  # Standard deviation of the gusts [N/kN]
    gust_time_constant: float = GustModel().time_constant  # Correlation time of the gusts [s]
    speed_quantum: float = SensorModel().speed_quantum  # Resolution of the speed [m/s]
    brake_timing_std: float = 0.01  # Stated relative standard deviation of dead time and time constant of the brake
    brake_delay_error: float = 0.0  # True minus stated dead time of the brake [s]
    brake_time_ratio: float = 1.0  # True over stated time constant of the brake
    davis_ratios: tuple[float, float, float] = (1.0, 1.0, 1.0)  # True over stated a, b, c
    # Changes during the day: the share of it from which on a and c are multiplied by two ratios, or a brake rate holds
    resistance_changes: tuple[tuple[float, float, float], ...] = ()
    brake_changes: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Case:
    """The true scenario, the train file that the engineer has, and the true values missing from it (SI units)."""

    scenario: Scenario
    stated: TrainFile
    true_values: NamedValues


def make_case(
    world: World,
    file: TrainFile,
    names: Collection[str],
    runs: int,
    rng: np.random.Generator,
    extra: tuple[Effect, ...] = (),
) -> Case:
    """Draw a case of a number of runs from stop to stop, with the unknowns of :func:`unknowns_of`.

    ``file`` is the train as described by an engineer, ``extra`` are further effects of the true train that it lacks.
    InputError, naming it, if an effect already exists, or the scenario cannot be driven.
    """
    return case_of(world, file, draw_unknowns(names, rng), runs, extra)


def case_of(world: World, file: TrainFile, unknowns: Unknowns, runs: int, extra: tuple[Effect, ...] = ()) -> Case:
    """Return the case of known differences from the train file; arguments and errors as of :func:`make_case`."""
    stated, true = stated_train(file, unknowns), true_train(file, unknowns)
    known = {effect.name for effect in true.effects}
    if twice := [effect.name for effect in extra if effect.name in known]:
        source = 'from its train file or from the unknowns drawn'
        raise InputError(f'effect {twice[0]}: the true train has it already, {source}')
    true = replace(true, effects=(*true.effects, *extra))
    duration, start = usual_duration(world, true.line.stops, runs), true.resistance
    changes = [
        Change(share * duration, resistance=replace(start, a=a * start.a, c=c * start.c))
        for share, a, c in unknowns.resistance_changes
    ]
    changes += [Change(share * duration, brake_rate=rate) for share, rate in unknowns.brake_changes]
    scenario = Scenario(
        train_file=true,
        runs=runs,
        changes=tuple(sorted(changes, key=attrgetter('time_s'))),
        passengers=world.passengers,
        sensors=SensorModel(
            speed_quantum=unknowns.speed_quantum,
            wheel_ratio=unknowns.wheel_ratio,
            force_delay=unknowns.force_delay,
            map_error=unknowns.map_std,
            map_error_length=unknowns.map_length,
        ),
        driver=world.driver,
        gust=GustModel(unknowns.gust_std, unknowns.gust_time_constant),
        stated=stated,
    )
    check_scenario(scenario)
    return Case(scenario, stated, _true_values(unknowns, true))


def unknowns_of(realism: str, names: Iterable[str], stated: TrainFile) -> frozenset[str]:
    """Return the unknowns of a realism level and those named in addition.

    InputError if the realism or a name is unknown, or a named unknown does not apply to this train file.
    """
    if realism not in REALISMS:
        raise InputError(f'realism {realism!r} is not known; {did_you_mean(realism, REALISMS)}')
    named = tuple(names)
    for name in named:
        if name not in _DRAWS:
            raise InputError(f'unknown {name!r} is not known; {did_you_mean(name, _DRAWS)}')
    if 'curve' in named and not (stated.line.curve and _curve_coefficient(stated) > 0.0):
        raise InputError(f'unknown curve: the train file has no line.curve or no effect {_CURVE}')
    return REALISMS[realism].union(named)


def draw_unknowns(names: Collection[str], rng: np.random.Generator) -> Unknowns:
    """Draw the named unknowns at random; all others are as in ``clean``."""
    unknowns = Unknowns()
    for (name, draw), generator in zip(_DRAWS.items(), rng.spawn(len(_DRAWS)), strict=True):
        if name in names:
            unknowns = replace(unknowns, **draw(generator))
    return unknowns


def stated_train(file: TrainFile, unknowns: Unknowns) -> TrainFile:
    """Return the train file that the engineer has: as given, with standard deviations of the uncertain values."""
    curve_std = (('coefficient', unknowns.curve_std * _curve_coefficient(file)),)
    return replace(
        file,
        train=replace(file.train, mass_std=unknowns.mass_std, force_std=unknowns.force_std),
        brake=replace(file.brake, timing_std=unknowns.brake_timing_std),
        line=replace(file.line, gradient_std=unknowns.map_std),
        effects=tuple(replace(e, std=curve_std) if e.name == _CURVE else e for e in file.effects),
    )


def true_train(file: TrainFile, unknowns: Unknowns) -> TrainFile:
    """Return the true train; mass and reported force remain as stated, effects represent their errors."""
    effects = [
        replace(effect, parameters=tuple((key, unknowns.curve_ratio * value) for key, value in effect.parameters))
        if effect.name == _CURVE
        else effect
        for effect in file.effects
    ]
    ratios = (('mass_error', unknowns.mass_ratio), ('traction_scale', unknowns.force_ratio))
    effects += [Effect(name, (('ratio', ratio),)) for name, ratio in ratios if ratio != 1.0]
    davis, brake, (a, b, c) = file.resistance, file.brake, unknowns.davis_ratios
    return replace(
        file,
        resistance=Davis(davis.a * a, davis.b * b, davis.c * c),
        brake=replace(
            brake,
            delay=max(0.0, brake.delay + unknowns.brake_delay_error),
            time_constant=brake.time_constant * unknowns.brake_time_ratio,
        ),
        effects=tuple(effects),
    )


def _true_values(unknowns: Unknowns, true: TrainFile) -> NamedValues:
    curve, brake = _curve_coefficient(true), true.brake
    drawn = ('map_std', 'map_length', 'wheel_ratio', 'gust_std', 'gust_time_constant', 'speed_quantum')
    return (
        *((name, getattr(unknowns, name)) for name in ('mass_ratio', 'force_ratio', 'force_delay')),
        *((('curve_coefficient', curve),) if curve > 0.0 else ()),
        *((name, getattr(unknowns, name)) for name in drawn),
        *(('brake_delay', brake.delay), ('brake_time_constant', brake.time_constant)),
    )


def _curve_coefficient(file: TrainFile) -> float:
    return effect_value(file.effects, _CURVE, 'coefficient', 0.0)


def _changes_during_day(rng: np.random.Generator) -> dict[str, Any]:
    resistance = tuple(
        (share, 1.0 + _signed_uniform(0.1, 0.3, rng), 1.0 + _signed_uniform(0.05, 0.2, rng))
        for share in _change_shares(rng)
    )
    brake = tuple((share, 1.0 + _signed_uniform(0.05, 0.2, rng)) for share in _change_shares(rng))
    return {'resistance_changes': resistance, 'brake_changes': brake}


def _ratio(std: float, rng: np.random.Generator) -> float:
    """Return a ratio whose error is within 3 standard deviations, so that it is not negative."""
    return 1.0 + std * min(3.0, max(-3.0, float(rng.standard_normal())))


def _signed_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    size = rng.uniform(low, high)
    return size if rng.random() < 0.5 else -size


def _change_shares(rng: np.random.Generator) -> list[float]:
    """Return one or two shares of the day in increasing order, so that there are data before and after."""
    shares: list[float] = rng.uniform(0.15, 0.85, rng.integers(1, 3)).tolist()
    return sorted(shares)


_DRAWS: Final[Mapping[str, Callable[[np.random.Generator], dict[str, Any]]]] = MappingProxyType(
    {
        'mass': lambda rng: {'mass_std': (std := rng.uniform(0.02, 0.05)), 'mass_ratio': _ratio(std, rng)},
        'force_gain': lambda rng: {'force_std': (std := rng.uniform(0.01, 0.03)), 'force_ratio': _ratio(std, rng)},
        'force_delay': lambda rng: {'force_delay': rng.uniform(0.0, 0.3)},
        'curve': lambda rng: {'curve_std': 0.2, 'curve_ratio': _ratio(0.2, rng)},
        'map': lambda rng: {'map_std': rng.uniform(0.1, 0.5), 'map_length': rng.uniform(100.0, 500.0)},
        'wheels': lambda rng: {'wheel_ratio': 1.0 + rng.uniform(-0.005, 0.005)},
        'gusts': lambda rng: {'gust_std': rng.uniform(0.1, 0.4), 'gust_time_constant': rng.uniform(3.0, 12.0)},
        'quantum': lambda rng: {'speed_quantum': rng.uniform(0.1, 0.5) / 3.6},
        'changes': _changes_during_day,
        'brake': lambda rng: {
            'brake_timing_std': 0.2,
            'brake_delay_error': rng.uniform(-0.3, 0.3),
            'brake_time_ratio': rng.uniform(0.7, 1.3),
        },
        'resistance': lambda rng: {'davis_ratios': tuple((1.0 + rng.uniform(-0.2, 0.2, 3)).tolist())},
    }
)
"""Fields of :class:`Unknowns` that each unknown draws; its place here determines its generator, so append new ones."""
UNKNOWNS: Final = tuple(_DRAWS)
REALISMS: Final[Mapping[str, frozenset[str]]] = MappingProxyType({'clean': frozenset(), 'field': frozenset(UNKNOWNS)})

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
