# SPDX-License-Identifier: Apache-2.0
"""How visible effects are in speed, by linear response along the true ride.

A change f(t) of dv/dt moves the speed that the believed model integrates by
``d' = -g/(1000 (1 + gamma)) (b + 2 c v) d + f``.
What the best initial speed of each run and the best common a, b, c can take up of it is no gap.
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
    """RMS speeds [m/s] that the refitted believed model misses: by noise of the physics, each effect, all effects."""

    noise: float
    effects: tuple[float, ...]
    total: float


def measure_gaps(logs: Sequence[Log], sensed: Sequence[Array], vehicle: Vehicle) -> Gaps:
    """Return the gaps of a ride.

    Args:
        logs: One per bag.
        sensed: Per bag (effects, n): what each effect adds to the measured speed itself [m/s].
        vehicle: True Davis and rotary mass.

    """
    runs = [_Run.cut(log, own, number) for log, own in zip(logs, sensed, strict=True) for number in _numbers(log)]
    answers = _respond(runs, vehicle)
    columns = [_without_start(run, answer) for run, answer in zip(runs, answers, strict=True)]
    everything = np.concatenate(columns, axis=0)
    davis, signals = everything[:, :3], everything[:, 3:]
    signals = np.column_stack([signals, signals[:, 1:].sum(axis=1)])
    scale = np.linalg.norm(davis, axis=0)
    taken, *_ = np.linalg.lstsq(davis / scale, signals, rcond=None)
    missed: list[float] = np.sqrt(np.mean((signals - davis / scale @ taken) ** 2, axis=0)).tolist()
    return Gaps(missed[0], tuple(missed[1:-1]), missed[-1])


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
    """Return per run (n, 1 + 3 + 1 + effects): answer to the initial speed, a, b, c, noise and each effect."""
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


def _without_start(run: _Run, answer: Array) -> Array:
    start, rest = answer[:, :1], answer[:, 1:].copy()
    rest[:, 3:] += run.sensed
    cleaned: Array = rest - start @ (start.T @ rest) / np.sum(start * start)
    return cleaned
