# SPDX-License-Identifier: Apache-2.0
"""Fits of a, b, c by scipy and trainid to a trajectory between two stations; costs of steps and of imports.

Each trajectory has a free initial speed; the model for scipy is a simulation from it, in a Python loop or compiled by
numba, called by `scipy.optimize.least_squares`. Costs: CPU time and memory of V-MILS, AM-VFF-RLS and GSMA steps.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from research.papers.brake_runs import metro_train
from research.peers.contest import FIRST_SEED, REPOSITORY, Times, growth, installed, time_in_turns
from research.peers.hand_filters import VARIANCE, HandRls
from research.peers.metro_stream import INERTIA, PERIOD, SPEED_SD, Scenario, curve_error, metro_stream
from research.peers.our_filters import OUTLIERS, PRIOR, P
from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.brake_rate.motion_model import Start, Transition
from trainid_ros.estimators.settings import AmVffRlsConfig, GsmaConfig
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.resistance.davis_fit import DavisFitConfig, Trajectory, fit_davis
from trainid_ros.setup.pipelines import am_vff_rls
from trainid_ros.train.train_file import Davis

Floats = NDArray[np.float64]
Simulation = Callable[[float, float, float, float, Floats, Floats], None]
Item = tuple[Any, ...]
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


_CALLS: Final = 20_000
_BLOCK: Final = 2000
_MEMORY_CALLS: Final = 1_000_000
_PARTICLES: Final = 500
_LEARNS: Final = 1000
_INTERVAL: Final = Transition(0.2, 0.1, 0.6, 0.012, 0.37, 0.99, 0.0, 1e-5, 1e-6)
_PLAIN_US: Final = 3.0
_GSMA_MS: Final = 0.2
_IMPORT_S: Final = 0.3
_IMPORTS: Final = 7
_NO_GROWTH: Final = 1.0


@dataclass(frozen=True, slots=True)
class Kernel:
    """A recursion and its arguments."""

    name: str
    items: Sequence[Item]
    step: Callable[..., object]


class PlainMils:
    """V-MILS in plain Python."""

    def __init__(self) -> None:
        self.state = (*information_of(PRIOR), *NOTHING)
        self._parts = deque([NOTHING] * P)

    def step(self, v: float, s: float, y: float, R: float, slow: float) -> None:
        self.state, newest, _, _ = mils_step(self.state, self._parts.popleft(), v, s, y, R, slow, OUTLIERS, P)
        self._parts.append(newest)


def measure_costs(seeds: int) -> list[Table]:
    """Return the tables of the kernels and of the targets; ``seeds`` has no effect."""
    del seeds
    kernels = (_mils(), _speed_model())
    reference, stream = HandRls(4.0), metro_stream(FIRST_SEED)
    calls: list[tuple[Callable[..., object], Sequence[Item]]] = [(reference.step, reference.items(stream)[:_CALLS])]
    calls += [(kernel.step, kernel.items[:_CALLS]) for kernel in kernels]
    first, *times = time_in_turns([*calls, _brake_step()], _BLOCK)
    rows = [_row('hand RLS, floats, gate (reference)', first, first, '-')]
    for kernel, spent in zip(kernels, times, strict=False):
        grown = growth(kernel.step, kernel.items, _MEMORY_CALLS // 10, _MEMORY_CALLS)
        rows.append(_row(kernel.name, spent, first, _grown(grown)))
    rows.append(_row(f'GSMA, {_PARTICLES} particles', times[-1], first, '-'))
    header = ('step', 'us p50', 'us p99', 'p50 / reference', 'B per step')
    note = (
        'CPU time of a step, all in turns in one process. GSMA: prediction and update. Memory between the steps '
        f'{_MEMORY_CALLS // 10} and {_MEMORY_CALLS}; 0 below {_NO_GROWTH:.0f} B.'
    )
    return [Table('Recursions of the estimators', header, tuple(rows), note), _targets(times, rows)]


def _row(name: str, times: Times, first: Times, grown: str) -> tuple[str, ...]:
    return name, f'{times.p50:.2f}', f'{times.p99:.2f}', f'{times.p50 / first.p50:.2f}', grown


def _grown(value: float) -> str:
    return '0' if abs(value) < _NO_GROWTH else f'{value:.1f}'


def _targets(times: list[Times], rows: list[tuple[str, ...]]) -> Table:
    core, numpy = import_seconds('trainid_ros.estimators.pipeline'), import_seconds('numpy')
    checks = (
        ('V-MILS p = 10', times[0].p50, _PLAIN_US, 'us'),
        ('AM-VFF-RLS', times[1].p50, _PLAIN_US, 'us'),
        (f'GSMA, {_PARTICLES} particles', times[2].p50 / 1e3, _GSMA_MS, 'ms'),
        ('import of the core', core, _IMPORT_S, 's'),
    )
    lines = [
        (name, f'<= {most} {unit}', f'{reached:.3f} {unit}', 'yes' if reached <= most else 'NO')
        for name, reached, most, unit in checks
    ]
    grown = [row[4] for row in rows if row[4] != '-']
    lines.append(('memory over 1e6 steps', 'no growth', ', '.join(grown), 'yes' if set(grown) == {'0'} else 'NO'))
    note = f'CPU time, median of steps and best of {_IMPORTS} imports; numpy alone imports in {numpy:.3f} s.'
    return Table('Targets for CPU time and memory', ('quantity', 'target', 'reached', 'met?'), tuple(lines), note)


def import_seconds(module: str) -> float:
    """Return the CPU time to import a module in a fresh interpreter, from cached bytecode, best of several [s]."""
    code = f'import time; t = time.process_time(); import {module}; print(time.process_time() - t)'
    env = {name: value for name, value in os.environ.items() if name != 'PYTHONDONTWRITEBYTECODE'}
    with tempfile.TemporaryDirectory() as folder:
        env['PYTHONPYCACHEPREFIX'] = folder
        command = [sys.executable, '-c', code]
        found = [
            subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY, env=env)
            for _ in range(_IMPORTS)
        ]
    return min(float(done.stdout) for done in found)


def _mils() -> Kernel:
    rows = metro_stream(FIRST_SEED, 'out5').rows
    v, n = rows.phi[:, 1], rows.y.size
    table = np.column_stack([v, v * v, rows.y, np.full(n, VARIANCE), np.ones(n)])
    return Kernel(f'V-MILS p = {P}', [tuple(row) for row in table.tolist()], PlainMils().step)


def _speed_model() -> Kernel:
    model = am_vff_rls(metro_train(), AmVffRlsConfig()).method
    raw = metro_stream(FIRST_SEED, 'out5').raw
    y, u = raw.speed[raw.moving], (raw.force - raw.gradient)[raw.moving]
    items = [(one, force, 1.0, SPEED_SD**2) for one, force in zip(y.tolist(), u.tolist(), strict=True)]
    return Kernel('AM-VFF-RLS', items, model.update)


def _brake_step() -> tuple[Callable[..., object], list[Item]]:
    config = GsmaConfig(particles=_PARTICLES)
    posterior: Any = Gsma(metro_train(), config, np.random.default_rng(1)).posterior
    posterior.reinit_motion(Start(20.0, -0.8, (1e-3, 1e-3, 1e-4)))

    def step(seen: float) -> None:
        posterior.predict(_INTERVAL)
        posterior.update(_INTERVAL, _INTERVAL.dt, seen, SPEED_SD**2)

    # Data from the model itself, in white noise.
    rng, v, a = np.random.default_rng(2), 20.0, -0.8
    items: list[Item] = []
    for _ in range(_LEARNS):
        v, a = v + _INTERVAL.reach * a + _INTERVAL.gain_v, _INTERVAL.decay * a + _INTERVAL.gain_a
        items.append((v + SPEED_SD * float(rng.standard_normal()),))
    return step, items
