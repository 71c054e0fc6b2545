# SPDX-License-Identifier: Apache-2.0
"""A hidden case from the name of its effect and a seed: input of the workflow, and the truth; a mix of cases.

Visibility of effects is by linear response along the true ride. A change f(t) of dv/dt changes the speed integrated by
the assumed model by d with ``d' = -g/(1000 (1 + gamma)) (b + 2 c v) d + f``. The part of d that the best initial speed
of each run and the best common a, b, c can fit does not count as gap.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from benchmarks.hidden_case import Answer, Case, HiddenEffect, assumed_yaml
from benchmarks.hidden_cases.effects import COUNTS_FROM_START, LIBRARY, OUTSIDE, G
from benchmarks.hidden_cases.motion import STEP, Ride
from benchmarks.hidden_cases.world import Track, draw_world
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from benchmarks.hidden_cases.effects import Hidden
    from benchmarks.hidden_cases.motion import Log
    from benchmarks.hidden_cases.world import Nuisance, Vehicle, World

    Array = NDArray[np.float64]

_LOST = 0.03
_OUTLIERS = 0.05
_WALK = 0.04
_MIN_CURVATURE = 2e-5


def slip_path(log: Log, share: float, most: float, rng: Generator) -> Array:
    """Return the slip speed (wheel minus train) [m/s] per row of the log: bursts where the specific force is high."""
    slip = np.zeros(len(log.speed))
    if share <= 0.0:
        return slip
    specific = log.force / log.weighed
    candidates = np.flatnonzero((log.run >= 0) & (log.speed > 1.0) & (np.abs(specific) > 0.3))
    wanted, spent = share * float(np.sum(log.run >= 0)), 0
    while spent < wanted and len(candidates):
        start = int(rng.choice(candidates))
        count = int(rng.uniform(0.5, 2.5) / STEP)
        if slip[start] != 0.0:
            spent += 1
            continue
        burst = slice(start, min(start + count, len(slip)))
        shape = np.sin(np.pi * np.arange(burst.stop - burst.start) / count)
        slip[burst] = np.sign(specific[start]) * most * float(rng.uniform(0.4, 1.0)) * shape
        spent += count
    slip[log.run < 0] = 0.0
    return np.maximum(slip, -log.speed)


def sense(
    log: Log, track: Track, nuisance: Nuisance, wheel_ratio: float, slip: Array, start_ns: int, rng: Generator
) -> tuple[Record, ...]:
    """Return the messages of a bag in the order of their stamps."""
    span = (len(log.speed) - 1) * STEP
    grid = np.arange(0.0, span, nuisance.period)
    phases = rng.choice([0.0, 0.02, 0.04], 3) if rng.random() < 0.35 else np.zeros(3)

    def times(phase: float) -> Array:
        jitter = np.clip(nuisance.jitter * rng.standard_normal(len(grid)), -0.004, 0.004)
        return np.clip(grid + phase + jitter, 0.0, span)

    walk = _odometer_walk(log, rng)
    records: list[Record] = []
    records += _kept(_speeds(log, times(0.0), nuisance, wheel_ratio, slip, walk, start_ns, rng), nuisance, rng)
    records += _kept(_forces(log, times(float(phases[0])), nuisance, start_ns, rng), nuisance, rng)
    records += _kept(_tracks(log, times(float(phases[1])), track, walk, start_ns), nuisance, rng)
    rows = np.round(grid / STEP).astype(int)
    commands = zip(_stamps(grid, start_ns), log.command[rows].tolist(), strict=True)
    records += _kept((BrakeRecord(stamp, value, emergency=False) for stamp, value in commands), nuisance, rng)
    if nuisance.mass_topic:
        weighed = zip(_stamps(times(float(phases[2])), start_ns), log.weighed[rows].tolist(), strict=True)
        records += _kept((MassRecord(stamp, mass) for stamp, mass in weighed), nuisance, rng)
    return tuple(sorted(records, key=lambda record: record.stamp_ns))


def _kept(records: Iterable[Record], nuisance: Nuisance, rng: Generator) -> Iterator[Record]:
    lossy = 'dropouts' in nuisance.contamination
    return (record for record in records if not lossy or rng.random() >= _LOST)


def _stamps(times: Array, start_ns: int) -> list[int]:
    stamps: list[int] = (start_ns + np.round(times * 1e9).astype(np.int64)).tolist()
    return stamps


def _odometer_walk(log: Log, rng: Generator) -> Array:
    """Return the position error, a random walk in motion that is reset at each stop [m]."""
    shocks = np.where(log.run >= 0, _WALK * np.sqrt(STEP) * rng.standard_normal(len(log.run)), 0.0)
    return _since_stop(log, shocks)


def _since_stop(log: Log, increments: Array) -> Array:
    total = np.cumsum(increments)
    standing = log.run < 0
    last = np.maximum.accumulate(np.where(standing, np.arange(len(total)), 0))
    grown: Array = np.where(standing, 0.0, total - total[last])
    return grown


def _at(times: Array, values: Array) -> Array:
    read: Array = np.interp(times, np.arange(len(values)) * STEP, values)
    return read


def _speeds(
    log: Log, times: Array, nuisance: Nuisance, ratio: float, slip: Array, walk: Array, start_ns: int, rng: Generator
) -> Iterator[Record]:
    speed = _at(times, log.speed)
    measured = ratio * speed + _at(times, slip) + nuisance.speed_noise * rng.standard_normal(len(times))
    if 'outliers' in nuisance.contamination:
        hit = rng.random(len(times)) < _OUTLIERS
        measured += np.where(hit, rng.uniform(1.0, 8.0, len(times)) * rng.choice([-1.0, 1.0], len(times)), 0.0)
    measured = np.round(np.maximum(0.0, measured) / nuisance.speed_step) * nuisance.speed_step
    measured[speed <= 0.0] = 0.0
    # The odometer counts wheel turns, so its distance has the same relative error.
    counted = _since_stop(log, (ratio - 1.0) * log.heading * log.speed * STEP)
    position = _at(times, log.front) + _at(times, walk + counted)
    rows = zip(_stamps(times, start_ns), measured.tolist(), position.tolist(), strict=True)
    return (SpeedRecord(stamp, value, place) for stamp, value, place in rows)


def _forces(log: Log, times: Array, nuisance: Nuisance, start_ns: int, rng: Generator) -> Iterator[Record]:
    force = _at(times, log.force)
    weight = G / 1000.0 * _at(times, log.weighed)
    force += nuisance.force_noise * weight * rng.standard_normal(len(times))
    force *= 1.0 + 0.002 * rng.standard_normal(len(times))
    return (ForceRecord(stamp, value) for stamp, value in zip(_stamps(times, start_ns), force.tolist(), strict=True))


def _tracks(log: Log, times: Array, track: Track, walk: Array, start_ns: int) -> Iterator[Record]:
    rows = np.round(times / STEP).astype(int)
    heading = log.heading[rows]
    under = track.under(_at(times, log.front) + _at(times, walk), heading)
    curved = under[:, 2] > _MIN_CURVATURE
    radius = np.divide(1.0, under[:, 2], out=np.zeros(len(rows)), where=curved)
    columns = (heading * under[:, 1]).tolist(), radius.tolist(), (under[:, 3] >= 0.5).tolist()
    values = zip(_stamps(times, start_ns), *columns, strict=True)
    return (GradientRecord(stamp, gradient, curve, tunnel) for stamp, gradient, curve, tunnel in values)


_DAVIS_ERROR = 0.15
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
_EVERY = 5


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

    The name is 'none', an effect, two effects joined by '+', or 'pair' for two random ones.

    Raises:
        ValueError: The name is not known.

    """
    wanted = _pair(np.random.default_rng([seed, 5])) if name == 'pair' else name
    names = [] if wanted == 'none' else wanted.split(PAIR_MARK)
    if unknown := [one for one in names if one not in LIBRARY and one not in OUTSIDE]:
        raise ValueError(f'effect {unknown[0]!r} is not known; known are none, {", ".join([*LIBRARY, *OUTSIDE])}')
    world = draw_world(np.random.default_rng([seed, 1]), one_bag=not COUNTS_FROM_START.isdisjoint(names))
    effects = [(LIBRARY | OUTSIDE)[one](world, np.random.default_rng([seed, crc32(one.encode())])) for one in names]
    return ride_case(seed, world, effects)


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


