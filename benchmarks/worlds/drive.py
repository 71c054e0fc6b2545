# SPDX-License-Identifier: Apache-2.0
"""Simulate one drive: records, train file and truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.worlds.conditions import draw_brake_rate, draw_gusts, draw_loads, draw_resistance
from benchmarks.worlds.driving import HABITS, TICK
from benchmarks.worlds.motion import STEPS_PER_TICK, Motion, Plan, simulate
from benchmarks.worlds.sensing import EPOCH_NS, Rates, Sensors, draw_map_error, draw_weighed, sense
from benchmarks.worlds.stated import stated_dead_time, stated_file
from benchmarks.worlds.tracks import lay_way, track_of
from benchmarks.worlds.truth import Truth
from benchmarks.worlds.unknowns import FIELD, draw_errors, random_of
from benchmarks.worlds.vehicles import KINDS, draw_vehicle

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from numpy.typing import NDArray

    from benchmarks.worlds.motion import Log
    from trainid_ros.interface.records import Record
    from trainid_ros.train.train_file import TrainFile

WORLDS: Final = ('metro', 'emu', 'high_speed', 'freight', 'tram')
DURATIONS: Final = {'metro': 3700.0, 'emu': 3500.0, 'high_speed': 3200.0, 'freight': 3200.0, 'tram': 3900.0}
# Upper limit of the time that the last run needs to reach its stop after the duration is over [s].
SPARE: Final = 7200.0
MAX_RUNS: Final = 200


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
        curve=plan.vehicle.curve,
        gust_std=plan.errors.gust_std,
        gust_time=plan.errors.gust_time,
        map_std=plan.errors.map_std,
        map_length=plan.errors.map_length,
        stop_errors=log.stops,
    )
