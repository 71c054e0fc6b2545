# SPDX-License-Identifier: Apache-2.0
"""Visibility of effects in the speed, by linear response along the true ride.

A change f(t) of dv/dt changes the speed integrated by the assumed model by d with
``d' = -g/(1000 (1 + gamma)) (b + 2 c v) d + f``.
The part of d that the best initial speed of each run and the best common a, b, c can fit does not count as gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.hidden_cases.hidden import G
from benchmarks.hidden_cases.motion import STEP

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from benchmarks.hidden_cases.motion import Log
    from benchmarks.hidden_cases.world import Vehicle

    Array = NDArray[np.float64]

_EVERY = 5


@dataclass(frozen=True, slots=True)
class Gaps:
    """RMS speed gaps [m/s] of the refitted assumed model: by process noise, by each effect, by all effects."""

    noise: float
    effects: tuple[float, ...]
    total: float


def measure_gaps(logs: Sequence[Log], sensed: Sequence[Array], vehicle: Vehicle) -> Gaps:
    """Return the gaps of a ride.

    Args:
        logs: One per bag.
        sensed: Per bag, the direct contribution of each effect to the measured speed, shape (effects, n) [m/s].
        vehicle: True Davis and rotary mass.

    """
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
