# SPDX-License-Identifier: Apache-2.0
"""Accuracy over simulated days of different seeds, beside what could be had at best."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds import BrakeKalman, ResistanceOracle
from benchmarks.days import believed_train, samples_of, simulated_day
from benchmarks.tables import Table
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import Refusal
from trainid_ros.estimators.brake_rate.gsma import Gsma, GsmaConfig
from trainid_ros.estimators.resistance.vmils import VMils, VMilsConfig
from trainid_ros.estimators.speed_model.am_vff_rls import AmVffRls, AmVffRlsConfig

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.core.samples import Sample
    from trainid_ros.simulation.truth import Truth

Array = NDArray[np.float64]

SEEDS: Final = tuple(range(101, 113))
_SPEEDS: Final = (10.0, 15.0)
_AFTER_CHANGE_S: Final = 300.0
_AFTER_BRAKE_S: Final = 7.0
_MOVING: Final = 1.0
# Slower than this a brake that is on is one being released at departure.
_DRIVING: Final = 3.0
_CLOSE: Final = 0.1
# Two-sided normal quantile of 95 %.
_SIGMA_95: Final = 1.959964
_CHANGES: Final = ('start', 'rain (a + 0.5)', 'drag (c + 20 %)')


@dataclass(frozen=True, slots=True)
class Trace:
    """An estimate at every sample: values of shape (n, k), standard deviations of shape (n,), fit to use or not.

    For the resistance the values are a, b, c and the deviation is that of w at the current speed.
    """

    values: Array
    std: Array
    usable: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ResistanceScore:
    """Errors of w [N/kN] five minutes after each change, and how honest the deviations are.

    Attributes:
        errors: Mean absolute error over 10 m/s, 15 m/s and the current speed, one per change.
        close: Share of all these errors within 0.1 N/kN.
        inside_68: Share of moving, usable samples with w at the current speed within one standard deviation.
        inside_95: The same within 1.96.

    """

    errors: tuple[float, ...]
    close: float
    inside_68: float
    inside_95: float


@dataclass(frozen=True, slots=True)
class BrakeScore:
    """Absolute errors of the brake rate: 7 s after the first brake command on the move, and the mean from then on."""

    early: float
    mean: float
    inside_68: float
    inside_95: float


@dataclass(frozen=True, slots=True)
class SeedScore:
    """All scores of one day."""

    vmils: ResistanceScore
    am_vff_rls: ResistanceScore
    oracle: ResistanceScore
    gsma: BrakeScore
    kalman: BrakeScore


def measure() -> tuple[Table, ...]:
    """Score all seeds on all cores; return the tables."""
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context('spawn')) as pool:
        scores = tuple(pool.map(score_seed, SEEDS))
    return _resistance_table(scores), _brake_table(scores)


def _resistance_table(scores: Sequence[SeedScore]) -> Table:
    rows = (
        _resistance_row('V-MILS', [score.vmils for score in scores], covariance=True),
        _resistance_row('AM-VFF-RLS', [score.am_vff_rls for score in scores], covariance=False),
        _resistance_row('bound: oracle', [score.oracle for score in scores], covariance=True),
    )
    after = tuple(f'after {name}' for name in _CHANGES)
    header = ('|error of w|, N/kN', *after, 'all', f'within {_CLOSE:g}', '68 % band', '95 % band')
    note = (
        f'{len(scores)} seeds, mean ± standard error over seeds. Five minutes after each change, mean over 10 m/s, '
        '15 m/s and the speed last driven. Bands: w at the current speed, all moving samples that were fit to use, '
        'so also right after a change. The oracle is told of every change and forgets all before it.'
    )
    return Table('Resistance', header, rows, note)


def _resistance_row(name: str, scores: Sequence[ResistanceScore], *, covariance: bool) -> tuple[str, ...]:
    errors = np.array([score.errors for score in scores])
    columns = [*errors.T, errors.mean(axis=1)]
    shares = [_percent([s.close for s in scores]), '-', '-']
    if covariance:
        shares[1:] = _percent([s.inside_68 for s in scores]), _percent([s.inside_95 for s in scores])
    return name, *(_spread(column) for column in columns), *shares


def _brake_table(scores: Sequence[SeedScore]) -> Table:
    rows = (
        _brake_row('GSMA', [score.gsma for score in scores]),
        _brake_row('bound: Kalman filter', [score.kalman for score in scores]),
    )
    header = ('|error of the brake rate|', '7 s after the first brake', 'mean after', '68 % band', '95 % band')
    note = (
        'The filter on [v, a, b, f] is exact for the model and settings of GSMA. Bands: all samples that were fit '
        'to use, while braking.'
    )
    return Table('Brake rate', header, rows, note)


def _brake_row(name: str, scores: Sequence[BrakeScore]) -> tuple[str, ...]:
    errors = (_spread(np.array([s.early for s in scores])), _spread(np.array([s.mean for s in scores])))
    return name, *errors, _percent([s.inside_68 for s in scores]), _percent([s.inside_95 for s in scores])


def _spread(values: Array) -> str:
    return f'{values.mean():.4f} ± {values.std(ddof=1) / math.sqrt(len(values)):.4f}'


def _percent(shares: Sequence[float]) -> str:
    values = 100.0 * np.array(shares)
    return f'{values.mean():.1f} ± {values.std(ddof=1) / math.sqrt(len(values)):.1f} %'


def score_seed(seed: int) -> SeedScore:
    """Simulate one day, run everything over it and score it."""
    train, day = believed_train(), simulated_day(seed)
    samples, truth = samples_of(day.records), day.truth
    change_ns = [truth.start_ns + round(row[0] * NS_PER_S) for row in truth.resistance]
    oracle = ResistanceOracle(train, VMilsConfig(), change_ns)
    gsma, braking = _trace_gsma(Gsma(train, GsmaConfig(), np.random.default_rng(seed)), samples)
    kalman = BrakeKalman(train, GsmaConfig())
    return SeedScore(
        vmils=_score_resistance(_trace_vmils(VMils(train, VMilsConfig()), samples), samples, truth),
        am_vff_rls=_score_resistance(_trace_am_vff_rls(AmVffRls(train, AmVffRlsConfig()), samples), samples, truth),
        oracle=_score_resistance(_trace_oracle(oracle, samples), samples, truth),
        gsma=_score_brake(gsma, braking, samples, truth),
        kalman=_score_brake(_trace_kalman(kalman, samples), braking, samples, truth),
    )


def _trace_vmils(estimator: VMils, samples: Sequence[Sample]) -> Trace:
    def row(sample: Sample) -> tuple[float, ...]:
        result = estimator.step(sample)
        now = estimator.estimate(sample.speed) if isinstance(result, Refusal) else result
        return now.a, now.b, now.c, now.resistance_std, float(estimator.converged)

    return _trace(samples, row)


def _trace_am_vff_rls(estimator: AmVffRls, samples: Sequence[Sample]) -> Trace:
    def row(sample: Sample) -> tuple[float, ...]:
        result = estimator.step(sample)
        now = estimator.estimate(sample.speed) if isinstance(result, Refusal) else result
        return now.a, now.b, now.c, math.nan, float(estimator.converged)

    return _trace(samples, row)


def _trace_oracle(oracle: ResistanceOracle, samples: Sequence[Sample]) -> Trace:
    def row(sample: Sample) -> tuple[float, ...]:
        oracle.step(sample)
        phi = np.array([1.0, sample.speed, sample.speed**2])
        return *oracle.theta, math.sqrt(phi @ oracle.P @ phi), 1.0

    return _trace(samples, row)


def _trace_gsma(estimator: Gsma, samples: Sequence[Sample]) -> tuple[Trace, NDArray[np.bool_]]:
    """Return the trace, and at which samples the brake told something about its rate."""
    braking = []

    def row(sample: Sample) -> tuple[float, ...]:
        result = estimator.step(sample)
        now = estimator.estimate(sample.speed) if isinstance(result, Refusal) else result
        braking.append(now.observable)
        return now.brake_rate, now.brake_rate_std, float(estimator.converged)

    return _trace(samples, row), np.array(braking)


def _trace_kalman(kalman: BrakeKalman, samples: Sequence[Sample]) -> Trace:
    limit = GsmaConfig().valid_std

    def row(sample: Sample) -> tuple[float, ...]:
        kalman.step(sample)
        std = math.sqrt(kalman.P[3, 3])
        return float(kalman.x[3]), std, float(std < limit)

    return _trace(samples, row)


def _trace(samples: Sequence[Sample], row: Callable[[Sample], tuple[float, ...]]) -> Trace:
    rows = np.array([row(sample) for sample in samples])
    return Trace(rows[:, :-2], rows[:, -2], rows[:, -1] > 0.5)


def _score_resistance(trace: Trace, samples: Sequence[Sample], truth: Truth) -> ResistanceScore:
    time_s = np.array([(sample.stamp_ns - truth.start_ns) / NS_PER_S for sample in samples])
    speed = np.array([sample.speed for sample in samples])
    points = [truth.truth_at(t).resistance for t in time_s]
    wrong = trace.values - np.array([(point.a, point.b, point.c) for point in points])
    moving = speed >= _MOVING
    errors = []
    for change_s, *_ in truth.resistance:
        at = min(int(np.searchsorted(time_s, change_s + _AFTER_CHANGE_S)), len(samples) - 1)
        driven = float(speed[: at + 1][moving[: at + 1]][-1])
        errors.append([abs(float(wrong[at] @ (1.0, v, v * v))) for v in (*_SPEEDS, driven)])
    counted = moving & trace.usable
    error = np.abs(wrong[:, 0] + speed * (wrong[:, 1] + speed * wrong[:, 2]))[counted] / trace.std[counted]
    return ResistanceScore(
        errors=tuple(float(np.mean(row)) for row in errors),
        close=float(np.mean(np.array(errors) <= _CLOSE)),
        inside_68=float(np.mean(error <= 1.0)),
        inside_95=float(np.mean(error <= _SIGMA_95)),
    )


def _score_brake(trace: Trace, braking: NDArray[np.bool_], samples: Sequence[Sample], truth: Truth) -> BrakeScore:
    time_s = np.array([(sample.stamp_ns - truth.start_ns) / NS_PER_S for sample in samples])
    true = np.array([truth.truth_at(t).brake_rate or math.nan for t in time_s])
    error = np.abs(trace.values[:, 0] - true)
    asked = np.array([sample.brake_command < 0.0 and sample.speed > _DRIVING for sample in samples])
    later = time_s >= time_s[int(np.argmax(asked))] + _AFTER_BRAKE_S
    counted = braking & trace.usable
    scaled = error[counted] / trace.std[counted]
    return BrakeScore(
        early=float(error[later][0]),
        mean=float(error[later].mean()),
        inside_68=float(np.mean(scaled <= 1.0)),
        inside_95=float(np.mean(scaled <= _SIGMA_95)),
    )
