# SPDX-License-Identifier: Apache-2.0
"""Hyperparameters from data, and the prior cost of effects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.marginal_likelihood import Hyperparameters, MarginalLikelihood
from trainid_ros.explain.model import EffectTerm, Model, prior_cost
from trainid_ros.explain.run_data import Run
from trainid_ros.train.train_file import TrainFile

Found = tuple[Hyperparameters, NDArray[np.float64]]


def evidence_of(runs: list[Run], train_file: TrainFile) -> MarginalLikelihood:
    return Model(EffectEvaluator(assemble(runs, train_file), train_file), train_file).evidence()


def test_noise_is_estimated(maker: Any, train_file: TrainFile) -> None:
    found = [evidence_of(maker(noise=size).runs(2, 51), train_file).maximise()[0].noise.speed for size in (0.02, 0.1)]
    assert found == pytest.approx([0.02, 0.1], rel=0.5)


def test_maximum_is_a_maximum(maker: Any, train_file: TrainFile) -> None:
    evidence = evidence_of(maker().runs(2, 52), train_file)
    hyper, logs = evidence.maximise()
    assert evidence.at(logs) == pytest.approx(hyper.evidence)
    for k in range(logs.size):
        for move in (-0.5, 0.5):
            shifted = logs.copy()
            shifted[k] += move
            assert evidence.at(shifted) < hyper.evidence + 0.2


def test_true_effect_gains_more_than_its_prior_cost(dragged_model: Model, dragged_sizes: Found) -> None:
    model, (hyper, logs) = dragged_model, dragged_sizes
    drag = EffectTerm('local_drag', {'start': 120.0, 'end': 330.0, 'permille': 2.0})
    fitted = model.with_terms((drag,)).fit(hyper)
    (term,) = fitted.terms
    gain = fitted.evidence().at(logs) - model.evidence().at(logs)
    assert gain > prior_cost(term, model.dataset) + 20.0
    for name, true in (('start', 100.0), ('end', 350.0), ('permille', 2.5)):
        assert abs(term.parameters[name] - true) < 4.0 * term.std[name]
    assert drag.std == {}
    assert model.terms == ()


def test_residual_is_reduced_by_the_response_of_effects(dragged_model: Model) -> None:
    model = dragged_model
    drag = EffectTerm('local_drag', {'start': 120.0, 'end': 330.0, 'permille': 2.0})
    response = model.dataset.column(model.evaluator.resistance('local_drag', drag.parameters))
    np.testing.assert_allclose(model.with_terms((drag,)).residual, model.residual - response)
    assert model.with_terms((drag,)).with_terms(()).columns.shape == model.columns.shape
    assert model.with_terms((drag,)).without_terms.sum() == model.nuisance_columns.shape[1]
    unlikely = EffectTerm('local_drag', {'start': 120.0, 'end': 330.0, 'permille': 20.0})
    assert prior_cost(unlikely, model.dataset) > prior_cost(drag, model.dataset)


def test_excess_counts_values_above_the_prior_median(maker: Any, train_file: TrainFile) -> None:
    evidence = evidence_of(maker().runs(3, 5), train_file)
    usual = np.log([0.03, 0.12, 8.0, 0.02, 0.005, 0.01, 0.25])
    assert evidence.excess(usual) == evidence.excess(usual - 1.0) == 0.0
    # Sensor noise and jitter do not count; gusts count by the speed error they cause.
    assert evidence.excess(usual + np.array([3.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0])) == 0.0
    assert evidence.excess(usual + np.array([0.0, 1.0, -2.0, 0.0, 0.0, 0.0, 0.0])) == pytest.approx(0.0)
    assert evidence.excess(usual + np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.8])) == pytest.approx(12.0)
