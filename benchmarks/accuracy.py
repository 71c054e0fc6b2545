# SPDX-License-Identifier: Apache-2.0
"""Accuracy of every registered algorithm on simulated days of different seeds, with two reference methods."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds import BrakeKalman, InformedWindows
from benchmarks.days import assumed_train, samples_of, simulated_day
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from trainid_lab.speed_model.upper_triangle import upper
from trainid_ros.estimators.settings import GsmaConfig, VMilsConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import BrakeRateEstimate, ResistanceEstimate, SpeedModelEstimate
from trainid_ros.setup.pipelines import BRAKE_RATE, RESISTANCE, SPEED_MODEL
from trainid_ros.speed_model.am_vff_rls import resistance_variance
from trainid_ros.train.forces import specific_inertia

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from trainid_ros.estimators.algorithm_registry import Algorithms, Estimator
    from trainid_ros.sim.truth import Truth
    from trainid_ros.stream.samples import Sample

Array = NDArray[np.float64]
# Values, standard deviation, and 1 if fit to use, after one sample.
Row: TypeAlias = tuple[float, ...]
Stepper: TypeAlias = Callable[['Sample'], Row]

SEEDS: Final = tuple(range(101, 113))
_SPEEDS: Final = (10.0, 15.0)
_AFTER_CHANGE_S: Final = 300.0
_AFTER_BRAKE_S: Final = 7.0
_MOVING: Final = 1.0
# Below this speed an applied brake is one being released at departure [m/s].
_DRIVING: Final = 3.0
_CLOSE: Final = 0.1
# Two-sided normal quantile of 95 %.
_SIGMA_95: Final = 1.959964
_CHANGES: Final = ('start', 'rain (a + 0.5)', 'drag (c + 20 %)')


@dataclass(frozen=True, slots=True)
class Trace:
    """Estimates at every sample: values of shape (n, k), standard deviations and fit-to-use flags of shape (n,).

    For the resistance the values are a, b, c and the standard deviation is that of w at the current speed [N/kN].
    ``cost_us`` is the CPU time per sample [us].
    """

    values: Array
    std: Array
    usable: NDArray[np.bool_]
    cost_us: float


@dataclass(frozen=True, slots=True)
class Day:
    """The samples of one day and the truth at each: time [s], speed [m/s], (a, b, c), brake rate [1], braking."""

    samples: tuple[Sample, ...]
    truth: Truth
    time_s: Array
    speed: Array
    davis: Array
    brake_rate: Array
    braking: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Shares of errors within 1 and 1.96 published standard deviations, share of samples fit to use, CPU time [us]."""

    inside_68: float
    inside_95: float
    usable: float
    cost_us: float


@dataclass(frozen=True, slots=True)
class ResistanceScore:
    """Errors of w [N/kN] five minutes after each change, and the calibration of the standard deviations.

    Attributes:
        errors: Mean absolute error over 10 m/s, 15 m/s and the last speed in motion, one per change [N/kN].
        close: Share of all these errors within 0.1 N/kN.
        calibration: Of w at the current speed while moving.

    """

    errors: tuple[float, ...]
    close: float
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class BrakeScore:
    """Absolute errors of the brake rate [1]: 7 s after the first brake command in motion, and the mean from then on."""

    early: float
    mean: float
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class DayScores:
    """All scores of one day, in the order of the registries; the reference method of each job last."""

    resistance: tuple[ResistanceScore, ...]
    speed_model: tuple[ResistanceScore, ...]
    brake_rate: tuple[BrakeScore, ...]


def measure() -> tuple[Table, ...]:
    """Score all seeds on all cores; return the tables."""
    scores = over_seeds(score_seed, SEEDS)
    informed, kalman = 'windows, given the changes', 'Kalman on v, a, b, f'
    return (
        _resistance_table('Resistance', (*RESISTANCE.names, informed), [day.resistance for day in scores]),
        _resistance_table('Speed model', (*SPEED_MODEL.names, informed), [day.speed_model for day in scores]),
        _brake_table((*BRAKE_RATE.names, kalman), [day.brake_rate for day in scores]),
    )


