# SPDX-License-Identifier: Apache-2.0
"""Simulate one drive: records that sensors and controls publish, train file with the assumed parameters, and truth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.motion import HABITS, STEPS_PER_TICK, TICK, Log, Motion, Plan, simulate
from benchmarks.worlds.tracks import Pairs, Track, lay_way, track_of
from benchmarks.worlds.unknowns import (
    FIELD,
    KINDS,
    G,
    draw_brake_rate,
    draw_errors,
    draw_gusts,
    draw_loads,
    draw_resistance,
    draw_vehicle,
    random_of,
)
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord
from trainid_ros.train.train_file import Brake, Davis, Effect, Line, Train, TrainFile

EPOCH_NS: Final = 1_700_000_000_000_000_000
JITTER: Final = 0.5e-3
# Noise of the reported force: shares of the value and of the weight.
FORCE_NOISE: Final = (0.003, 0.0002)
MAP_STEP: Final = 5.0
# Spacing of the gradients in the train file when they have errors [m].
MAP_PIECE: Final = 50.0


@dataclass(frozen=True, slots=True)
class Rates:
    speed: float = 5.0
    force: float = 5.0
    gradient: float = 5.0
    brake: float = 5.0
    mass: float = 1.0


@dataclass(frozen=True, slots=True)
class MapError:
    """Error of the gradients by position [per mille of rising position]."""

    position: NDArray[np.float64]
    error: NDArray[np.float64]

    def at(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error at positions [m] [per mille]."""
        return np.interp(position, self.position, self.error)


def draw_map_error(plan: Plan, world: str, seed: int) -> MapError:
    """Draw the error of the gradients, a first-order Gauss-Markov process in position."""
    errors, way = plan.errors, plan.ways[0]
    rng = random_of(world, seed, 'map along the line')
    count = int(way.gradient.size / MAP_STEP) + 2
    shocks = rng.normal(size=count)
    keep = float(np.exp(-MAP_STEP / errors.map_length))
    out, value = [], float(shocks[0])
    for shock in shocks:
        value = keep * value + float(np.sqrt(1.0 - keep * keep)) * float(shock)
        out.append(value)
    return MapError(
        way.origin - way.offset + MAP_STEP * np.arange(count, dtype=np.float64), errors.map_std * np.array(out)
    )


def draw_weighed(plan: Plan, world: str, seed: int) -> NDArray[np.float64]:
    """Draw the weighed mass of each run [kg]."""
    errors, masses = plan.errors, np.array(plan.masses)
    noise = random_of(world, seed, 'load weighing').normal(size=masses.size)
    return np.asarray(masses * (1.0 + errors.mass) * (1.0 + errors.weighing * noise))


