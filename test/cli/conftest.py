# SPDX-License-Identifier: Apache-2.0
"""One run between two stops as a bag, with its train file and truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from trainid_ros.bag.writer import BagWriter
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.truth import save_truth
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile, dump_train_file

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope='session')
def driven_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of about 80 s with ``train.yaml`` and ``truth.yaml`` inside."""
    train = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001), line=Line(stops=(0.0, 900.0)))
    simulation = simulate(Scenario(train, runs=1), np.random.default_rng(3))
    path = tmp_path_factory.mktemp('driven') / 'run'
    with BagWriter(path) as writer:
        for record in simulation.records:
            writer.write_record(record)
    (path / 'train.yaml').write_text(dump_train_file(train), encoding='utf-8')
    save_truth(simulation.truth, path / 'truth.yaml')
    return path
