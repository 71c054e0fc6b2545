# SPDX-License-Identifier: Apache-2.0
"""The train file: assumed parameters of train and line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.worlds.sensing import MAP_PIECE
from benchmarks.worlds.unknowns import random_of
from trainid_ros.train.train_file import Brake, Davis, Effect, Line, Train, TrainFile

if TYPE_CHECKING:
    from collections.abc import Collection

    from benchmarks.worlds.motion import Plan
    from benchmarks.worlds.sensing import MapError
    from benchmarks.worlds.tracks import Pairs, Track


def stated_file(
    plan: Plan, track: Track, map_error: MapError, unknowns: Collection[str], world: str, seed: int
) -> TrainFile:
    """Return the train file of a drive."""
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