class Sensors:
    """Converts the true motion to records."""

    def __init__(self, plan: Plan, log: Log, weighed: NDArray[np.float64], map_error: MapError) -> None:
        self.plan, self.log, self.weighed, self.map_error = plan, log, weighed, map_error
        ways = plan.ways
        self.position = np.where(log.direction == 0, ways[0].position(log.way), ways[1].position(log.way))

    def speed(self, stamps: NDArray[np.float64], rng: np.random.Generator) -> Iterator[Record]:
        errors, log = self.plan.errors, self.log
        ratio = 1.0 + errors.wheels
        true = np.interp(stamps, log.time, log.speed)
        noisy = true * ratio + errors.speed_noise * rng.normal(size=stamps.size)
        shown = np.where(true > 0.0, np.maximum(np.round(noisy / errors.quantum), 0.0) * errors.quantum, 0.0)
        start = self.position[0]
        position = start + ratio * (np.interp(stamps, log.time, self.position) - start)
        for at, v, s in zip(_ns(stamps), shown.tolist(), np.round(position, 2).tolist(), strict=True):
            yield SpeedRecord(at, v, s)

    def force(self, stamps: NDArray[np.float64], rng: np.random.Generator) -> Iterator[Record]:
        """Yield reported efforts; while braking, that of a nominal brake."""
        plan, log = self.plan, self.log
        inertia = self.weighed[log.leg] * (1.0 + plan.vehicle.kind.rotary_mass)
        reported = log.force / (1.0 + plan.errors.force_gain) - inertia * log.nominal
        value = np.interp(stamps - plan.errors.force_delay, log.time, reported)
        share, of_weight = FORCE_NOISE
        std = np.hypot(share * value, of_weight * plan.vehicle.mass * G)
        value = np.round(value + std * rng.normal(size=stamps.size), 1)
        for at, force in zip(_ns(stamps), value.tolist(), strict=True):
            yield ForceRecord(at, force)

    def gradient(self, stamps: NDArray[np.float64], _: np.random.Generator) -> Iterator[Record]:
        """Yield gradient and curve radius under the train, from the map."""
        plan, log = self.plan, self.log
        at_way = np.interp(stamps, log.time, log.way)
        side = log.direction[self._before(stamps)]
        gradient, curvature = np.empty(stamps.size), np.empty(stamps.size)
        for i, way in enumerate(plan.ways):
            here = side == i
            index, grid = at_way[here] + way.offset, np.arange(way.gradient.size)
            middle = way.position(at_way[here] - 0.5 * plan.vehicle.length)
            gradient[here] = np.interp(index, grid, way.gradient) + way.sign * self.map_error.at(middle)
            curvature[here] = way.curvature[np.round(index).astype(np.int64)]
        radius = np.where(curvature > 0.0, 1.0 / np.maximum(curvature, 1e-6), 0.0)
        for at, slope, r in zip(_ns(stamps), gradient.tolist(), radius.tolist(), strict=True):
            yield GradientRecord(at, slope, r, False)

    def brake(self, stamps: NDArray[np.float64], _: np.random.Generator) -> Iterator[Record]:
        command = self.log.command[self._before(stamps)]
        for at, value in zip(_ns(stamps), command.tolist(), strict=True):
            yield BrakeRecord(at, -round(value, 3) if value > 0.0 else 0.0, False)

    def mass(self, stamps: NDArray[np.float64], _: np.random.Generator) -> Iterator[Record]:
        weighed = self.weighed[self.log.leg[self._before(stamps)]]
        for at, value in zip(_ns(stamps), weighed.tolist(), strict=True):
            yield MassRecord(at, value)

    def _before(self, stamps: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.maximum(np.searchsorted(self.log.time, stamps + 1e-9, side='right') - 1, 0)


def sense(sensors: Sensors, rates: Rates, world: str, seed: int) -> tuple[Record, ...]:
    """Return the records of all topics in order of arrival; freight trains have no load weighing."""
    senders = (
        ('speed', rates.speed, sensors.speed),
        ('force', rates.force, sensors.force),
        ('gradient', rates.gradient, sensors.gradient),
        ('brake', rates.brake, sensors.brake),
        *((('mass', rates.mass, sensors.mass),) if sensors.plan.vehicle.kind.load > 0.0 else ()),
    )
    records: list[Record] = []
    end = float(sensors.log.time[-1])
    for name, rate, sender in senders:
        rng = random_of(world, seed, f'sensor {name}')
        # Commands are sent at once; the other topics have a random phase.
        phase = 1.0e-3 if name == 'brake' else float(rng.uniform(2e-3, 1.0 / rate))
        stamps = np.arange(phase, end - 2.0 * JITTER, 1.0 / rate)
        stamps = stamps + np.clip(JITTER * rng.normal(size=stamps.size), -0.9e-3, 0.9e-3)
        records.extend(sender(stamps, rng))
    records.sort(key=lambda record: record.stamp_ns)
    return tuple(records)


def _ns(stamps: NDArray[np.float64]) -> list[int]:
    ns: list[int] = (EPOCH_NS + np.round(stamps * 1e9).astype(np.int64)).tolist()
    return ns


WORLDS: Final = ('metro', 'emu', 'high_speed', 'freight', 'tram')
DURATIONS: Final = {'metro': 3700.0, 'emu': 3500.0, 'high_speed': 3200.0, 'freight': 3200.0, 'tram': 3900.0}
# Upper limit of the time that the last run needs to reach its stop after the duration is over [s].
SPARE: Final = 7200.0
MAX_RUNS: Final = 200


@dataclass(frozen=True, slots=True)
class Truth:
    """True values on a grid of 0.2 s."""

    time_ns: NDArray[np.int64]  # Stamps of the grid [ns]
    speed: NDArray[np.float64]  # True speed [m/s]
    a: NDArray[np.float64]  # True Davis coefficients [N/kN of the true weight, v the true speed in m/s]
    b: NDArray[np.float64]
    c: NDArray[np.float64]
    mass: NDArray[np.float64]  # True mass [kg]
    brake_rate: NDArray[np.float64]  # True brake deceleration over that of a nominal brake of the same timing [1]
    braking: NDArray[np.bool_]  # The brake acts at more than 0.1 m/s^2
    moving: NDArray[np.bool_]  # The train moves
    traction: NDArray[np.float64]  # True tractive effort [N]
    force_scale: NDArray[np.float64]  # True over reported tractive effort, times reported over true mass [1]
    changes: tuple[float, ...]  # Times of the steps of resistance [s]
    brake_changes: tuple[float, ...]  # Times at which steps and ramps of the brake rate begin [s]
    force_delay: float  # Delay of the reported force relative to its stamp [s]
    brake_delay_error: float  # True minus stated dead time of the brake [s]
    wheel_ratio: float  # Measured over true speed [1]
    gust_std: float  # Standard deviation of the gusts [N/kN]
    gust_time: float  # Their correlation time [s]
    map_std: float  # Standard deviation of the gradient error [per mille]
    map_length: float  # Its correlation length [m]
    stop_errors: tuple[float, ...]  # Distance of each stop beyond its stopping point [m]


def stated_file(
    plan: Plan, track: Track, map_error: MapError, unknowns: Collection[str], world: str, seed: int
) -> TrainFile:
    vehicle, errors = plan.vehicle, plan.errors
    train = Train(
        mass=float(np.mean(plan.masses)) * (1.0 + errors.mass),
        rotary_mass=vehicle.kind.rotary_mass,
        length=round(vehicle.length, 1),
        cars=vehicle.kind.cars,
        max_traction_force=vehicle.max_force,
        max_traction_power=vehicle.max_power,
        max_speed=vehicle.kind.max_speed,
        mass_std=0.03 if 'mass' in unknowns else 0.002,
        force_std=0.02 if 'force_gain' in unknowns else 0.002,
    )
    line = Line(
        stops=track.stops,
        gradient=_gradients(track, map_error) if 'map' in unknowns else track.gradient,
        curve=track.radius,
        speed_limit=track.limit,
        gradient_std=0.3 if 'map' in unknowns else 0.02,
    )
    return TrainFile(train, _davis(plan, world, seed), _brake(plan), line, (_curve(plan, unknowns),))


def stated_dead_time(plan: Plan) -> float:
    """Return the stated dead time [s], at least 0.05 s."""
    return max(plan.vehicle.brake_delay - plan.errors.brake_delay, 0.05)


def _davis(plan: Plan, world: str, seed: int) -> Davis:
    """Return Davis coefficients, each 15 to 30 % too high or too low."""
    rng = random_of(world, seed, 'believed resistance')
    a, b, c = (
        value * (1.0 + float(rng.uniform(0.15, 0.3)) * (1.0 if rng.uniform() < 0.5 else -1.0))
        for value in plan.vehicle.davis
    )
    return Davis(a, b, c)


def _brake(plan: Plan) -> Brake:
    return Brake(1.0, plan.vehicle.brake_lag * plan.errors.brake_lag, stated_dead_time(plan))


def _curve(plan: Plan, unknowns: Collection[str]) -> Effect:
    value = plan.vehicle.curve * (1.0 + plan.errors.curve)
    known = 'curve' not in unknowns
    std = (('coefficient', (0.01 if known else 0.2) * value),)
    return Effect('curve_resistance', (('coefficient', value),), std, 'measured' if known else 'typical')


def _gradients(track: Track, map_error: MapError) -> Pairs:
    """Return the gradients of the map, in pieces short enough to represent its error."""
    starts = np.array([start for start, _ in track.gradient])
    values = np.array([value for _, value in track.gradient])
    grid = np.arange(min(starts[0], track.stops[0]), track.stops[-1], MAP_PIECE)
    cuts = np.unique(np.concatenate((starts, grid)))
    true = values[np.clip(np.searchsorted(starts, cuts, side='right') - 1, 0, values.size - 1)]
    shown = np.round(true + map_error.at(cuts + 0.5 * MAP_PIECE), 2)
    return tuple(zip(cuts.tolist(), shown.tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class Drive:
    """Records in order of arrival, the assumed train file, and the truth."""

    records: tuple[Record, ...]
    train_file: TrainFile
    truth: Truth


def drive(
    world: str,
    seed: int,
    unknowns: Collection[str] = FIELD,
    rate_hz: float | Rates = 5.0,
    duration: float | None = None,
    motion: type[Motion] = Motion,
    change: Callable[[Plan], Plan] | None = None,
) -> Drive:
    """Simulate a drive of about an hour.

    Args:
        world: One of ``WORLDS``.
        seed: Draws train, driver and errors, but not the line.
        unknowns: Names of the unknowns that are switched on.
        rate_hz: Messages per second of all topics but mass, or of each topic.
        duration: Time after which the next stop ends the drive [s]; about an hour if not given.
        motion: How the train moves, to be other than usual.
        change: Returns what is driven instead of what was drawn.

    Raises:
        ValueError: World or unknowns are not among the known names.

    """
    if world not in WORLDS:
        raise ValueError(f'world must be one of {", ".join(WORLDS)}, not {world}')
    plan = _plan(world, seed, unknowns, DURATIONS[world] if duration is None else duration)
    plan = plan if change is None else change(plan)
    log = simulate(plan, random_of(world, seed, 'driver'), motion)
    map_error, weighed = draw_map_error(plan, world, seed), draw_weighed(plan, world, seed)
    return Drive(
        records=sense(Sensors(plan, log, weighed, map_error), _rates(rate_hz), world, seed),
        train_file=stated_file(plan, track_of(world), map_error, unknowns, world, seed),
        truth=_truth(plan, log, weighed),
    )


def _rates(rate_hz: float | Rates) -> Rates:
    return rate_hz if isinstance(rate_hz, Rates) else Rates(rate_hz, rate_hz, rate_hz, rate_hz)


def _plan(world: str, seed: int, unknowns: Collection[str], duration: float) -> Plan:
    changes = 'changes' in unknowns
    vehicle = draw_vehicle(KINDS[world], random_of(world, seed, 'train'))
    errors = draw_errors(world, seed, unknowns)
    track, route = track_of(world), random_of(world, seed, 'route')
    ways = tuple(lay_way(track, sign, vehicle.length, vehicle.curve) for sign in (1, -1))
    return Plan(
        vehicle=vehicle,
        habits=HABITS[world],
        ways=(ways[0], ways[1]),
        first=int(route.integers(2)),
        # Some trains start at a later stop.
        start=int(route.integers(max(len(track.stops) // 2, 1))) if len(track.stops) > 4 else 0,
        resistance=draw_resistance(vehicle, duration, changes, random_of(world, seed, 'resistance')),
        brake_rate=draw_brake_rate(vehicle, duration, changes, random_of(world, seed, 'brake rate')),
        gusts=draw_gusts(errors, int((duration + SPARE) / TICK), TICK, random_of(world, seed, 'gusts')),
        masses=draw_loads(vehicle, MAX_RUNS, random_of(world, seed, 'load')),
        errors=errors,
        duration=duration,
    )


def _truth(plan: Plan, log: Log, weighed: NDArray[np.float64]) -> Truth:
    every = slice(None, None, STEPS_PER_TICK)
    time, leg, speed = log.time[every], log.leg[every], log.speed[every]
    mass = np.array(plan.masses)[leg]
    davis = np.array([plan.resistance.at(at) for at in time.tolist()])
    rate, moving = log.rate[every], speed > 0.0
    return Truth(
        time_ns=EPOCH_NS + np.round(time * 1e9).astype(np.int64),
        speed=speed,
        a=davis[:, 0],
        b=davis[:, 1],
        c=davis[:, 2],
        mass=mass,
        brake_rate=rate,
        braking=moving & (rate * log.nominal[every] > 0.1),
        moving=moving,
        traction=log.force[every],
        force_scale=(1.0 + plan.errors.force_gain) * weighed[leg] / mass,
        changes=plan.resistance.times[1:],
        brake_changes=plan.brake_rate.changes,
        force_delay=plan.errors.force_delay,
        brake_delay_error=plan.vehicle.brake_delay - stated_dead_time(plan),
        wheel_ratio=1.0 + plan.errors.wheels,
        gust_std=plan.errors.gust_std,
        gust_time=plan.errors.gust_time,
        map_std=plan.errors.map_std,
        map_length=plan.errors.map_length,
        stop_errors=log.stops,
    )
