# SPDX-License-Identifier: Apache-2.0
"""Sizes of noise from data, and what a model costs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.discrepancy.hyper import Evidence, Sizes
from trainid_ros.discrepancy.model import Member, Model, prior_cost
from trainid_ros.discrepancy.nodes import assemble
from trainid_ros.discrepancy.points import Points
from trainid_ros.discrepancy.runs import Run
from trainid_ros.physics.train_file import TrainFile

Found = tuple[Sizes, NDArray[np.float64]]


def evidence_of(runs: list[Run], believed: TrainFile) -> Evidence:
    return Model(Points(assemble(runs, believed), believed), believed).evidence()


def test_noise_is_found(maker: Any, believed: TrainFile) -> None:
    found = [evidence_of(maker(noise=size).runs(2, 51), believed).maximise()[0].noise.speed for size in (0.02, 0.1)]
    assert found == pytest.approx([0.02, 0.1], rel=0.5)


def test_the_maximum_is_one(maker: Any, believed: TrainFile) -> None:
    evidence = evidence_of(maker().runs(2, 52), believed)
    sizes, logs = evidence.maximise()
    assert evidence.at(logs) == pytest.approx(sizes.evidence)
    for k in range(logs.size):
        for move in (-0.5, 0.5):
            beside = logs.copy()
            beside[k] += move
            assert evidence.at(beside) < sizes.evidence + 0.2


def test_an_effect_that_is_there_is_worth_its_cost(dragged_model: Model, dragged_sizes: Found) -> None:
    model, (sizes, logs) = dragged_model, dragged_sizes
    drag = Member('local_drag', {'start': 120.0, 'end': 330.0, 'permille': 2.0})
    fitted = model.having((drag,)).fit(sizes)
    (member,) = fitted.members
    gain = fitted.evidence().at(logs) - model.evidence().at(logs)
    assert gain > prior_cost(member, model.drive) + 20.0
    for name, true in (('start', 100.0), ('end', 350.0), ('permille', 2.5)):
        assert abs(member.parameters[name] - true) < 4.0 * member.std[name]
    assert drag.std == {}
    assert model.members == ()


def test_residual_of_a_model_is_less_the_response_of_its_members(dragged_model: Model) -> None:
    model = dragged_model
    drag = Member('local_drag', {'start': 120.0, 'end': 330.0, 'permille': 2.0})
    response = model.drive.column(model.points.resistance('local_drag', drag.parameters))
    np.testing.assert_allclose(model.having((drag,)).residual, model.residual - response)
    assert model.having((drag,)).having(()).columns.shape == model.columns.shape
    assert model.having((drag,)).without_members.sum() == model.nuisance_columns.shape[1]
    unlikely = Member('local_drag', {'start': 120.0, 'end': 330.0, 'permille': 20.0})
    assert prior_cost(unlikely, model.drive) > prior_cost(drag, model.drive)


def test_excess_is_what_lies_above_the_usual(maker: Any, believed: TrainFile) -> None:
    evidence = evidence_of(maker().runs(3, 5), believed)
    usual = np.log([0.03, 0.12, 8.0, 0.02, 0.005, 0.01, 0.25])
    assert evidence.excess(usual) == evidence.excess(usual - 1.0) == 0.0
    # Worse sensors are no excess; gusts count by how far they drive the speed off.
    assert evidence.excess(usual + np.array([3.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0])) == 0.0
    assert evidence.excess(usual + np.array([0.0, 1.0, -2.0, 0.0, 0.0, 0.0, 0.0])) == pytest.approx(0.0)
    assert evidence.excess(usual + np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.8])) == pytest.approx(12.0)
