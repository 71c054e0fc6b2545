# SPDX-License-Identifier: Apache-2.0
"""CPU time and memory of V-MILS, AM-VFF-RLS and GSMA steps, and import time."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.tables import Table
from research.papers.brake_runs import metro_train
from research.peers.contest import FIRST_SEED, REPOSITORY, growth, time_in_turns
from research.peers.hand_filters import VARIANCE, HandRls
from research.peers.metro_stream import SPEED_SD, metro_stream
from research.peers.our_filters import OUTLIERS, PRIOR, P
from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.brake_rate.motion_model import Start, Transition
from trainid_ros.estimators.settings import AmVffRlsConfig, GsmaConfig
from trainid_ros.setup.pipelines import am_vff_rls

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from research.peers.contest import Times

    Item = tuple[Any, ...]

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


def measure(seeds: int) -> list[Table]:
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
