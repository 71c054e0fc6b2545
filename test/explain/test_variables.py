# SPDX-License-Identifier: Apache-2.0
"""Variables that a missing force may depend on: as effects see them, and as the search compares them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from test.explain.made_runs import TRAIN, Maker, evaluated, points
from trainid_ros.explain.model import Model
from trainid_ros.explain.result import Hypothesis, dependence, probabilities
from trainid_ros.explain.search import EffectScorer
from trainid_ros.explain.variables import OF_CURVES, variables


def test_an_effect_sees_each_variable_as_the_fit_does() -> None:
    made = Maker().runs(2, 45)
    bent = [
        replace(run, radius=np.full(run.time.size, 400.0), tunnel=np.heaviside(run.position - 200.0, 1.0))
        for run in made
    ]
    model = Model.of(bent, TRAIN)
    known = [one for one in variables(model) if one.source]
    assert len(known) > 15
    for k, point in enumerate(points(model)):
        for one in known:
            assert evaluated(one.source, at=point) == pytest.approx(one.x[k], abs=1e-9), one.name
            assert evaluated(one.factor_source, at=point) == pytest.approx(one.weight[k]), one.name


def test_what_the_data_do_not_tell_apart_is_no_variable() -> None:
    one_way = [replace(run, positioned=False) for run in Maker().runs(5, 45)[::2]]
    names = {one.name for one in variables(Model.of(one_way, TRAIN))}
    assert {'speed', 'traction', 'run'} <= names
    assert names.isdisjoint({'place', 'traction-place', 'direction', 'traction-rising', 'traction-falling'})


def test_few_knots_cover_the_data() -> None:
    model = Model.of(Maker().runs(3, 5), TRAIN)
    columns = {one.name: one.coarse() for one in variables(model)}
    assert max(column.shape[1] for column in columns.values()) <= 60
    for name, column in columns.items():
        assert column.shape[0] == model.dataset.dt.size
        assert np.isfinite(column).all(), name
    for name in ('run', 'place', 'time', 'speed'):
        np.testing.assert_allclose(columns[name].sum(axis=1), 1.0)


def test_the_search_compares_each_variable_once_but_those_of_curves() -> None:
    model = Model.of(Maker().runs(3, 5), TRAIN)
    _, groups = EffectScorer(model).scores(model, model.evidence().maximise()[0])
    assert sorted(group.name for group in groups) == sorted({one.name for one in variables(model)} - OF_CURVES)


def test_a_learned_curve_is_no_further_cause_beside_its_dependence() -> None:
    """It is the same dependence with more knots, which replaces that of the search if it has more evidence."""
    found, learned = dependence((), 30.0), dependence((), 32.0)
    both, alone = (probabilities([Hypothesis((), 20.0), *of]) for of in ([found, learned], [learned]))
    assert both.other == alone.other
