# SPDX-License-Identifier: Apache-2.0
"""From the log of a ride to the bags of its sensors, and to the gap that its effects leave: generators A and C.

Visibility of effects is by linear response along the true ride. A change f(t) of dv/dt changes the speed integrated by
the assumed model by d with ``d' = -g/(1000 (1 + gamma)) (b + 2 c v) d + f``. The part of d that the best initial speed
of each run and the best common a, b, c can fit does not count as gap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from benchmarks.hidden_case import Answer, HiddenEffect, kind_of
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord

if TYPE_CHECKING:
    from numpy.random import Generator

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Under = Callable[[Array, Array], Array]
"""True and map gradient for rising position [per mille], curvature [1/m], tunnel share under the train, shape (n, 4).

By position of the front [m] and direction of travel.
"""
G = 9.81
STEP = 0.02
"""Time between two rows of a log [s]."""
_LOST = 0.03
_OUTLIERS = 0.05
_WALK = 0.04
_MIN_CURVATURE = 2e-5
_CONTAMINATING_SLIP = (0.015, 1.5)
_EVERY = 5


@dataclass(frozen=True, slots=True)
class Log:
    """Truth of one bag, one row per 20 ms from time 0."""

    front: Array  # Position of the front [m]
    heading: Array  # +1 or -1
    run: Array  # Number of the run, -1 at standstill
    speed: Array  # Speed [m/s]
    force: Array  # Force reported by the drive, without noise [N]
    command: Array  # Brake command [m/s^2]
    weighed: Array  # Weighed mass [kg]
    noise: Array  # Contribution of the nuisances to dv/dt [m/s^2]
    added: Array  # Contribution of each effect to dv/dt, shape (effects, n) [m/s^2]


@dataclass(frozen=True, slots=True)
class Sensors:
    """Sizes of the errors of the sensors, in SI units; force in N/kN."""

    mass_topic: bool
    speed_noise: float
    speed_step: float
    force_noise: float
    jitter: float
    period: float
    contamination: tuple[str, ...]


def observe(
    log: Log, under: Under, sensors: Sensors, falsified: Sequence[tuple[float, float, float]], start_ns: int,
    rng: Generator,
) -> tuple[Array, tuple[Record, ...]]:  # fmt: skip
    """Return what each effect adds to the measured speed, shape (effects, n) [m/s], and the messages of the bag.

    ``falsified`` by each effect: ratio of measured to true speed, share of time with slip, greatest slip speed [m/s].
    """
    rows = [_slip_path(log, share, most, rng) + (ratio - 1.0) * log.speed for ratio, share, most in falsified]
    own = np.array(rows).reshape(len(falsified), len(log.speed))
    slips = (row for (_, share, _), row in zip(falsified, own, strict=True) if share > 0.0)
    slip: Array = sum(slips, np.zeros(own.shape[1]))
    slip = slip + _slip_path(log, *(_CONTAMINATING_SLIP if 'slip' in sensors.contamination else (0.0, 0.0)), rng)
    wheel = math.prod(ratio for ratio, _, _ in falsified)
    return own, _sense(log, under, sensors, wheel, slip, start_ns, rng)


def _slip_path(log: Log, share: float, most: float, rng: Generator) -> Array:
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


def _sense(
    log: Log, under: Under, sensors: Sensors, wheel_ratio: float, slip: Array, start_ns: int, rng: Generator
) -> tuple[Record, ...]:
    """Return the messages of a bag in the order of their stamps."""
    span = (len(log.speed) - 1) * STEP
    grid = np.arange(0.0, span, sensors.period)
    phases = rng.choice([0.0, 0.02, 0.04], 3) if rng.random() < 0.35 else np.zeros(3)

    def times(phase: float) -> Array:
        jitter = np.clip(sensors.jitter * rng.standard_normal(len(grid)), -0.004, 0.004)
        return np.clip(grid + phase + jitter, 0.0, span)

    walk = _odometer_walk(log, rng)
    records: list[Record] = []
    records += _kept(_speeds(log, times(0.0), sensors, wheel_ratio, slip, walk, start_ns, rng), sensors, rng)
    records += _kept(_forces(log, times(float(phases[0])), sensors, start_ns, rng), sensors, rng)
    records += _kept(_tracks(log, times(float(phases[1])), under, walk, start_ns), sensors, rng)
    rows = np.round(grid / STEP).astype(int)
    commands = zip(_stamps(grid, start_ns), log.command[rows].tolist(), strict=True)
    records += _kept((BrakeRecord(stamp, value, emergency=False) for stamp, value in commands), sensors, rng)
    if sensors.mass_topic:
        weighed = zip(_stamps(times(float(phases[2])), start_ns), log.weighed[rows].tolist(), strict=True)
        records += _kept((MassRecord(stamp, mass) for stamp, mass in weighed), sensors, rng)
    return tuple(sorted(records, key=lambda record: record.stamp_ns))


def _kept(records: Iterable[Record], sensors: Sensors, rng: Generator) -> Iterator[Record]:
    lossy = 'dropouts' in sensors.contamination
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
    log: Log, times: Array, sensors: Sensors, ratio: float, slip: Array, walk: Array, start_ns: int, rng: Generator
) -> Iterator[Record]:
    speed = _at(times, log.speed)
    measured = ratio * speed + _at(times, slip) + sensors.speed_noise * rng.standard_normal(len(times))
    if 'outliers' in sensors.contamination:
        hit = rng.random(len(times)) < _OUTLIERS
        measured += np.where(hit, rng.uniform(1.0, 8.0, len(times)) * rng.choice([-1.0, 1.0], len(times)), 0.0)
    measured = np.round(np.maximum(0.0, measured) / sensors.speed_step) * sensors.speed_step
    measured[speed <= 0.0] = 0.0
    # The odometer counts wheel turns, so its distance has the same relative error.
    counted = _since_stop(log, (ratio - 1.0) * log.heading * log.speed * STEP)
    position = _at(times, log.front) + _at(times, walk + counted)
    rows = zip(_stamps(times, start_ns), measured.tolist(), position.tolist(), strict=True)
    return (SpeedRecord(stamp, value, place) for stamp, value, place in rows)


def _forces(log: Log, times: Array, sensors: Sensors, start_ns: int, rng: Generator) -> Iterator[Record]:
    force = _at(times, log.force)
    weight = G / 1000.0 * _at(times, log.weighed)
    force += sensors.force_noise * weight * rng.standard_normal(len(times))
    force *= 1.0 + 0.002 * rng.standard_normal(len(times))
    return (ForceRecord(stamp, value) for stamp, value in zip(_stamps(times, start_ns), force.tolist(), strict=True))


def _tracks(log: Log, times: Array, under: Under, walk: Array, start_ns: int) -> Iterator[Record]:
    rows = np.round(times / STEP).astype(int)
    heading = log.heading[rows]
    felt = under(_at(times, log.front) + _at(times, walk), heading)
    curved = felt[:, 2] > _MIN_CURVATURE
    radius = np.divide(1.0, felt[:, 2], out=np.zeros(len(rows)), where=curved)
    columns = (heading * felt[:, 1]).tolist(), radius.tolist(), (felt[:, 3] >= 0.5).tolist()
    values = zip(_stamps(times, start_ns), *columns, strict=True)
    return (GradientRecord(stamp, gradient, curve, tunnel) for stamp, gradient, curve, tunnel in values)


def answer_of(
    effects: Sequence[HiddenEffect], outside: Container[str], gaps: Gaps, sensors: Sensors, flags: tuple[str, ...], *,
    one_way: bool,
) -> Answer:  # fmt: skip
    """Return the truth of a case with the visibility of its effects."""
    floor = math.sqrt(gaps.noise**2 + sensors.speed_noise**2 + sensors.speed_step**2 / 12.0)
    hidden = tuple(replace(one, visible=_percent(gap, floor)) for one, gap in zip(effects, gaps.effects, strict=True))
    kind = kind_of([one.name for one in effects], outside)
    return Answer(kind, hidden, _percent(gaps.total, floor), floor, one_way, sensors.contamination, flags)


def _percent(gap: float, floor: float) -> float:
    return 100.0 * (math.hypot(floor, gap) / floor - 1.0)


@dataclass(frozen=True, slots=True)
class Gaps:
    """RMS speed gaps [m/s] of the refitted assumed model: by process noise, by each effect, by all effects."""

    noise: float
    effects: tuple[float, ...]
    total: float


def measure_gaps(logs: Sequence[Log], sensed: Sequence[Array], davis: Triple, rotary: float) -> Gaps:
    """Return the gaps of a ride; per bag a log, and what each effect adds to the measured speed, shape (effects, n)."""
    runs = [_Run.cut(log, own, number) for log, own in zip(logs, sensed, strict=True) for number in _numbers(log)]
    responses = _respond(runs, davis, rotary)
    columns = [_without_start(run, response) for run, response in zip(runs, responses, strict=True)]
    everything = np.concatenate(columns, axis=0)
    fitted_to, signals = everything[:, :3], everything[:, 3:]
    signals = np.column_stack([signals, signals[:, 1:].sum(axis=1)])
    scale = np.linalg.norm(fitted_to, axis=0)
    fitted, *_ = np.linalg.lstsq(fitted_to / scale, signals, rcond=None)
    remaining: list[float] = np.sqrt(np.mean((signals - fitted_to / scale @ fitted) ** 2, axis=0)).tolist()
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


def _respond(runs: list[_Run], davis: Triple, rotary: float) -> list[Array]:
    """Return the responses per run to initial speed, a, b, c, noise and each effect, shape (n, 1 + 3 + 1 + effects)."""
    _, b, c = davis
    rate = G / 1000.0 / (1.0 + rotary)
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
