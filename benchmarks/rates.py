# SPDX-License-Identifier: Apache-2.0
"""Effect of the topic rates on resistance estimation of a metro."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.real_train_tables import RATES, rate_tables
from benchmarks.real_train_trials import Trial, results_of
from benchmarks.real_trains import FIRST_SEED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.tables import Table


def measure(seeds: int) -> tuple[Table, ...]:
    """Score all algorithms with topics at 1 to 50 Hz, and at mixed rates."""
    chosen = range(FIRST_SEED, FIRST_SEED + seeds)
    results = results_of(trials_of(chosen), 'rates')
    return rate_tables(results, chosen)


def trials_of(seeds: Sequence[int]) -> tuple[Trial, ...]:
    """Return all drives to simulate, without duplicates."""
    return tuple(Trial('metro', seed, rates=rate) for seed in seeds for rate in RATES.values())
