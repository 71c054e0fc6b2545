# SPDX-License-Identifier: Apache-2.0
"""Runs and models that several tests share."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from test.explain.made_runs import TRAIN, Maker, drag
from trainid_ros.explain.dataset import Dataset, Run, assemble
from trainid_ros.explain.likelihood import Hyperparameters
from trainid_ros.explain.model import Model


@pytest.fixture(scope='session')
def dragged() -> list[Run]:
    """Return six runs in alternating directions over a drag of 2.5 per mille from 100 to 350 m."""
    return Maker().runs(6, 42, drag(2.5))


@pytest.fixture(scope='session')
def dragged_model(dragged: list[Run]) -> Model:
    """Return the model of these runs without the drag."""
    return Model.of(dragged, TRAIN)


@pytest.fixture(scope='session')
def dragged_sizes(dragged_model: Model) -> tuple[Hyperparameters, NDArray[np.float64]]:
    """Return the hyperparameters estimated with that model, and their logs."""
    return dragged_model.evidence().maximise()


@pytest.fixture(scope='session')
def dataset() -> Dataset:
    """Return the dataset of three runs that agree with the train file."""
    return assemble(Maker().runs(3, 5), TRAIN)
