# SPDX-License-Identifier: Apache-2.0
"""Run the resistance algorithms on one simulated drive and score them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.days import samples_of
from benchmarks.real_train_informed import InformedFilter, information_of
from benchmarks.real_train_scores import answers_of, course_of, score
from benchmarks.seeds import over_seeds
from benchmarks.worlds import FIELD, Rates, drive
from trainid_ros.setup.pipelines import RESISTANCE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from benchmarks.real_train_scores import Score
    from benchmarks.worlds import Drive
    from trainid_ros.estimators.algorithm_registry import Estimator
    from trainid_ros.interface.results import ResistanceEstimate

INFORMED: Final = 'informed filter'
COMPARED: Final = ('V-MILS', 'filter-bank', 'two-window')
PAIRS: Final = (('V-MILS', 'filter-bank'), ('V-MILS', 'two-window'))
ALL: Final = (*COMPARED, 'speed-EKF', INFORMED)
EVERY_TOPIC_5_HZ: Final = Rates()


@dataclass(frozen=True, slots=True)
class Trial:
    """A drive and the algorithms to run on it; see :func:`benchmarks.worlds.drive`."""

    world: str
    seed: int
    unknowns: frozenset[str] = FIELD
    rates: Rates = EVERY_TOPIC_5_HZ
    algorithms: tuple[str, ...] = field(default=ALL, compare=False)
    duration: float | None = field(default=None, compare=False)


def results_of(trials: Sequence[Trial], name: str) -> dict[Trial, Mapping[str, Score]]:
    """Return the scores of all trials, run on all cores; progress is printed under ``name``."""
    return dict(zip(trials, over_seeds(run, trials, f'{name}: drives'), strict=True))


def run(trial: Trial) -> Mapping[str, Score]:
    """Simulate a drive once and score all algorithms on the same samples."""
    ride = drive(trial.world, trial.seed, trial.unknowns, trial.rates, trial.duration)
    samples = samples_of(ride.records)
    course = course_of(ride.truth, np.array([sample.stamp_ns for sample in samples]))
    return {name: score(answers_of(estimator_of(name, ride, trial.seed), samples), course) for name in trial.algorithms}


def estimator_of(name: str, ride: Drive, seed: int) -> Estimator[ResistanceEstimate] | InformedFilter:
    """Return an algorithm for the train of a drive; only the informed filter is given truth data."""
    if name == INFORMED:
        return InformedFilter(ride.train_file, information_of(ride.truth))
    return RESISTANCE.make(RESISTANCE.choose(name), ride.train_file, np.random.default_rng(seed))
