# SPDX-License-Identifier: Apache-2.0
"""Runs and models that several tests share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

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


@pytest.fixture
def user_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, str], None]:
    """Return a function that adds a user's effect: name, parameters with ``value`` for amplitude, and resistance."""

    def add(name: str, parameters: str, resistance: str) -> None:
        lines = (
            'import math',
            'from trainid_ros.train.effects import EffectKind, Parameter',
            f'EFFECT = EffectKind({name!r}, "of a user", "none", {parameters}, "value", 1.0,',
            f'                    lambda p, davis, at: {resistance})',
        )
        (tmp_path / f'{name}.py').write_text('\n'.join(lines), encoding='utf-8')
        monkeypatch.setenv('TRAINID_EFFECTS', str(tmp_path))

    return add
