# SPDX-License-Identifier: Apache-2.0
"""Make the simulated bags of ``bags/``: ``yizhuang_day`` and ``tiny`` (the first two runs of another day).

Usage: python -m tools.make_bags [NAME ...]; an existing bag is not overwritten, remove it first.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from typing import Final

import numpy as np

from benchmarks.days import REPOSITORY, TRAIN_FILE, assumed_train, write_bag
from benchmarks.yizhuang_day import RUNS, yizhuang_day
from trainid_ros.sim.scenario import simulate
from trainid_ros.sim.truth import save_truth

# Runs from stop to stop, and the seed of the random numbers.
BAGS: Final = {'yizhuang_day': (RUNS, 2018), 'tiny': (2, 2015)}


def make(name: str) -> None:
    """Simulate one bag and write it with its train file and truth."""
    runs, seed = BAGS[name]
    simulation = simulate(yizhuang_day(assumed_train(), runs=runs), np.random.default_rng(seed))
    folder = write_bag(REPOSITORY / 'bags' / name, simulation.records)
    shutil.copyfile(TRAIN_FILE, folder / 'train.yaml')
    save_truth(simulation.truth, folder / 'truth.yaml')
    print(f'{folder.name}: {len(simulation.records)} messages, {simulation.duration_s:.0f} s')


def main(names: Sequence[str]) -> int:
    """Make the named bags, or all bags."""
    for name in names or BAGS:
        make(name)
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
