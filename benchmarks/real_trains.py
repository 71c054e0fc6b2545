# SPDX-License-Identifier: Apache-2.0
"""Resistance estimation on simulated trains of five worlds, with the unknowns of real operation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.accuracy import resistance_scores
from benchmarks.real_train_tables import paired_table, world_tables
from benchmarks.real_train_trials import COMPARED, PAIRS, Trial, results_of
from benchmarks.seeds import over_seeds
from benchmarks.worlds import CLEAN, FIELD, WORLDS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.tables import Plot, Table

# Seeds from here on were not used during development of the estimators.
FIRST_SEED: Final = 1001


def measure(seeds: int) -> tuple[Table | Plot, ...]:
    """Score all algorithms on one drive per world and seed, and on one Yizhuang day per seed."""
    return measured(range(FIRST_SEED, FIRST_SEED + seeds))


def measured(seeds: Sequence[int]) -> tuple[Table | Plot, ...]:
    """Score all algorithms on drives of these seeds."""
    results = results_of(trials_of(seeds), 'real_trains')
    days = over_seeds(yizhuang_errors, seeds, 'real_trains: Yizhuang days')
    pairs = (paired_table(results, seeds, pair, days) for pair in PAIRS)
    return *world_tables(results, seeds), *pairs


def trials_of(seeds: Sequence[int]) -> tuple[Trial, ...]:
    """Return the drives of all worlds, in the field (all unknowns) and clean (changes of resistance only)."""
    return tuple(Trial(world, seed, unknowns) for unknowns in (FIELD, CLEAN) for seed in seeds for world in WORLDS)


def yizhuang_errors(seed: int) -> dict[str, float]:
    """Return the mean error of w of each algorithm that is compared in pairs on one Yizhuang day [N/kN]."""
    scores = zip(COMPARED, resistance_scores(COMPARED, seed), strict=True)
    return {name: float(np.mean(one.errors)) for name, one in scores}