def ride_case(seed: int, world: World, effects: Sequence[Hidden]) -> Case:
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
    answer = _answer(world, effects, logs, sensed)
    return Case(_assumed_file(world, np.random.default_rng([seed, 4])), tuple(bags), answer)


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


def _answer(world: World, effects: Sequence[Hidden], logs: Sequence[Log], sensed: Sequence[Array]) -> Answer:
    nuisance = world.nuisance
    gaps = measure_gaps(logs, sensed, world.vehicle)
    floor = math.sqrt(gaps.noise**2 + nuisance.speed_noise**2 + nuisance.speed_step**2 / 12.0)
    hidden = tuple(
        HiddenEffect(one.name, one.parameters if one.comparable else (), one.near, _percent(gap, floor))
        for one, gap in zip(effects, gaps.effects, strict=True)
    )
    return Answer(
        kind=_kind(effects),
        effects=hidden,
        visible=_percent(gaps.total, floor),
        floor=floor,
        one_way=world.one_way,
        contamination=nuisance.contamination,
        flags=() if nuisance.mass_topic else ('no_mass_topic',),
    )


def _percent(gap: float, floor: float) -> float:
    return 100.0 * (math.hypot(floor, gap) / floor - 1.0)


def _kind(effects: Sequence[Hidden]) -> str:
    if not effects:
        return 'none'
    if any(effect.name in OUTSIDE for effect in effects):
        return 'outside'
    return 'single' if len(effects) == 1 else 'pair'


