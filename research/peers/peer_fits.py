# SPDX-License-Identifier: Apache-2.0
"""Fits of a, b, c to a speed trajectory of 100 s between two stations: scipy compared with the batch fit of trainid.

Each trajectory has a free initial speed; the model for scipy is a simulation from it, in a Python loop or compiled by
numba, called by `scipy.optimize.least_squares`.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from research.peers.contest import FIRST_SEED, installed
from research.peers.metro_stream import INERTIA, PERIOD, SPEED_SD, curve_error, metro_stream
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.resistance.davis_fit import DavisFitConfig, Trajectory, fit_davis

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from research.peers.metro_stream import Scenario
    from trainid_ros.train.train_file import Davis

    Floats = NDArray[np.float64]
    Simulation = Callable[[float, float, float, float, Floats, Floats], None]

_RIDES: Final[tuple[Scenario, ...]] = ('clean', 'slip', 'out5')
_MIN_TICKS: Final = 400
_MANY_ROWS: Final = 10_000
_MANY: Final = 20
_SCALE: Final = np.array([1.0, 0.02, 0.001])
_START: Final = np.array([1.0, 0.5, 1.0])
_OURS: Final = 'trainid batch fit, robust'


@dataclass(frozen=True, slots=True)
class Piece:
    """One ride between two stations: speeds [m/s] at n ticks, force minus gradient and traction [N/kN] before each."""

    speed: Floats
    force: Floats
    traction: Floats


@dataclass(frozen=True, slots=True)
class Result:
    """One fit: error of w [N/kN] and CPU time [ms]."""

    name: str
    scenario: str
    error: float
    milliseconds: float


def measure(seeds: int) -> list[Table]:
    """Return the table of the fits."""
    results = [item for ride in over_seeds(fits, range(seeds)) for item in ride]
    names = list(dict.fromkeys(item.name for item in results))
    rows = []
    for name in names:
        mine = [item for item in results if item.name == name]
        errors = (float(np.median([item.error for item in mine if item.scenario == ride])) for ride in _RIDES)
        p50, p90 = np.percentile([item.milliseconds for item in mine if item.scenario == _RIDES[0]], (50.0, 90.0))
        rows.append((name, f'{p50:.2f}', f'{p90:.2f}', *(f'{error:.3f}' for error in errors)))
    note = (
        f'Median over {seeds} seeds of the RMSE of w(v) over 5 to 22 m/s [N/kN], CPU time in ms on '
        f'clean data. One piece: at least {_MIN_TICKS} ticks. slip and out5 as in the streaming table. The batch fit '
        'also estimates delay and gain of the force, noise and gusts; the others assume white noise only.'
    )
    header = ('fit', 'ms', 'ms, p90', *_RIDES)
    return [Table('Fits of a speed trajectory compared with scipy', header, tuple(rows), note)]


def fits(number: int) -> list[Result]:
    """Fit one piece, and twenty together, of all scenarios of one seed."""
    results = []
    methods: dict[str, Callable[[list[Piece]], Floats]] = {
        'scipy least_squares, Python loop': lambda pieces: _by_scipy(pieces, _simulate, 'linear'),
        _OURS: _by_trainid,
    }
    joint: dict[str, Callable[[list[Piece]], Floats]] = {f'{_MANY} pieces: {_OURS}': _by_trainid}
    if installed('numba'):
        fast = _fast_simulation()
        methods['scipy least_squares, numba'] = lambda pieces: _by_scipy(pieces, fast, 'linear')
        methods['scipy least_squares soft_l1, numba'] = lambda pieces: _by_scipy(pieces, fast, 'soft_l1')
        joint[f'{_MANY} pieces: scipy soft_l1, numba'] = lambda pieces: _by_scipy(pieces, fast, 'soft_l1')
    for ride in _RIDES:
        pieces, truth = pieces_of(FIRST_SEED + number, ride)
        for method, given in ((methods, pieces[:1]), (joint, pieces[:_MANY])):
            for name, fit in method.items():
                if ride == _RIDES[0]:  # the scenario that is timed
                    fit(given)  # warm-up
                begun = time.thread_time()
                theta = fit(given)
                results.append(Result(name, ride, curve_error(theta, truth), 1e3 * (time.thread_time() - begun)))
    return results


def pieces_of(seed: int, scenario: Scenario) -> tuple[list[Piece], Davis]:
    """Return the rides between stations with enough ticks, and the true resistance."""
    stream = metro_stream(seed, scenario, _MANY_ROWS)
    raw = stream.raw
    edges = np.flatnonzero(np.diff(np.concatenate([[0], raw.moving.astype(np.int8), [0]])))
    found = []
    for start, end in edges.reshape(-1, 2):
        if end - start >= _MIN_TICKS:
            part = slice(start, end)
            found.append(Piece(raw.speed[part], (raw.force - raw.gradient)[part], raw.force[part]))
    return found, stream.after


def _simulate(a: float, b: float, c: float, v: float, force: Floats, path: Floats) -> None:
    """Write the speeds [m/s] from the initial speed v into ``path``, shape (n,), by the midpoint rule."""
    gain = PERIOD / INERTIA
    path[0] = v
    for k in range(1, path.size):
        u = force[k]
        m = v + 0.5 * gain * (u - a - v * (b + v * c))
        v += gain * (u - a - m * (b + m * c))
        path[k] = v


@cache
def _fast_simulation() -> Simulation:
    from numba import njit  # noqa: PLC0415

    machine_code: Any = njit(_simulate)
    fast: Simulation = machine_code
    return fast


def _by_scipy(pieces: list[Piece], simulate: Simulation, loss: Literal['linear', 'soft_l1']) -> Floats:
    from scipy.optimize import least_squares  # noqa: PLC0415

    seen = np.concatenate([piece.speed for piece in pieces])
    ends = np.cumsum([piece.speed.size for piece in pieces])
    path = np.empty(seen.size)

    def residuals(x: Floats) -> Floats:
        a, b, c = (x[:3] * _SCALE).tolist()
        for k, piece in enumerate(pieces):
            simulate(a, b, c, float(x[3 + k]), piece.force, path[ends[k] - piece.speed.size : ends[k]])
        return np.asarray((path - seen) / SPEED_SD)

    start = np.concatenate([_START, [piece.speed[0] for piece in pieces]])
    solution = least_squares(residuals, start, loss=loss, f_scale=2.0, x_scale='jac')
    return np.asarray(solution.x[:3] * _SCALE)


def _by_trainid(pieces: list[Piece]) -> Floats:
    dt = np.concatenate([np.where(np.arange(piece.speed.size) > 0, PERIOD, 0.0) for piece in pieces])
    speed, known, traction = (
        np.concatenate([getattr(piece, name) for piece in pieces]) for name in ('speed', 'force', 'traction')
    )
    try:
        return fit_davis(Trajectory(speed, dt, known, traction, INERTIA), DavisFitConfig()).theta
    except NoAnswerError:
        return np.full(3, math.nan)
