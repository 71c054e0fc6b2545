# SPDX-License-Identifier: Apache-2.0
"""What ``trainid explain`` finds in the freight run of another simulator if a part of the train file is left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.bag.run_reader import read_runs
from trainid_ros.cli.explain import explain_runs
from trainid_ros.explain.model import Model
from trainid_ros.explain.noise import DAVIS
from trainid_ros.explain.result import Explanation, Verdict
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import TrainFile, load_train_file

BAG = Path(__file__).parents[2] / 'bags' / 'altrios_manifest'


def explained(stated: TrainFile) -> Explanation:
    return explain_runs(read_runs([BAG], stated), stated, [BAG])


def resistance_std(stated: TrainFile, speeds: tuple[float, ...]) -> list[float]:
    """Return standard deviations of the refitted w(v), including the correlations of a, b and c."""
    model = Model.of(read_runs([BAG], stated), stated)
    sizes, _ = model.evidence().maximise()
    _, covariance = model.posterior(sizes)
    powers = np.power.outer(np.array(speeds), np.arange(3.0))
    stds: list[float] = np.sqrt(np.diag(powers @ covariance[DAVIS, DAVIS] @ powers.T)).tolist()
    return stds


@pytest.mark.slow
def test_a_missing_curve_resistance_is_found() -> None:
    full = load_train_file(BAG / 'train.yaml')
    ((_, truth),) = full.effects[0].parameters
    found = explained(replace(full, effects=()))
    assert found.verdict is Verdict.EXPLAINED
    (effect,) = found.effects
    assert effect.name == 'curve_resistance'
    (_, coefficient), (_, std) = *effect.parameters, *effect.std
    assert abs(coefficient - truth) < 2.0 * std < 0.1 * truth
    assert found.gap is not None
    assert found.gap.before > 3.0 * found.gap.noise_floor
    assert found.gap.after <= 1.1 * found.gap.noise_floor


@pytest.mark.slow
def test_a_missing_linear_term_is_absorbed_by_the_refitted_resistance() -> None:
    full = load_train_file(BAG / 'train.yaml')
    stated = replace(full, resistance=replace(full.resistance, b=0.0))
    truth = load_truth(BAG / 'truth.yaml').truth_at(0.0).resistance
    found = explained(stated)
    # a, b and c are always fitted along, so none of them can be missing.
    assert found.verdict is Verdict.NO_GAP
    assert found.effects == ()
    speeds = (7.0, 20.0)  # where the train drove; b alone cannot be determined from that
    for speed, std in zip(speeds, resistance_std(stated, speeds), strict=True):
        assert abs(davis(found.train_file.resistance, speed) - davis(truth, speed)) < 2.0 * std < 0.1
        assert abs(davis(stated.resistance, speed) - davis(truth, speed)) > 2.0 * std
