# SPDX-License-Identifier: Apache-2.0
"""The assumed train file: no effects, Davis coefficients with errors of up to 15 %, the rest as known on board."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numpy.random import Generator

    from benchmarks.hidden_cases.world import Pairs, World

_DAVIS_ERROR = 0.15


def assumed_file(world: World, rng: Generator) -> str:
    """Return the assumed train file as YAML text."""
    vehicle, route = world.vehicle, world.route
    wrong = [value * (1.0 + float(rng.uniform(-_DAVIS_ERROR, _DAVIS_ERROR))) for value in vehicle.davis]
    a, b, c = (f'{value:.4g}' for value in wrong)
    stops = ', '.join(f'{stop:.1f}' for stop in route.stops)
    return '\n'.join(
        [
            f'train: {{mass: {world.mean_mass:.1f}, rotary_mass: {vehicle.rotary}, length: {vehicle.length:.1f}, '
            f'cars: {max(2, round(vehicle.length / 20))}}}',
            f'resistance: {{a: {a}, b: {b}, c: {c}}}',
            f'brake: {{rate: 1.0, time_constant: {vehicle.brake_lag}, delay: {vehicle.brake_dead:.2f}}}',
            'line:',
            f'  stops: [{stops}]',
            f'  gradient: {_pairs(route.gradient)}',
            f'  curve: {_pairs(route.curve)}',
            f'  tunnel: {_pairs(route.tunnels)}',
            'effects: []',
            '',
        ]
    )


def _pairs(pairs: Pairs) -> str:
    return '[' + ', '.join(f'[{first:.1f}, {second:.1f}]' for first, second in pairs) + ']'
