# SPDX-License-Identifier: Apache-2.0
"""Effect of each unknown of a real train on resistance estimation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.real_train_tables import cost_tables, costs
from benchmarks.real_train_trials import PAIRS, Trial, results_of
from benchmarks.real_trains import FIRST_SEED
from benchmarks.worlds import WORLDS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.tables import Table


def measure(seeds: int) -> tuple[Table, ...]:
    """Score V-MILS and filter-bank with each unknown alone and with all but one."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    results = results_of(trials_of(chosen), 'unknowns')
    return cost_tables(results, chosen)


def trials_of(seeds: Sequence[int]) -> tuple[Trial, ...]:
    """Return all drives to simulate, without duplicates."""
    apart = [
        Trial(world, seed, unknowns, algorithms=PAIRS[0])
        for seed in seeds
        for unknowns, _ in costs().values()
        for world in WORLDS
    ]
    return tuple(dict.fromkeys(apart))
