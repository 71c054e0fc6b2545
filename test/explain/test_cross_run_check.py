# SPDX-License-Identifier: Apache-2.0
"""An effect at one place shows in all runs that pass it."""

from __future__ import annotations

from typing import Any

from trainid_ros.explain.cross_run_check import is_confirmed_by_other_runs
from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.marginal_likelihood import Hyperparameters
from trainid_ros.explain.model import EffectTerm, Model
from trainid_ros.explain.noise import Noise
from trainid_ros.explain.nuisances import Spread
from trainid_ros.explain.run_data import Run
from trainid_ros.train.train_file import TrainFile

HYPER = Hyperparameters(Noise(0.02, 0.05, 8.0, 0.02), Spread(0.005, 0.01, 0.2), 0.0)
DRAG = EffectTerm('local_drag', {'start': 100.0, 'end': 350.0, 'permille': 2.0})


def fitted(runs: list[Run], train_file: TrainFile) -> Model:
    model = Model(EffectEvaluator(assemble(runs, train_file), train_file), train_file)
    return model.with_terms((DRAG,)).fit(HYPER)


def test_effect_in_all_runs_is_confirmed(dragged: list[Run], train_file: TrainFile) -> None:
    assert is_confirmed_by_other_runs(fitted(dragged, train_file), 0, HYPER)


def test_effect_in_one_run_of_many_is_not_confirmed(maker: Any, drag_of: Any, train_file: TrainFile) -> None:
    runs = [*maker().runs(6, 71), *maker().runs(7, 72, drag_of(4.0))[6:]]
    assert not is_confirmed_by_other_runs(fitted(runs, train_file), 0, HYPER)


def test_place_passed_by_one_run_only_needs_no_confirmation(maker: Any, drag_of: Any, train_file: TrainFile) -> None:
    assert is_confirmed_by_other_runs(fitted(maker().runs(1, 73, drag_of(4.0)), train_file), 0, HYPER)
