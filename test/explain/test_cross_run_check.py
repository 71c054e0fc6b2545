# SPDX-License-Identifier: Apache-2.0
"""An effect at one place is there for all trains that pass."""

from __future__ import annotations

from typing import Any

from trainid_ros.explain.cross_run_check import is_seen_by_others
from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.marginal_likelihood import Hyperparameters
from trainid_ros.explain.model import EffectTerm, Model
from trainid_ros.explain.noise import Noise
from trainid_ros.explain.nuisances import Spread
from trainid_ros.explain.run_data import Run
from trainid_ros.train.train_file import TrainFile

SIZES = Hyperparameters(Noise(0.02, 0.05, 8.0, 0.02), Spread(0.005, 0.01, 0.2), 0.0)
DRAG = EffectTerm('local_drag', {'start': 100.0, 'end': 350.0, 'permille': 2.0})


def fitted(runs: list[Run], believed: TrainFile) -> Model:
    model = Model(EffectEvaluator(assemble(runs, believed), believed), believed)
    return model.having((DRAG,)).fit(SIZES)


def test_what_all_runs_meet_has_witnesses(dragged: list[Run], believed: TrainFile) -> None:
    assert is_seen_by_others(fitted(dragged, believed), 0, SIZES)


def test_what_one_run_of_many_meets_has_none(maker: Any, drag_of: Any, believed: TrainFile) -> None:
    runs = [*maker().runs(6, 71), *maker().runs(7, 72, drag_of(4.0))[6:]]
    assert not is_seen_by_others(fitted(runs, believed), 0, SIZES)


def test_a_place_that_one_run_alone_has_passed_needs_none(maker: Any, drag_of: Any, believed: TrainFile) -> None:
    assert is_seen_by_others(fitted(maker().runs(1, 73, drag_of(4.0)), believed), 0, SIZES)
