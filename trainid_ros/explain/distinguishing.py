# SPDX-License-Identifier: Apache-2.0
"""Drives that tell an effect from one it is confused with, where driving alone can: on level, straight track.

The information on the amplitude A of an effect comes from the speeds of a planned run, linear in what is not known: A,
the size of the other effect, a, b, c and the payload. With C the derivatives of the speeds by them, and R the
covariance of integrated gusts, map errors and speed noise, it is I = C' R^-1 C; the inverse has the variance of A.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.resistance.planned_drive import KM_H, STEP_S, Manoeuvre, plan_run, planned_runs
from trainid_ros.train.effects import EFFECTS, TrackPoint
from trainid_ros.train.forces import specific_inertia

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.resistance.planned_drive import Run, Step
    from trainid_ros.train.effects import EffectKind
    from trainid_ros.train.train_file import Davis, TrainFile

    Array = NDArray[np.float64]

_CLEAR: Final = 4.0
"""Amplitude over its standard deviation from which two effects are distinguished [-]."""
_TIMES: Final = 3
_SLOW: Final = (5.0 * KM_H, 10.0 * KM_H)
"""Speeds that are held in addition to the usual manoeuvres [m/s]."""
_SLOW_S: Final = 60.0
"""How long they are held [s]."""
_DAVIS_WIDER: Final = 3.0
"""Prior std of a, b, c over their std in the fit [-]: the other effect would change them too."""
_TWIN_SIZE: Final = 10.0
"""Prior std of the other effect in multiples of its typical amplitude [-]."""
_MIN_STD: Final = 1e-6
"""Lower bound of a prior std, which keeps its inverse finite [unit of the value]."""
_EVERY: Final = 5
"""One speed counts in so many steps of a plan [-]."""
_SAMPLES: Final = 2.0
"""Speed samples per step of a plan [-]."""
_MAP_M: Final = 250.0
"""Correlation length of map errors [m]."""
_WARM_M: Final = 1e6
"""A long way into the day, when the bearings are warm [m]."""
_NUMBERS: Final = {1: 'once', 2: 'twice'}


@dataclass(frozen=True, slots=True)
class FitSummary:
    """What a fit has found: the train file, a, b, c with their standard deviations, noise and nuisances."""

    train_file: TrainFile
    davis: Davis
    davis_std: tuple[float, float, float]
    hyper: Hyperparameters


def distinguishing_drive(name: str, parameters: Mapping[str, float], twin: str, known: FitSummary) -> str:
    """Return the shortest drive that tells an effect from its twin, with the std it promises; '' if none does.

    Args:
        name: The effect.
        parameters: Its parameters as found.
        twin: The other effect, of any size.
        known: What is known from the runs so far.
    """
    kind, other = EFFECTS[name], EFFECTS[twin]
    shape = _typical(other)
    if kind.resistance is None or other.resistance is None or shape is None:
        return ''
    size = abs(parameters[kind.amplitude] - kind.neutral)
    found: list[tuple[float, Run, int, float]] = []
    for run in _runs(known.train_file, known.davis):
        effect = _resistances(run, kind, parameters, known.davis) / max(size, 1e-12)
        information = _information(run, effect, _resistances(run, other, shape, known.davis), known)
        for times in range(1, _TIMES + 1):
            std = _std(times * information, known)
            if size >= _CLEAR * std:
                found.append((times * run.duration_s, run, times, std))
    if not found:
        return ''
    _, run, times, std = min(found, key=lambda item: item[0])
    unit = kind.parameters[kind.amplitude].unit
    count, length = _NUMBERS.get(times, f'{times} times'), f'{times * run.length_m / 1000.0:.1f} km'
    return f'{run.manoeuvre.text} {count} ({length}): {kind.amplitude} ± {std:.2g}{f" {unit}" if unit else ""}'


def _runs(train_file: TrainFile, davis: Davis) -> Iterator[Run]:
    slow = (plan_run(Manoeuvre(v, v, _SLOW_S), train_file, davis) for v in _SLOW)
    return chain(planned_runs(train_file, davis), (run for run in slow if run is not None))


def _typical(kind: EffectKind) -> dict[str, float] | None:
    """Return parameters of typical size and shape; None for an effect at a place or time of its own."""
    values = {kind.amplitude: kind.neutral + kind.typical_size}
    for name, parameter in kind.parameters.items():
        if name == kind.amplitude:
            continue
        if parameter.search is None:
            return None
        low, high = parameter.search
        values[name] = math.sqrt(low * high) if parameter.grid == 'log' else 0.5 * (low + high)
    return values


def _resistances(run: Run, kind: EffectKind, parameters: Mapping[str, float], davis: Davis) -> Array:
    """Return the resistance of an effect at each step [N/kN], shape (n,)."""
    if kind.resistance is None:
        return np.zeros(len(run.steps))
    points = (_point(run.steps, k) for k in range(len(run.steps)))
    return np.array([kind.resistance(parameters, davis, point) for point in points])


def _point(steps: Sequence[Step], k: int) -> TrackPoint:
    before = steps[max(k - 1, 0)]
    return TrackPoint(
        time_s=k * STEP_S,
        position=math.nan,
        direction=1,
        speed=steps[k].speed,
        distance_run=_WARM_M,
        since_release=k * STEP_S,
        traction=steps[k].traction,
        acceleration=(steps[k].speed - before.speed) / STEP_S,
        traction_before=lambda ago: steps[min(max(k - round(ago / STEP_S), 0), len(steps) - 1)].traction,
    )


def _information(run: Run, effect: Array, twin: Array, known: FitSummary) -> Array:
    """Return the information of a run on [A, twin, a, b, c, kappa], the initial speed not known, shape (6, 6)."""
    v, traction = (np.array([getattr(step, name) for step in run.steps]) for name in ('speed', 'traction'))
    pulls = np.stack((effect, twin, np.ones_like(v), v, v * v, -traction), axis=1)
    hyper, m = known.hyper, specific_inertia(1.0, known.train_file.train.rotary_mass)
    at = slice(_EVERY - 1, None, _EVERY)
    C = np.concatenate((-np.cumsum(pulls, axis=0) * STEP_S / m, np.ones((len(v), 1))), axis=1)[at]
    t: Array = np.arange(1.0, len(v) + 1.0)[at] * STEP_S
    noise = hyper.noise
    map_time = _MAP_M / max(float(v.mean()), 1.0)
    drift: Array = _integrated(t, noise.gust, noise.gust_time) + _integrated(t, hyper.spread.map, map_time)
    R = drift / (m * m) + noise.speed**2 / (_EVERY * _SAMPLES) * np.eye(t.size)
    full = C.T @ np.linalg.solve(R, C)
    start = full[:6, 6]
    return np.asarray(full[:6, :6] - np.outer(start, start) / full[6, 6])


def _integrated(t: Array, std: float, tau: float) -> Array:
    """Return the covariance at times t [s] of the integral of a first-order Gauss-Markov process, shape (n, n)."""
    lesser, decay = np.minimum(t[:, None], t[None, :]), np.exp(-t / tau)
    shape = 2.0 * lesser / tau - 1.0 + decay[:, None] + decay[None, :] - np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    return np.asarray((std * tau) ** 2 * shape)


def _std(information: Array, known: FitSummary) -> float:
    """Return the standard deviation of A after runs with this information, all else as unknown as a priori."""
    davis_std = (_DAVIS_WIDER * max(std, _MIN_STD) for std in known.davis_std)
    stds = np.array([_TWIN_SIZE, *davis_std, max(known.hyper.spread.payload, _MIN_STD)])
    prior = np.concatenate(([0.0], stds**-2.0))
    total = information + np.diag(prior)
    left = total[0, 0] - total[0, 1:] @ np.linalg.solve(total[1:, 1:], total[1:, 0])
    return 1.0 / math.sqrt(left) if left > 0.0 else math.inf
