# SPDX-License-Identifier: Apache-2.0
"""Gradients given at one point of the train."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.explanation import Verdict
from trainid_ros.explain.gradient_reference import POINTS, preferred_point, read_at
from trainid_ros.explain.model import Model
from trainid_ros.explain.run_data import Run
from trainid_ros.explain.workflow import explain
from trainid_ros.train.train_file import TrainFile

LENGTH = 100.0
BEHIND = LENGTH * (np.arange(100) + 0.5) / 100.0


def hill(position: Any) -> Any:
    """Return the gradient of the fixture's line [per mille in rising position]."""
    return np.where((position > 300.0) & (position < 600.0), 5.0, 0.0)


def mean_excess(point: str) -> Callable[[float, float, int], float]:
    """Return the mean gradient under the train less the gradient given at one of its points."""

    def extra(position: float, _: float, direction: int) -> float:
        under = hill(position - direction * (BEHIND - POINTS[point] * LENGTH)).mean()
        return direction * float(under - hill(position))

    return extra


def model_of(runs: list[Run], train_file: TrainFile) -> Model:
    return Model(EffectEvaluator(assemble(runs, train_file), train_file), train_file)


@pytest.mark.parametrize('point', POINTS)
def test_point_is_found_and_mean_under_train_restored(maker: Any, train_file: TrainFile, point: str) -> None:
    runs = maker().runs(6, 11, mean_excess(point))
    model = model_of(runs, train_file)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) == point
    assert preferred_point(model, hyper, 1e6) is None

    for run in read_at(point, runs, LENGTH):
        middle = run.position - 0.5 * run.direction * run.dt * run.speed
        places = middle[:, None] - run.direction * (BEHIND - POINTS[point] * LENGTH)
        true = run.direction * hill(places).mean(axis=1)
        assert np.abs(run.gradient - true).max() < 1.0
        assert np.abs(run.gradient - true).mean() < 0.1


def test_means_under_the_train_are_recognised(maker: Any, train_file: TrainFile) -> None:
    model = model_of(maker().runs(6, 12), train_file)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) is None


def test_level_track_gives_no_point(maker: Any, train_file: TrainFile) -> None:
    runs = [replace(run, gradient=np.zeros(run.time.size)) for run in maker().runs(4, 13)]
    model = model_of(runs, train_file)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) is None


def test_gradients_at_a_point_cause_no_gap(maker: Any, train_file: TrainFile) -> None:
    reported = explain(maker().runs(8, 14, mean_excess('middle')), train_file)
    assert reported.gradient_point == 'middle'
    assert reported.verdict is Verdict.NO_GAP