def _resistance_table(title: str, names: Sequence[str], days: Sequence[Sequence[ResistanceScore]]) -> Table:
    rows = tuple(_resistance_row(name, [day[k] for day in days]) for k, name in enumerate(names))
    after = tuple(f'after {name}' for name in _CHANGES)
    header = ('|error of w|, N/kN', *after, 'all', f'within {_CLOSE:g}', *_CALIBRATION)
    note = (
        f'{len(days)} days, mean ± standard error over days. Five minutes after each change, mean over 10 m/s, '
        '15 m/s and the last speed in motion. Bands: coverage for w at the current speed, over all samples in motion '
        'that were fit to use, including those right after a change. The last row is least squares over windows that '
        'restarts from the train file at every true change; it is not a bound, since windows discard information of '
        'the raw speed. CPU time of this run, with all cores in use.'
    )
    return Table(title, header, rows, note)


def _resistance_row(name: str, scores: Sequence[ResistanceScore]) -> tuple[str, ...]:
    errors = np.array([score.errors for score in scores])
    columns = [*errors.T, errors.mean(axis=1)]
    close = _percent([score.close for score in scores])
    return (
        name,
        *(_spread(column) for column in columns),
        close,
        *_calibration_cells([score.calibration for score in scores]),
    )


def _brake_table(names: Sequence[str], days: Sequence[Sequence[BrakeScore]]) -> Table:
    rows = tuple(_brake_row(name, [day[k] for day in days]) for k, name in enumerate(names))
    header = ('|error of the brake rate|', '7 s after the first brake', 'mean after', *_CALIBRATION)
    note = (
        'The filter on [v, a, b, f] is exact for a rate that drifts as in the settings of GSMA. Bands: coverage over '
        'all samples while braking that were fit to use.'
    )
    return Table('Brake rate', header, rows, note)


def _brake_row(name: str, scores: Sequence[BrakeScore]) -> tuple[str, ...]:
    errors = (_spread(np.array([s.early for s in scores])), _spread(np.array([s.mean for s in scores])))
    return name, *errors, *_calibration_cells([score.calibration for score in scores])


_CALIBRATION: Final = ('68 % band', '95 % band', 'fit to use', 'us per sample')


def _calibration_cells(scores: Sequence[Calibration]) -> tuple[str, ...]:
    inside = (_percent([s.inside_68 for s in scores]), _percent([s.inside_95 for s in scores]))
    usable, cost = np.mean([s.usable for s in scores]), np.mean([s.cost_us for s in scores])
    return *inside, f'{usable:.0%}', f'{cost:.0f}'


def _spread(values: Array) -> str:
    return f'{values.mean():.4f} ± {values.std(ddof=1) / math.sqrt(len(values)):.4f}'


def _percent(shares: Sequence[float]) -> str:
    """Return mean and standard error in percent; "-" with fewer than two days on which the algorithm was fit to use."""
    values = 100.0 * np.array([share for share in shares if not math.isnan(share)])
    if len(values) < 2:
        return '-'
    return f'{values.mean():.1f} ± {values.std(ddof=1) / math.sqrt(len(values)):.1f} %'


def score_seed(seed: int) -> DayScores:
    """Simulate one day, run all algorithms on it and score them."""
    day = _day(seed)
    change_ns = [day.truth.start_ns + round(row[0] * NS_PER_S) for row in day.truth.resistance]
    informed = _trace(day, _informed_row(InformedWindows(assumed_train(), VMilsConfig(), change_ns)))
    reference = _score_resistance(informed, day)
    kalman = _trace(day, _kalman_row(BrakeKalman(assumed_train(), GsmaConfig())))
    return DayScores(
        resistance=(*(_score_resistance(trace, day) for trace in _traces(RESISTANCE, day, seed)), reference),
        speed_model=(*(_score_resistance(trace, day) for trace in _traces(SPEED_MODEL, day, seed)), reference),
        brake_rate=(*(_score_brake(trace, day) for trace in _traces(BRAKE_RATE, day, seed)), _score_brake(kalman, day)),
    )


def resistance_scores(names: Sequence[str], seed: int) -> tuple[ResistanceScore, ...]:
    """Simulate one day and score some algorithms on it."""
    day = _day(seed)
    return tuple(_score_resistance(_trace_of(RESISTANCE, name, day, seed), day) for name in names)


def _day(seed: int) -> Day:
    simulated = simulated_day(seed)
    samples, truth = samples_of(simulated.records), simulated.truth
    time_s = np.array([(sample.stamp_ns - truth.start_ns) / NS_PER_S for sample in samples])
    points = [truth.truth_at(t) for t in time_s]
    known = BRAKE_RATE.make(BRAKE_RATE.choose(), assumed_train(), np.random.default_rng(seed))
    return Day(
        samples=samples,
        truth=truth,
        time_s=time_s,
        speed=np.array([sample.speed for sample in samples]),
        davis=np.array([(point.resistance.a, point.resistance.b, point.resistance.c) for point in points]),
        brake_rate=np.array([point.brake_rate or math.nan for point in points]),
        braking=np.array([_stepped(known, sample).observable for sample in samples]),
    )


