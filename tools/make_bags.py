# SPDX-License-Identifier: Apache-2.0
"""Make the simulated bags of ``bags/``: ``yizhuang_day`` and ``tiny`` (the first two runs of another day).

Usage: python -m tools.make_bags [NAME ...]; an existing bag is not overwritten, remove it first.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.yizhuang_day import RUNS, yizhuang_day
from trainid_ros.bag.writer import BagWriter
from trainid_ros.sim.scenario import simulate
from trainid_ros.sim.truth import save_truth
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Sequence

REPOSITORY: Final = Path(__file__).resolve().parents[1]
TRAIN_FILE: Final = REPOSITORY / 'config' / 'trains' / 'yizhuang.yaml'
# Runs from stop to stop, and the seed of the random numbers.
BAGS: Final = {'yizhuang_day': (RUNS, 2018), 'tiny': (2, 2015)}


def make(name: str) -> None:
    """Simulate one bag and write it with its train file and truth."""
    runs, seed = BAGS[name]
    folder = REPOSITORY / 'bags' / name
    simulation = simulate(yizhuang_day(load_train_file(TRAIN_FILE), runs=runs), np.random.default_rng(seed))
    with BagWriter(folder) as writer:
        for record in simulation.records:
            writer.write_record(record)
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
