# SPDX-License-Identifier: Apache-2.0
"""Sections of the line as block sums, and the scores of effects and groups."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.effect_scores import EffectScorer, reduced_information, stretch_sums
from trainid_ros.explain.marginal_likelihood import Hyperparameters
from trainid_ros.explain.model import EffectTerm, Model
from trainid_ros.train.train_file import TrainFile

Found = tuple[Hyperparameters, NDArray[np.float64]]


def test_block_sums_equal_products_of_explicit_columns() -> None:
    rng = np.random.default_rng(4)
    X, y = rng.standard_normal((30, 7)), rng.standard_normal(30)
    first, end = np.triu_indices(8, 1)
    A, b = stretch_sums(X.T @ X, X.T @ y, first, end)
    stretches = np.stack([X[:, i:j].sum(axis=1) for i, j in zip(first, end, strict=True)], axis=1)
    np.testing.assert_allclose(A, np.square(stretches).sum(axis=0))
    np.testing.assert_allclose(b, stretches.T @ y)


def test_true_effect_has_the_greatest_evidence(dragged_model: Model, dragged_sizes: Found) -> None:
    model, (hyper, _) = dragged_model, dragged_sizes
    named, groups = EffectScorer(model).scores(model, hyper)
    assert named[0].name == 'local_drag'
    assert named[0].evidence > 20.0
    assert named[0].parameters['permille'] == pytest.approx(2.5, abs=1.0)
    assert named[0].parameters['start'] == pytest.approx(100.0, abs=120.0)
    assert groups[0].name == 'place'
    for scores in (named, groups):
        evidence = [score.evidence for score in scores]
        assert evidence == sorted(evidence, reverse=True)


BALLAST = """
from trainid_ros.train.effects import EffectKind, Parameter

EFFECT = EffectKind(
    name='new_ballast',
    title='track on new ballast',
    equation='w = value beyond start',
    parameters={'start': Parameter('m'), 'value': Parameter('N/kN')},
    amplitude='value',
    usual=1.0,
    resistance=lambda p, davis, at: p['value'] if at.position >= p['start'] else 0.0,
)
"""


def test_user_effect_is_found_at_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, maker: Any, train_file: TrainFile
) -> None:
    (tmp_path / 'ballast.py').write_text(BALLAST, encoding='utf-8')
    monkeypatch.setenv('TRAINID_EFFECTS', str(tmp_path))
    runs = maker().runs(6, 77, lambda position, _v, _way: 2.0 if position >= 480.0 else 0.0)
    # Positions far above any time of the drive, so that the two cannot be confused.
    runs = [replace(run, position=run.position + 5000.0) for run in runs]
    model = Model(EffectEvaluator(assemble(runs, train_file), train_file), train_file)
    hyper, _ = model.evidence().maximise()
    named, _ = EffectScorer(model).scores(model, hyper)
    assert named[0].name == 'new_ballast'
    assert named[0].parameters['start'] == pytest.approx(5480.0, abs=60.0)
    assert named[0].parameters['value'] == pytest.approx(2.0, abs=0.7)


def test_fixed_effects_leave_more_information(dragged_model: Model, dragged_sizes: Found) -> None:
    """An effect with free parameters absorbs what a similar column would explain."""
    model, (hyper, _) = dragged_model, dragged_sizes
    fitted = model.with_terms((EffectTerm('local_drag', {'start': 110.0, 'end': 340.0, 'permille': 1.8}),)).fit(hyper)
    unit = fitted.evaluator.resistance('local_drag', {**fitted.terms[0].parameters, 'permille': 1.0})
    column = fitted.dataset.column(unit[:, None])
    free = reduced_information(fitted, hyper, column)
    fixed = reduced_information(fitted, hyper, column, terms=False)
    assert float(free.A[0, 0]) < 0.2 * float(fixed.A[0, 0])