def _traces(algorithms: Algorithms[Any], day: Day, seed: int) -> Iterable[Trace]:
    return (_trace_of(algorithms, name, day, seed) for name in algorithms.names)


def _trace_of(algorithms: Algorithms[Any], name: str, day: Day, seed: int) -> Trace:
    estimator = algorithms.make(algorithms.choose(name), assumed_train(), np.random.default_rng(seed))
    return _trace(day, _estimator_row(estimator))


def _stepped(estimator: Estimator[Any], sample: Sample) -> Any:
    estimator.step(sample)
    return estimator.estimate(sample.speed)


def _estimator_row(estimator: Estimator[Any]) -> Stepper:
    def row(sample: Sample) -> Row:
        return *_shown(_stepped(estimator, sample), sample.speed), float(estimator.converged)

    return row


def _shown(now: ResistanceEstimate | SpeedModelEstimate | BrakeRateEstimate, speed: float) -> Row:
    """Return the values to score and their standard deviation."""
    if isinstance(now, BrakeRateEstimate):
        return now.brake_rate, now.brake_rate_std
    if isinstance(now, ResistanceEstimate):
        return now.a, now.b, now.c, now.resistance_std
    S = upper(np.array(now.covariance).reshape(4, 4))
    variance = resistance_variance(S, speed, _acceleration_coefficient())
    return now.a, now.b, now.c, math.sqrt(max(variance, 1e-12))


@cache
def _acceleration_coefficient() -> float:
    """Return the acceleration per specific force of the assumed train [m/s^2 per N/kN]."""
    return 1.0 / specific_inertia(1.0, assumed_train().train.rotary_mass)


def _informed_row(informed: InformedWindows) -> Stepper:
    def row(sample: Sample) -> Row:
        informed.step(sample)
        phi = np.array([1.0, sample.speed, sample.speed**2])
        return *informed.theta, math.sqrt(phi @ informed.P @ phi), 1.0

    return row


def _kalman_row(kalman: BrakeKalman) -> Stepper:
    limit = GsmaConfig().valid_std

    def row(sample: Sample) -> Row:
        kalman.step(sample)
        std = math.sqrt(kalman.P[3, 3])
        return float(kalman.x[3]), std, float(std < limit)

    return row


def _trace(day: Day, row: Stepper) -> Trace:
    began = time.thread_time()
    rows = np.array([row(sample) for sample in day.samples])
    cost_us = 1e6 * (time.thread_time() - began) / len(day.samples)
    return Trace(rows[:, :-2], rows[:, -2], rows[:, -1] > 0.5, cost_us)


def _score_resistance(trace: Trace, day: Day) -> ResistanceScore:
    wrong, speed, moving = trace.values - day.davis, day.speed, day.speed >= _MOVING
    errors = []
    for change_s, *_ in day.truth.resistance:
        at = min(int(np.searchsorted(day.time_s, change_s + _AFTER_CHANGE_S)), len(speed) - 1)
        driven = float(speed[: at + 1][moving[: at + 1]][-1])
        errors.append([abs(float(wrong[at] @ (1.0, v, v * v))) for v in (*_SPEEDS, driven)])
    error = np.abs(wrong[:, 0] + speed * (wrong[:, 1] + speed * wrong[:, 2]))
    return ResistanceScore(
        errors=tuple(float(np.mean(row)) for row in errors),
        close=float(np.mean(np.array(errors) <= _CLOSE)),
        calibration=_calibration(trace, error, moving),
    )


def _score_brake(trace: Trace, day: Day) -> BrakeScore:
    error = np.abs(trace.values[:, 0] - day.brake_rate)
    asked = np.array([sample.brake_command < 0.0 and sample.speed > _DRIVING for sample in day.samples])
    later = day.time_s >= day.time_s[int(np.argmax(asked))] + _AFTER_BRAKE_S
    return BrakeScore(float(error[later][0]), float(error[later].mean()), _calibration(trace, error, day.braking))


def _calibration(trace: Trace, error: Array, counted: NDArray[np.bool_]) -> Calibration:
    used = counted & trace.usable
    error, std = error[used], trace.std[used]
    inside = [float(np.mean(error <= z * std)) if error.size else math.nan for z in (1.0, _SIGMA_95)]
    return Calibration(inside[0], inside[1], float(np.mean(trace.usable)), trace.cost_us)
