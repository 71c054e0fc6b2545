# SPDX-License-Identifier: Apache-2.0
"""Brake rate on independent drives of five kinds of train, clean and with the unknowns of real operation.

GSMA is compared with the IMM, the Kalman filter, a simple least-squares fit with forgetting, and an oracle: the Kalman
filter given the true dead time, lag, resistance, mass, force and gradient, so that only speed noise, gusts and the
variation of the brake rate itself remain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from benchmarks.worlds import CLEAN, FIELD, WORLDS, Drive, drive
from benchmarks.worlds.unknowns import random_of
from benchmarks.worlds.vehicles import KINDS, draw_vehicle
from trainid_ros.brake_rate.motion_model import brake_step
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.setup.pipelines import BRAKE_RATE
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.sample_stream import DriveHistory
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import CommandHistory, davis

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from trainid_ros.estimators.algorithm_registry import Estimator
    from trainid_ros.train.train_file import TrainFile

Array = NDArray[np.float64]

# Seeds from here on were not used during development of the estimators.
_FIRST_SEED: Final = 1001
METHODS: Final = ('GSMA', 'IMM', 'KF')
SIMPLE, ORACLE = 'least squares', 'oracle'
CONDITIONS: Final = {'clean': CLEAN, 'field': FIELD}
# Unknowns that remain for the oracle on field data.
_UNKNOWN_TO_ORACLE: Final = frozenset({'changes', 'gusts', 'quantum', 'wheels', 'brake'})
_AFTER_S: Final = 7.0
_DRIVING: Final = 3.0
_SLOWEST: Final = 0.5
_SOON_MIN: Final = 15.0
# Two-sided normal quantile of 95 %.
_SIGMA_95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class Data:
    """Samples of a drive, and at each the true brake rate, whether the brake acts and whether the train moves."""

    samples: tuple[Sample, ...]
    rate: Array
    braking: NDArray[np.bool_]
    moving: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Score:
    """Scores of one method on one drive.

    Attributes:
        error: Mean absolute error while the brake acts, from 7 s after the first braking on [1].
        inside: Share of these errors within the 95 % band, over samples that are fit to use.
        usable: Share of these samples that are fit to use.
        minutes: Time in motion until the estimate is first fit to use [min]; infinite if it never is.
        braked: Time in motion until 7 s after the first braking [min].

    """

    error: float
    inside: float
    usable: float
    minutes: float
    braked: float


Scores = dict[tuple[str, str, str], Score]


class LeastSquares:
    """Least squares of mean accelerations over five samples on the nominal brake, with forgetting; no track error."""

    def __init__(self, train_file: TrainFile) -> None:
        self._file, self._known = train_file, KnownForce(train_file)
        self._commands, self._target, self._stamp_ns = CommandHistory(), 0.0, 0
        self._rows: list[tuple[float, float, float]] = []
        self.rate, self.P, self._noise = train_file.brake.rate, 0.2**2, 0.02**2

    def step(self, sample: Sample) -> tuple[float, float, float]:
        """Process a sample; return brake rate, its standard deviation and 1 if fit to use."""
        for change in sample.brake_changes:
            self._commands.push(change)
        start_ns, self._stamp_ns = self._stamp_ns or sample.stamp_ns, sample.stamp_ns
        brake = self._file.brake
        motion = brake_step(self._commands, brake.delay, brake.time_constant, start_ns, sample.stamp_ns, self._target)
        nominal, self._target = motion.reach * self._target + motion.gain_v, motion.end_target
        if math.isnan(sample.dt) or sample.speed < _SLOWEST:
            self._rows = []
        else:
            resistance = self._known.track(sample) + davis(self._file.resistance, sample.speed)
            self._rows.append((sample.speed, -resistance / self._known.inertia * sample.dt, nominal))
        if len(self._rows) > 5:
            self._fit(sample.dt)
        std = math.sqrt(self.P)
        return self.rate, std, float(std < 0.05)

    def _fit(self, dt: float) -> None:
        first, *rows = self._rows
        self._rows = [self._rows[-1]]
        nominal = sum(row[2] for row in rows)
        if nominal > -0.1 * dt * len(rows):
            return
        error = rows[-1][0] - first[0] - sum(row[1] for row in rows) - self.rate * nominal
        self._noise += 0.02 * (error * error - self._noise)
        self.P /= 0.99
        gain = self.P * nominal / (self._noise + nominal * nominal * self.P)
        self.rate, self.P = self.rate + gain * error, (1.0 - gain * nominal) * self.P


def measure(seeds: int) -> tuple[Table, ...]:
    """Score all methods in all worlds over the seeds, on all cores; return a table for each condition."""
    return measured(range(_FIRST_SEED, _FIRST_SEED + seeds))


def measured(seeds: Iterable[int]) -> tuple[Table, ...]:
    """Score all methods in all worlds over these seeds."""
    scores = over_seeds(score_seed, seeds)
    return tuple(_table(condition, scores) for condition in CONDITIONS)


def score_seed(seed: int) -> Scores:
    """Return the scores by condition, world and method."""
    scores: Scores = {}
    for world in WORLDS:
        for condition in CONDITIONS:
            scores |= {(condition, world, name): score for name, score in score_drive(world, condition, seed).items()}
    return scores


def score_drive(world: str, condition: str, seed: int) -> dict[str, Score]:
    """Return the scores of all methods on one drive."""
    unknowns = CONDITIONS[condition]
    driven = drive(world, seed, unknowns)
    data, file = data_of(driven), driven.train_file
    rng = partial(np.random.default_rng, seed)
    found = {name: _score(_run(BRAKE_RATE.make(BRAKE_RATE.choose(name), file, rng()), data), data) for name in METHODS}
    simple = LeastSquares(file)
    found[SIMPLE] = _score(np.array([simple.step(sample) for sample in data.samples]), data)
    seen, true_file = oracle_data(world, seed, unknowns, driven)
    true_file = replace(true_file, brake=replace(true_file.brake, timing_std=0.0))
    oracle = BRAKE_RATE.make(BRAKE_RATE.choose('KF', resistance_std=0.0), true_file, rng())
    found[ORACLE] = _score(_run(oracle, seen), seen)
    return found


def data_of(driven: Drive) -> Data:
    """Return the aligned samples of a drive and the truth at each."""
    aligner, motion, truth = Aligner(AlignmentConfig()), DriveHistory(driven.train_file), driven.truth
    events = (event for record in driven.records for event in aligner.push(record))
    samples = tuple(replace(event, motion=motion.follow(event)) for event in events if isinstance(event, Sample))
    at = np.array([truth.index_at(sample.stamp_ns) for sample in samples])
    return Data(samples, truth.brake_rate[at], truth.braking[at], truth.moving[at])


def oracle_data(world: str, seed: int, unknowns: Collection[str], driven: Drive) -> tuple[Data, TrainFile]:
    """Return the samples of the same motion with the truth data given to the oracle, and its train file."""
    known = driven if unknowns == CLEAN else drive(world, seed, _UNKNOWN_TO_ORACLE & set(unknowns))
    vehicle, stated = draw_vehicle(KINDS[world], random_of(world, seed, 'train')), known.train_file
    delay = stated.brake.delay + known.truth.brake_delay_error
    brake = replace(stated.brake, delay=delay, time_constant=vehicle.brake_lag)
    train = replace(stated.train, mass_std=0.0, force_std=0.0)
    data = data_of(known)
    samples = tuple(_with_true_resistance(sample, known) for sample in data.samples)
    return replace(data, samples=samples), replace(stated, train=train, brake=brake)


def _with_true_resistance(sample: Sample, known: Drive) -> Sample:
    a, b, c = known.truth.davis_at(sample.stamp_ns)
    v = sample.speed
    missing = a + b * v + c * v * v - davis(known.train_file.resistance, v)
    return replace(sample, gradient_mean=sample.gradient_mean + missing)


def _run(estimator: Estimator[object], data: Data) -> Array:
    """Return brake rate, its standard deviation and 1 if fit to use after each sample, shape (n, 3)."""
    rows = []
    for sample in data.samples:
        estimator.step(sample)
        now = estimator.estimate(sample.speed)
        rows.append((now.brake_rate, now.brake_rate_std, float(estimator.converged)))  # type: ignore[attr-defined]
    return np.array(rows)


def _score(trace: Array, data: Data) -> Score:
    time_s = np.array([sample.stamp_ns for sample in data.samples]) / NS_PER_S
    speed = np.array([sample.speed for sample in data.samples])
    begin = float(time_s[int(np.argmax(data.braking & (speed > _DRIVING)))]) + _AFTER_S
    counted = data.braking & (speed > _SLOWEST) & (time_s >= begin)
    error, usable = np.abs(trace[:, 0] - data.rate), trace[:, 2] > 0.5
    band = counted & usable
    moved = np.cumsum(np.diff(time_s, prepend=time_s[0]) * data.moving) / 60.0
    return Score(
        error=float(error[counted].mean()),
        inside=float(np.mean(error[band] <= _SIGMA_95 * trace[band, 1])) if band.any() else math.nan,
        usable=float(usable[counted].mean()),
        minutes=float(moved[int(np.argmax(usable))]) if usable.any() else math.inf,
        braked=float(moved[int(np.searchsorted(time_s, begin))]),
    )


def _table(condition: str, scores: Sequence[Scores]) -> Table:
    names = (*METHODS, SIMPLE, ORACLE)
    rows = tuple(
        _row(f'{world}, {name}', [one[condition, world, name] for one in scores]) for world in WORLDS for name in names
    )
    times = ('min to fit to use', 'fit within 15 min', 'min to first braking')
    header = ('|error of the brake rate|', 'mean', '95 % band', 'fit to use', *times)
    note = (
        f'{len(scores)} drives of about an hour in each world, mean ± standard error over drives. Errors count while '
        f'the brake acts, from {_AFTER_S:g} s after the first braking on; band coverage over samples fit to use. '
        'Times are minutes of motion, the longest over all drives. The oracle is given dead time, lag, resistance, '
        'mass, force and gradient. GSMA, IMM and KF model the kinds of error of these worlds but are not given their '
        'sizes.'
    )
    return Table(f'Brake rate in five worlds: {condition}', header, rows, note)


def _row(name: str, scores: Sequence[Score]) -> tuple[str, ...]:
    errors = np.array([score.error for score in scores])
    spread = errors.std(ddof=1) / math.sqrt(len(errors)) if len(errors) > 1 else math.nan
    inside, usable = np.nanmean([s.inside for s in scores]), np.mean([s.usable for s in scores])
    minutes, braked = max(s.minutes for s in scores), max(s.braked for s in scores)
    shown = f'{errors.mean():.4f} ± {spread:.4f}'
    soon = np.mean([s.minutes <= _SOON_MIN for s in scores])
    return name, shown, f'{inside:.1%}', f'{usable:.0%}', f'{minutes:.1f}', f'{soon:.0%}', f'{braked:.1f}'
