# SPDX-License-Identifier: Apache-2.0
"""A hidden case from the name of its effect and a seed: input of the workflow, and the truth; a mix of cases."""

from __future__ import annotations

from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from benchmarks.hidden_case import Case, HiddenEffect, assumed_yaml, draw_mix
from benchmarks.hidden_cases.effects import COUNTS_FROM_START, LIBRARY, OUTSIDE
from benchmarks.hidden_cases.motion import Ride
from benchmarks.hidden_cases.world import Track, draw_world
from benchmarks.hidden_log import answer_of, measure_gaps, observe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator

    from benchmarks.hidden_cases.effects import Hidden
    from benchmarks.hidden_cases.world import World

_DAVIS_ERROR = 0.15
_EPOCH_NS = 1_760_000_000_000_000_000
_BAG_NS = 7_200_000_000_000


def _assumed_file(world: World, rng: Generator) -> str:
    vehicle, route = world.vehicle, world.route
    wrong = [value * (1.0 + float(rng.uniform(-_DAVIS_ERROR, _DAVIS_ERROR))) for value in vehicle.davis]
    train = {
        'mass': f'{world.mean_mass:.1f}',
        'rotary_mass': vehicle.rotary,
        'length': f'{vehicle.length:.1f}',
        'cars': max(2, round(vehicle.length / 20)),
    }
    sections = {'gradient': route.gradient, 'curve': route.curve, 'tunnel': route.tunnels}
    davis, brake = [f'{value:.4g}' for value in wrong], (vehicle.brake_lag, vehicle.brake_dead)
    return assumed_yaml(train, davis, brake, route.stops, sections, '{:.1f}'.format)


def make_case(name: str, seed: int) -> Case:
    """Return a case; equal names and seeds give equal cases, equal seeds the same train, line and timetable.

    The name is 'none', an effect, or two effects joined by '+'.

    Raises:
        ValueError: The name is not known.

    """
    names = [] if name == 'none' else name.split('+')
    if unknown := [one for one in names if one not in LIBRARY and one not in OUTSIDE]:
        raise ValueError(f'effect {unknown[0]!r} is not known; known are none, {", ".join([*LIBRARY, *OUTSIDE])}')
    world = draw_world(np.random.default_rng([seed, 1]), one_bag=not COUNTS_FROM_START.isdisjoint(names))
    effects = [(LIBRARY | OUTSIDE)[one](world, np.random.default_rng([seed, crc32(one.encode())])) for one in names]
    return ride_case(seed, world, effects)


def draw_cases(seed: int, count: int) -> list[tuple[str, int]]:
    """Return names and seeds of a mix."""
    return draw_mix(seed, count, LIBRARY, OUTSIDE)


def ride_case(seed: int, world: World, effects: Sequence[Hidden]) -> Case:
    """Return the case of a given world and effects; the seed determines gusts, map and sensor errors."""
    nuisance = world.nuisance
    track = Track(world.route, world.vehicle.length, nuisance, np.random.default_rng([seed, 2]))
    falsified = [(effect.wheel_ratio, *effect.slip) for effect in effects]
    logs, bags, sensed, runs = [], [], [], 0
    for k, legs in enumerate(world.bags):
        log = Ride(world, track, effects, seed * 10 + k).drive(legs, runs)
        rng, start_ns = np.random.default_rng([seed, 3, k]), _EPOCH_NS + k * _BAG_NS
        own, records = observe(log, track.under, nuisance, falsified, start_ns, rng)
        logs.append(log)
        sensed.append(own)
        bags.append(records)
        runs += len(legs)
    gaps = measure_gaps(logs, sensed, world.vehicle.davis, world.vehicle.rotary)
    hidden = [HiddenEffect(one.name, one.parameters, one.near, 0.0) for one in effects]
    flags = () if nuisance.mass_topic else ('no_mass_topic',)
    answer = answer_of(hidden, OUTSIDE, gaps, nuisance, flags, one_way=world.one_way)
    return Case(_assumed_file(world, np.random.default_rng([seed, 4])), tuple(bags), answer)
