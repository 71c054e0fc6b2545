# SPDX-License-Identifier: Apache-2.0
"""Sensor model of a ride: noise, resolution, drift, jitter, lost messages, outliers, slip."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.hidden_cases.effects import G
from benchmarks.hidden_cases.motion import STEP
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from benchmarks.hidden_cases.motion import Log
    from benchmarks.hidden_cases.world import Nuisance, Track

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
