# SPDX-License-Identifier: Apache-2.0
"""Generate a hidden case from the name of its effect and a seed, and draw a mix of cases."""

from __future__ import annotations

import math
from itertools import cycle
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from benchmarks.hidden_cases.assumed import assumed_file
from benchmarks.hidden_cases.case import Case, EffectTruth, Kind, Truth
from benchmarks.hidden_cases.library import COUNTS_FROM_START, LIBRARY
from benchmarks.hidden_cases.motion import Ride
from benchmarks.hidden_cases.outside import OUTSIDE
from benchmarks.hidden_cases.sensors import sense, slip_path
from benchmarks.hidden_cases.track import Track
from benchmarks.hidden_cases.visible import measure_gaps
from benchmarks.hidden_cases.world import draw_world

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from benchmarks.hidden_cases.hidden import Hidden
    from benchmarks.hidden_cases.motion import Log
    from benchmarks.hidden_cases.world import Nuisance, World

    Array = NDArray[np.float64]

PAIR_MARK = '+'
_TWINS = (
    {'mass_error', 'traction_scale', 'wheel_diameter'},
    {'brake_scale', 'brake_fade', 'brake_delay'},
    {'gradient_error', 'local_drag'},
    {'bearing_warmup', 'resistance_step'},
    {'headwind', 'tunnel_drag', 'higher_order_drag'},
)
_SHARES = (('none', 0.15), ('single', 0.60), ('pair', 0.10), ('outside', 0.15))
_EPOCH_NS = 1_760_000_000_000_000_000
_BAG_NS = 7_200_000_000_000
_CONTAMINATING_SLIP = (0.015, 1.5)


def make_case(name: str, seed: int) -> Case:
    """Return a case; equal names and seeds give equal cases.

    Args:
        name: 'none', an effect, two effects joined by '+', or 'pair' for two random ones. Cases of one seed
            share train, line and timetable.
        seed: Not negative.

    Raises:
        ValueError: The name is not known.

    """
    wanted = _pair(np.random.default_rng([seed, 5])) if name == 'pair' else name
    names = [] if wanted == 'none' else wanted.split(PAIR_MARK)
    if unknown := [one for one in names if one not in LIBRARY and one not in OUTSIDE]:
        raise ValueError(f'effect {unknown[0]!r} is not known; known are none, {", ".join([*LIBRARY, *OUTSIDE])}')
    world = draw_world(np.random.default_rng([seed, 1]), one_bag=not COUNTS_FROM_START.isdisjoint(names))
    effects = [(LIBRARY | OUTSIDE)[one](world, np.random.default_rng([seed, crc32(one.encode())])) for one in names]
    return ride_case(wanted, seed, world, effects)


def draw_cases(seed: int, count: int) -> list[tuple[str, int]]:
    """Return names and seeds of a mix: 15 % none, 60 % single, 10 % pairs, 15 % outside, all names in turn."""
    rng = np.random.default_rng([seed, 6])
    kinds = [kind for kind, share in _SHARES for _ in range(round(share * count))]
    kinds = (kinds + ['single'] * count)[:count]
    names = {'single': LIBRARY, 'outside': OUTSIDE}
    turns = {kind: cycle(rng.permutation(list(draws)).tolist()) for kind, draws in names.items()}
    drawn: list[tuple[str, int]] = []
    for k, kind in enumerate(kinds):
        of_case = seed * 100_003 + k
        if kind == 'pair':
            drawn.append((_pair(np.random.default_rng([of_case, 5])), of_case))
        else:
            drawn.append((kind if kind == 'none' else next(turns[kind]), of_case))
    return [drawn[k] for k in rng.permutation(len(drawn)).tolist()]


def _pair(rng: Generator) -> str:
    while True:
        first, second = rng.choice(list(LIBRARY), 2, replace=False).tolist()
        if not any({first, second} <= twins for twins in _TWINS):
            return f'{first}{PAIR_MARK}{second}'


def ride_case(name: str, seed: int, world: World, effects: Sequence[Hidden]) -> Case:
    """Return the case of a given world and effects; the seed determines gusts, map and sensor errors."""
    nuisance = world.nuisance
    track = Track(world.route, world.vehicle.length, nuisance, np.random.default_rng([seed, 2]))
    wheel = math.prod(effect.wheel_ratio for effect in effects)
    logs, bags, sensed, runs = [], [], [], 0
    for k, legs in enumerate(world.bags):
        rng = np.random.default_rng([seed, 3, k])
        log = Ride(world, track, effects, seed * 10 + k).drive(legs, runs)
        own = _sensed(log, effects, rng)
        slip = _slip(effects, own) + _contamination(log, nuisance, rng)
        logs.append(log)
        sensed.append(own)
        bags.append(sense(log, track, nuisance, wheel, slip, _EPOCH_NS + k * _BAG_NS, rng))
        runs += len(legs)
    truth = _truth(world, effects, logs, sensed)
    train_yaml = assumed_file(world, np.random.default_rng([seed, 4]))
    return Case(name, seed, train_yaml, tuple(bags), truth)


def _sensed(log: Log, effects: Sequence[Hidden], rng: Generator) -> Array:
    """Return the direct contribution of each effect to the measured speed, shape (effects, n) [m/s]."""
    rows = [slip_path(log, *effect.slip, rng) + (effect.wheel_ratio - 1.0) * log.speed for effect in effects]
    return np.array(rows).reshape(len(effects), len(log.speed))


def _slip(effects: Sequence[Hidden], own: Array) -> Array:
    slips: Array = sum(
        (row for effect, row in zip(effects, own, strict=True) if effect.slip[0] > 0.0), np.zeros(own.shape[1])
    )
    return slips


def _contamination(log: Log, nuisance: Nuisance, rng: Generator) -> Array:
    share, most = _CONTAMINATING_SLIP if 'slip' in nuisance.contamination else (0.0, 0.0)
    return slip_path(log, share, most, rng)


def _truth(world: World, effects: Sequence[Hidden], logs: Sequence[Log], sensed: Sequence[Array]) -> Truth:
    nuisance = world.nuisance
    gaps = measure_gaps(logs, sensed, world.vehicle)
    floor = math.sqrt(gaps.noise**2 + nuisance.speed_noise**2 + nuisance.speed_step**2 / 12.0)
    effect_truths = tuple(
        EffectTruth(effect.name, effect.parameters, effect.comparable, effect.near, gap, _percent(gap, floor))
        for effect, gap in zip(effects, gaps.effects, strict=True)
    )
    return Truth(
        kind=_kind(effects),
        effects=effect_truths,
        one_way=world.one_way,
        mass_topic=nuisance.mass_topic,
        contamination=nuisance.contamination,
        davis=world.vehicle.davis,
        floor=floor,
        gap=gaps.total,
        visible_percent=_percent(gaps.total, floor),
    )


def _percent(gap: float, floor: float) -> float:
    return 100.0 * (math.hypot(floor, gap) / floor - 1.0)


def _kind(effects: Sequence[Hidden]) -> Kind:
    if not effects:
        return 'none'
    if any(effect.name in OUTSIDE for effect in effects):
        return 'outside'
    return 'single' if len(effects) == 1 else 'pair'
