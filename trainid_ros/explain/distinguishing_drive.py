# SPDX-License-Identifier: Apache-2.0
"""The drive that tells an effect from another one, if driving on level, straight track can.

The information on the amplitude A of an effect comes from the speeds of a planned run, linear in what is not known: A,
the sizes of all other effects, a, b, c, the payload and the brake. With C the derivatives of the speeds by them, and R
the covariance of integrated gusts, map errors and speed noise, it is I = C' R^-1 C; the inverse has the variance of A.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.explain.likelihood import integrated_covariance
from trainid_ros.interface.records import KM_H
from trainid_ros.resistance.suggested_drive import STEP_S, Manoeuvre, plan_run, planned_runs
from trainid_ros.train.effects import EFFECTS, TrackPoint
from trainid_ros.train.forces import davis as resistance_of
from trainid_ros.train.forces import specific_inertia

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from trainid_ros.explain.dataset import Array
    from trainid_ros.explain.effects import EffectTerm
    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.resistance.suggested_drive import Run as PlannedRun
    from trainid_ros.train.effects import EffectKind
    from trainid_ros.train.train_file import Davis, TrainFile

_COUNTS: Final = {1: 'once', 2: 'twice', 3: '3 times'}  # Numbers of times that one run is driven
_STEPS: Final = 5  # Steps of a plan whose speeds are averaged to one


@dataclass(frozen=True, slots=True)
class FitSummary:
    """What a fit has found: the train file, a, b, c with their standard deviations, noise and nuisances."""

    train_file: TrainFile
    davis: Davis
    davis_std: tuple[float, float, float]
    hyper: Hyperparameters


def distinguishing_drive(
    name: str, parameters: Mapping[str, float], twin: str, fit: FitSummary, others: Sequence[EffectTerm] = ()
) -> str:
    """Return the shortest drive that tells an effect as found from a twin of any size, with its std; '' if none.

    ``others`` are further effects in the model, whose sizes are not known either.
    """
    kind, other = EFFECTS[name], EFFECTS[twin]
    shape = _typical(other)
    if kind.resistance is None or other.resistance is None or shape is None:
        return ''
    size = abs(parameters[kind.amplitude] - kind.neutral)
    found: list[tuple[float, PlannedRun, int, float]] = []
    # Beside the usual manoeuvres, slow speeds are held for a minute.
    slow = (plan_run(Manoeuvre(v, v, 60.0), fit.train_file, fit.davis) for v in (5.0 / KM_H, 10.0 / KM_H))
    for run in chain(planned_runs(fit.train_file, fit.davis), (run for run in slow if run is not None)):
        motion = _Motion.of(run, fit)
        rivals = (other, shape), *((term.kind, term.parameters) for term in others)
        effect = motion.resistances(kind, parameters, fit.davis) / max(size, 1e-12)
        effects = effect, *(motion.resistances(*rival, fit.davis) for rival in rivals)
        information = _information(motion, effects, fit)
        for times in _COUNTS:
            std = _std(times * information, fit)
            if size >= 4.0 * std:  # then the two are distinguished
                found.append((times * run.duration_s, run, times, std))
    if not found:
        return ''
    _, run, times, std = min(found, key=lambda item: item[0])
    unit = kind.parameters[kind.amplitude].unit
    length = f'{times * run.length_m / 1000.0:.1f} km'
    return f'{run.manoeuvre.text} {_COUNTS[times]} ({length}): {kind.amplitude} ± {std:.2g}{f" {unit}" if unit else ""}'


def _typical(kind: EffectKind) -> dict[str, float] | None:
    """Return parameters of typical size and shape; None for an effect at a place or time of its own."""
    values = {kind.amplitude: kind.neutral + kind.typical_size}
    for name in kind.shape:
        parameter = kind.parameters[name]
        if parameter.search is None:
            return None
        low, high = parameter.search
        values[name] = math.sqrt(low * high) if parameter.grid == 'log' else 0.5 * (low + high)
    return values


class _Motion(NamedTuple):
    """Motion of a planned run from stop to stop, at the end of each step, shapes (n,)."""

    speed: Array  # [m/s]
    traction: Array  # Mean reported traction [N/kN]
    brake: Array  # Braking force [N/kN, <= 0]
    rate: Array  # Acceleration [m/s^2]

    @classmethod
    def of(cls, run: PlannedRun, fit: FitSummary) -> _Motion:
        """Return the motion of a run with a, b, c of a fit."""
        speed, pulled = np.array(run.speeds), np.array([step.traction for step in run.steps])
        rate, braked = np.diff(speed, prepend=speed[0]) / STEP_S, len(run.braking)
        force = specific_inertia(1.0, fit.train_file.train.rotary_mass) * rate + resistance_of(fit.davis, speed)
        brake = np.append(np.zeros(pulled.size), np.minimum(force[pulled.size :], 0.0))
        return cls(speed, np.append(pulled, np.zeros(braked)), brake, rate)

    def resistances(self, kind: EffectKind, parameters: Mapping[str, float], davis: Davis) -> Array:
        """Return the resistance of an effect at each step [N/kN], shape (n,)."""
        resistance = kind.resistance or (lambda *_: 0.0)
        return np.array([resistance(parameters, davis, self._point(k)) for k in range(self.speed.size)])

    def _point(self, k: int) -> TrackPoint:
        def before(force: Array, seconds: float) -> float:
            return float(force[min(max(k - round(seconds / STEP_S), 0), force.size - 1)])

        traction, brake = (partial(before, force) for force in (self.traction, self.brake))
        return TrackPoint(
            k * STEP_S, math.nan, 1, float(self.speed[k]),
            distance_run=1e6,  # the bearings are warm
            since_release=0.0 if self.brake[k] else k * STEP_S, traction=traction(0.0), brake=brake(0.0),
            acceleration=float(self.rate[k]), brake_before=brake, traction_before=traction,
        )  # fmt: skip


def _information(motion: _Motion, effects: Sequence[Array], fit: FitSummary) -> Array:
    """Return the information of a run on [effects, a, b, c, payload, brake], the initial speed not known, (n, n)."""
    v, traction, brake = motion.speed, motion.traction, motion.brake
    pulls = np.stack((*effects, np.ones_like(v), v, v * v, -traction, -brake), axis=1)
    hyper, m = fit.hyper, specific_inertia(1.0, fit.train_file.train.rotary_mass)
    at = slice(_STEPS - 1, None, _STEPS)
    C = np.concatenate((-np.cumsum(pulls, axis=0) * STEP_S / m, np.ones((len(v), 1))), axis=1)[at]
    t: Array = np.arange(1.0, len(v) + 1.0)[at] * STEP_S
    noise = hyper.noise
    map_time = 250.0 / max(float(v.mean()), 1.0)  # correlation length of map errors [m]
    gusts = (noise.gust * noise.gust_time) ** 2 * integrated_covariance(t, noise.gust_time)
    errors_of_map = (hyper.spread.map * map_time) ** 2 * integrated_covariance(t, map_time)
    R = (gusts + errors_of_map) / (m * m) + noise.speed**2 / (_STEPS * 2.0) * np.eye(t.size)  # two samples a step
    full = C.T @ np.linalg.solve(R, C)
    start = full[:-1, -1]
    return np.asarray(full[:-1, :-1] - np.outer(start, start) / full[-1, -1])


def _std(information: Array, fit: FitSummary) -> float:
    """Return the standard deviation of A after runs with this information, all else as unknown as a priori."""
    spread = fit.hyper.spread
    known = np.maximum([*(3.0 * x for x in fit.davis_std), spread.payload, spread.brake], 1e-6)  # for a finite inverse
    # The other effects may have ten times their typical amplitudes, and would change a, b, c too.
    stds = np.append(np.full(len(information) - 1 - known.size, 10.0), known)
    prior = np.concatenate(([0.0], stds**-2.0))
    total = information + np.diag(prior)
    left = total[0, 0] - total[0, 1:] @ np.linalg.solve(total[1:, 1:], total[1:, 0])
    return 1.0 / math.sqrt(left) if left > 0.0 else math.inf