@dataclass(frozen=True, slots=True)
class Gaps:
    """RMS speed gaps [m/s] of the refitted assumed model: by process noise, by each effect, by all effects."""

    noise: float
    effects: tuple[float, ...]
    total: float


def measure_gaps(logs: Sequence[Log], sensed: Sequence[Array], vehicle: Vehicle) -> Gaps:
    """Return the gaps of a ride; per bag a log, and what each effect adds to the measured speed, shape (effects, n)."""
    runs = [_Run.cut(log, own, number) for log, own in zip(logs, sensed, strict=True) for number in _numbers(log)]
    responses = _respond(runs, vehicle)
    columns = [_without_start(run, response) for run, response in zip(runs, responses, strict=True)]
    everything = np.concatenate(columns, axis=0)
    davis, signals = everything[:, :3], everything[:, 3:]
    signals = np.column_stack([signals, signals[:, 1:].sum(axis=1)])
    scale = np.linalg.norm(davis, axis=0)
    fitted, *_ = np.linalg.lstsq(davis / scale, signals, rcond=None)
    remaining: list[float] = np.sqrt(np.mean((signals - davis / scale @ fitted) ** 2, axis=0)).tolist()
    return Gaps(remaining[0], tuple(remaining[1:-1]), remaining[-1])


@dataclass(frozen=True, slots=True)
class _Run:
    speed: Array  # (n,)
    forcing: Array  # (n, 1 + effects): mean over each interval
    sensed: Array  # (n, 1 + effects)

    @classmethod
    def cut(cls, log: Log, own: Array, number: int) -> _Run:
        rows = np.flatnonzero(log.run == number)
        rows = rows[: len(rows) // _EVERY * _EVERY]
        forcing = np.vstack([log.noise, log.added])[:, rows]
        parts = forcing.reshape(len(forcing), -1, _EVERY).mean(axis=2).T
        direct = np.vstack([np.zeros(len(rows)), own[:, rows]])[:, ::_EVERY].T
        return cls(log.speed[rows[::_EVERY]], parts, direct)


def _numbers(log: Log) -> list[int]:
    return sorted({int(number) for number in np.unique(log.run) if number >= 0})


def _respond(runs: list[_Run], vehicle: Vehicle) -> list[Array]:
    """Return the responses per run to initial speed, a, b, c, noise and each effect, shape (n, 1 + 3 + 1 + effects)."""
    _, b, c = vehicle.davis
    rate = G / 1000.0 / (1.0 + vehicle.rotary)
    longest, width = max(len(run.speed) for run in runs), 4 + runs[0].forcing.shape[1]
    forcing = np.zeros((longest, len(runs), width))
    decay = np.ones((longest, len(runs), 1))
    for k, run in enumerate(runs):
        count, v = len(run.speed), run.speed
        forcing[:count, k, 1:4] = -rate * np.column_stack([np.ones(count), v, v * v])
        forcing[:count, k, 4:] = run.forcing
        decay[:count, k, 0] = np.exp(-STEP * _EVERY * rate * (b + 2.0 * c * v))
    forcing *= STEP * _EVERY
    state = np.zeros((len(runs), width))
    state[:, 0] = 1.0
    path = np.empty_like(forcing)
    for step in range(longest):
        path[step] = state
        state = state * decay[step] + forcing[step]
    return [path[: len(run.speed), k] for k, run in enumerate(runs)]


def _without_start(run: _Run, response: Array) -> Array:
    start, rest = response[:, :1], response[:, 1:].copy()
    rest[:, 3:] += run.sensed
    cleaned: Array = rest - start @ (start.T @ rest) / np.sum(start * start)
    return cleaned
