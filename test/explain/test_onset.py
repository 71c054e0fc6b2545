# SPDX-License-Identifier: Apache-2.0
"""Onset time of an effect: posterior mean over all times, with its uncertainty."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.marginal_likelihood import Hyperparameters
from trainid_ros.explain.model import EffectTerm, Model
from trainid_ros.explain.noise import Noise
from trainid_ros.explain.nuisances import Spread
from trainid_ros.explain.onset import with_onset
from trainid_ros.train.train_file import TrainFile

SET_IN = 1000
"""Stages before the resistance rises."""
HYPER = Hyperparameters(Noise(0.02, 0.05, 8.0, 0.01), Spread(0.005, 0.01, 0.2), 0.0)


def test_onset_of_a_step_is_within_its_uncertainty(maker: Any, train_file: TrainFile) -> None:
    stage = count()
    runs = maker().runs(6, 61, lambda *_: 0.8 * (next(stage) >= SET_IN))
    stages = np.concatenate([run.time[1:] for run in runs])
    true = float(stages[SET_IN])
    model = Model(EffectEvaluator(assemble(runs, train_file), train_file), train_file)
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
