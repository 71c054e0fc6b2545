# SPDX-License-Identifier: Apache-2.0
"""The product's estimators of the speed model on simulated metro days."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.days import believed_train, samples_of, simulated_day
from benchmarks.papers.seeds import over_seeds
from benchmarks.tables import Table
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import Refusal, SpeedModelEstimate
from trainid_ros.estimators.speed_model.algorithms import SPEED_MODEL
from trainid_ros.estimators.speed_model.parameters import resistance_variance, upper

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.core.samples import Sample
    from trainid_ros.simulation.truth import Truth

NAMES: Final = ('AM-VFF-RLS', 'EKF', 'integral-RLS', 'VFF-RLS', 'AM-VFF-RLS-printed')
_AFTER_S: Final = 300.0
_MOVING: Final = 1.0
_SPEEDS: Final = (10.0, 15.0)


@dataclass(frozen=True, slots=True)
class DayScore:
    """Errors of one estimator on one day.

    Attributes:
        after: Mean |error of w| five minutes after each change, over 10 and 15 m/s and the speed last driven [N/kN].
        mean: Mean |error of w| at the speed driven, after five minutes [N/kN].
        inside: Shares of moving samples with that error within 1 and 1.96 standard deviations.
        valid: Share of the day with an estimate fit to use.

    """

    after: tuple[float, ...]
    mean: float
    inside: tuple[float, float]
    valid: float


def day_table(days: int) -> Table:
    """Return the table of all estimators over some days."""
    scores = over_seeds(score_day, range(5000, 5000 + days))
    rows = tuple(_row(name, [day[k] for day in scores]) for k, name in enumerate(NAMES))
    header = (
        '|error of w|, N/kN',
        'start',
        'rain (a + 0.5)',
        'drag (c + 20 %)',
        'all',
        'mean',
        '68 %',
        '95 %',
        'valid',
    )
    note = (
        f'{days} days, mean ± standard error over days. Columns 1 to 4: five minutes after each change, over 10 m/s, '
        '15 m/s and the speed last driven; "mean": at the speed driven, from five minutes on, changes included. The '
        'bound stands in the section on accuracy.'
    )
    return Table('Metro day: speed model through the product', header, rows, note)


def _row(name: str, scores: Sequence[DayScore]) -> tuple[str, ...]:
    after = np.array([score.after for score in scores])
    columns = [*after.T, after.mean(axis=1), np.array([score.mean for score in scores])]
    inside = np.mean([score.inside for score in scores], axis=0)
    valid = float(np.mean([score.valid for score in scores]))
    shares = (f'{inside[0]:.0%}', f'{inside[1]:.0%}', f'{valid:.0%}')
    return name, *(f'{c.mean():.3f} ± {c.std(ddof=1) / math.sqrt(len(c)):.3f}' for c in columns), *shares


def score_day(seed: int) -> tuple[DayScore, ...]:
    """Run all estimators over one day."""
    day = simulated_day(seed)
    samples = samples_of(day.records)
    return tuple(_score(name, samples, day.truth) for name in NAMES)


def _score(name: str, samples: Sequence[Sample], truth: Truth) -> DayScore:
    estimator = SPEED_MODEL.make(SPEED_MODEL.choose(name), believed_train(), np.random.default_rng(1))
    wrong, z, valid = [], [], []
    now = estimator.estimate(0.0)
    for sample in samples:
        answer = estimator.step(sample)
        now = estimator.estimate(sample.speed) if isinstance(answer, Refusal) else answer
        true = truth.truth_at_ns(sample.stamp_ns).resistance
        wrong.append((now.a - true.a, now.b - true.b, now.c - true.c))
        z.append(_resistance_std(now, sample.speed))
        valid.append(estimator.converged)
    time_s = np.array([(sample.stamp_ns - truth.start_ns) / NS_PER_S for sample in samples])
    speed, errors = np.array([sample.speed for sample in samples]), np.array(wrong)
    after = tuple(_after(time_s, speed, errors, row[0]) for row in truth.resistance)
    counted = (time_s > _AFTER_S) & (speed > _MOVING)
    error = np.abs(errors[:, 0] + speed * (errors[:, 1] + speed * errors[:, 2]))[counted]
    scaled = error / np.array(z)[counted]
    inside = float(np.mean(scaled < 1.0)), float(np.mean(scaled < 1.959964))
    return DayScore(after, float(error.mean()), inside, float(np.mean(valid)))


def _after(time_s: np.ndarray, speed: np.ndarray, errors: np.ndarray, change_s: float) -> float:
    at = min(int(np.searchsorted(time_s, change_s + _AFTER_S)), len(time_s) - 1)
    driven = float(speed[: at + 1][speed[: at + 1] > _MOVING][-1])
    return float(np.mean([abs(float(errors[at] @ (1.0, v, v * v))) for v in (*_SPEEDS, driven)]))


def _resistance_std(now: SpeedModelEstimate, v: float) -> float:
    S = upper(np.array(now.covariance).reshape(4, 4))
    return math.sqrt(max(resistance_variance((now.a1, now.a2, now.b1, now.d0), S, v), 1e-12))
