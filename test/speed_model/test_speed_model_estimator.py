# SPDX-License-Identifier: Apache-2.0
"""The estimator apart from the algorithm: stops with and without weighing, changes, and the delay of the force."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.estimators.settings import AmVffRlsConfig
from trainid_ros.setup.pipelines import am_vff_rls
from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel, Learned
from trainid_ros.speed_model.nuisance_parameters import ForceDelay, RecentSamples
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
CONFIG = AmVffRlsConfig()
# Indices of var(a2), var(b1) and var(d0) in the covariance of theta.
A2, B1, D0 = 4, 7, 9


@pytest.fixture(scope='module')
def powered(journey: Journey) -> list[Sample]:
    return journey(60.0, traction=lambda t: 30.0 if t % 40.0 < 20.0 else 0.0, speed=8.0)


def learned(train_file: TrainFile, samples: list[Sample]) -> SpeedModelEstimator:
    estimator = am_vff_rls(train_file, CONFIG)
    for item in samples:
        estimator.step(item)
    return estimator


@pytest.mark.parametrize(('weighed', 'std'), [(True, CONFIG.weighing_std), (False, CONFIG.load_std)])
def test_a_stop_adds_the_error_of_weighing_or_of_the_load(
    train_file: TrainFile, sample: Make, powered: list[Sample], weighed: bool, std: float
) -> None:
    file = replace(train_file, train=replace(train_file.train, mass_std=0.08, force_std=0.0))
    estimator = learned(file, powered)
    start = am_vff_rls(file, CONFIG).method
    prior, b1 = start.covariance(0.0)[B1], start.theta()[2]
    estimator.state.weighed = weighed
    before = estimator.method.covariance(0.0)[B1]
    for k in range(3):
        estimator.step(sample(len(powered) + k, speed=0.0))
    added = (1.0 - before / prior) * (std * b1) ** 2
    assert estimator.method.covariance(0.0)[B1] - before == pytest.approx(added, rel=1e-6, abs=0.0)


def numbers_of(model: AuxiliaryModel) -> list[float]:
    return [*model.z, *model.P, model.mean_error]


def test_window_errors_of_one_sign_cause_forgetting_of_the_resistance_only(
    train_file: TrainFile, powered: list[Sample]
) -> None:
    estimator = learned(train_file, powered)
    model, disturbance = estimator._auxiliary, estimator.state.disturbance
    assert model is not None
    numbers, before, density = numbers_of(model), model.covariance(0.0), disturbance.density
    disturbance.density, disturbance.mean_error = 2e-3, 1.0
    share = 1.1 * math.sqrt(CONFIG.change_threshold / disturbance.chi2)
    disturbance.mean_error = 0.8 * share
    estimator._detect_change(model, density)
    assert (numbers_of(model), disturbance.mean_error) == (numbers, 0.8 * share)
    disturbance.mean_error = share
    estimator._detect_change(model, density)
    after = model.covariance(0.0)
    assert min(after[A2] / before[A2], after[D0] / before[D0]) > 1.01
    assert after[B1] == pytest.approx(before[B1], rel=1e-9)
    assert numbers_of(model)[:5] == numbers[:5]
    # The effect of the change on the windows does not count as gusts.
    assert (disturbance.mean_error, disturbance.density) == (0.0, density)


def test_x_moves_with_a_change_of_the_delay(train_file: TrainFile, powered: list[Sample]) -> None:
    """At 0.8 m/s^2 a delay longer by d lowers x by 0.8 d, minus d times the remaining sensitivity to the delay."""
    estimator = learned(train_file, powered)
    model, estimator._recent = estimator._auxiliary, RecentSamples()
    assert model is not None
    for k in range(6):
        estimator._recent.add(math.nan if k == 0 else 0.2, 10.0 + 0.8 * 0.2 * k, 0.0, 0.0)
    noise, variance, sensitivity, error = estimator.state.noise.variance, 4e-3, 0.5, -0.05
    estimator.state.force_delay = late = ForceDelay(0.3, 0.02, sensitivity)
    numbers = numbers_of(model)
    estimator._learn_delay(model, Learned(11.0, error, 1.0, 1.0, variance))
    longer = 0.02 * sensitivity / variance * error
    assert late.delay - 0.3 == pytest.approx(longer)
    assert abs(longer) > 0.05
    after = numbers_of(model)
    assert after[0] - numbers[0] == pytest.approx((sensitivity * noise / variance - 0.8) * longer)
    assert after[1:] == numbers[1:]
