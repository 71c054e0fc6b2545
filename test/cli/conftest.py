# SPDX-License-Identifier: Apache-2.0
"""One run between two stops as a bag, with its train file and truth, parts of it, and errors in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.records import Record
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.truth import save_truth
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile, dump_train_file

Change = Callable[[Callable[[Record], Record | None]], Path]


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


@pytest.fixture
def changed(driven_bag: Path, tmp_path: Path) -> Change:
    """Return a function that writes the driven bag with each record changed, or left out if that gives None."""

    def write(change: Callable[[Record], Record | None]) -> Path:
        path = tmp_path / 'changed'
        with BagReader(driven_bag) as reader, BagWriter(path) as writer:
            for record in map(change, reader.records()):
                if record is not None:
                    writer.write_record(record)
        return path

    return write


@pytest.fixture
def one_error(capsys: pytest.CaptureFixture[str]) -> Callable[[], str]:
    """Return a function that returns the one line on standard error, with nothing on standard output."""

    def take() -> str:
        out, err = capsys.readouterr()
        assert (out, err.count('\n')) == ('', 1)
        return err.strip()

    return take
