# SPDX-License-Identifier: Apache-2.0
"""Onset times, and the check that an effect at one place shows in all runs."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import Run
from trainid_ros.explain.effects import EffectTerm
from trainid_ros.explain.likelihood import Hyperparameters
from trainid_ros.explain.model import Model
from trainid_ros.explain.noise import Noise, Spread
from trainid_ros.explain.search import is_confirmed_by_other_runs, with_onset
from trainid_ros.train.train_file import TrainFile

SET_IN = 1000
"""Stages before the resistance rises."""
HYPER = Hyperparameters(Noise(0.02, 0.05, 8.0, 0.01), Spread(0.005, 0.01, 0.2), 0.0)


def test_onset_of_a_step_is_within_its_uncertainty(maker: Any, train_file: TrainFile) -> None:
    stage = count()
    runs = maker().runs(6, 61, lambda *_: 0.8 * (next(stage) >= SET_IN))
    stages = np.concatenate([run.time[1:] for run in runs])
    true = float(stages[SET_IN])
    model = Model.of(runs, train_file)
    step = EffectTerm('resistance_step', {'time': true + 40.0, 'a': 0.6})
    fitted = model.with_terms((step,)).fit(HYPER).terms[0]
    found = with_onset(fitted, model, HYPER)
    assert abs(found.parameters['time'] - true) < 3.0 * found.std['time']
    assert found.std['time'] >= fitted.std['time']
    assert found.std['time'] < 60.0
    assert found.parameters['a'] == fitted.parameters['a']


@pytest.mark.parametrize('name', ['traction_scale', 'mass_error'])
def test_effect_without_onset_or_fit_is_unchanged(dragged_model: Model, name: str) -> None:
    term = EffectTerm(name, {'ratio': 1.02}, np.eye(1))
    assert with_onset(term, dragged_model, HYPER) is term
    unfitted = EffectTerm('resistance_step', {'time': 100.0, 'a': 0.5})
    assert with_onset(unfitted, dragged_model, HYPER) is unfitted


DRAG = EffectTerm('local_drag', {'start': 100.0, 'end': 350.0, 'permille': 2.0})


def fitted(runs: list[Run], train_file: TrainFile) -> Model:
    model = Model.of(runs, train_file)
    return model.with_terms((DRAG,)).fit(HYPER)


def test_effect_in_all_runs_is_confirmed(dragged: list[Run], train_file: TrainFile) -> None:
    assert is_confirmed_by_other_runs(fitted(dragged, train_file), 0, HYPER)


def test_effect_in_one_run_of_many_is_not_confirmed(maker: Any, drag_of: Any, train_file: TrainFile) -> None:
    runs = [*maker().runs(6, 71), *maker().runs(7, 72, drag_of(4.0))[6:]]
    assert not is_confirmed_by_other_runs(fitted(runs, train_file), 0, HYPER)


def test_place_passed_by_one_run_only_needs_no_confirmation(maker: Any, drag_of: Any, train_file: TrainFile) -> None:
    assert is_confirmed_by_other_runs(fitted(maker().runs(1, 73, drag_of(4.0)), train_file), 0, HYPER)
