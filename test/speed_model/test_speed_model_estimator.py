# SPDX-License-Identifier: Apache-2.0
"""The estimator apart from the algorithm: force delay, curve error, disturbances, stops and changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from test.estimators.makers import stepped
from trainid_ros.estimators.settings import AmVffRlsConfig
from trainid_ros.interface.state import encode, restore
from trainid_ros.interface.vectors import vec
from trainid_ros.setup.pipelines import am_vff_rls
from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel, Learned, Tuning
from trainid_ros.speed_model.speed_model_estimator import (
    CurveError,
    Disturbance,
    ForceDelay,
    RecentSamples,
    SpeedModelEstimator,
)
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

NONE = (0.0, 0.0, 0.0, 0.0)
UNIT = (1.0, 0.0, 0.0, 0.0)


def recent(rows: list[tuple[float, float]]) -> RecentSamples:
    samples = RecentSamples()
    for dt, speed in rows:
        samples.add(dt, speed, -speed, 2.0 * speed)
    return samples


def test_a_past_value_is_interpolated_and_limited_to_the_oldest() -> None:
    samples = recent([(math.nan, 1.0), (0.2, 2.0), (0.2, 4.0)])
    expected = [4.0, 4.0, 3.0, 2.0, 1.5, 1.0]
    assert [samples.at(t)[0] for t in (-1.0, 0.0, 0.1, 0.2, 0.3, 9.0)] == pytest.approx(expected)
    assert samples.at(0.3) == pytest.approx((1.5, -1.5, 3.0))
    samples.add(math.nan, 7.0, 0.0, 0.0)
    assert samples.at(0.3)[0] == 7.0


def test_the_last_second_of_samples_is_kept_and_restored() -> None:
    samples, copy = recent([(0.2, float(k)) for k in range(20)]), RecentSamples()
    assert sorted(samples._speeds) == [14.0, 15.0, 16.0, 17.0, 18.0, 19.0]
    assert samples.at(9.0)[0] == 14.0
    restore(copy, encode(samples))
    assert [copy.at(t) for t in (0.1, 0.5, 9.0)] == [samples.at(t) for t in (0.1, 0.5, 9.0)]


def test_changes_of_the_force_reveal_its_delay() -> None:
    rng, late = np.random.default_rng(1), ForceDelay(0.0, 0.15**2)
    for _ in range(50):
        late.sensitivity = 0.0
        assert late.predict(0.9) == pytest.approx(0.81 * late.variance)
        error = 0.9 * (0.2 - late.delay) + 0.03 * float(rng.standard_normal())
        late.update(error, 0.03**2 + late.sensitivity**2 * late.variance, 0.03**2)
    assert late.delay == pytest.approx(0.2, abs=0.02)
    assert math.sqrt(late.variance) < 0.01


@pytest.mark.parametrize('density', [1e-5, 4e-4])
def test_the_strength_of_a_disturbance_is_estimated(density: float) -> None:
    rng, disturbance = np.random.default_rng(2), Disturbance(0.006**2)
    for _ in range(9000):
        disturbance.add(float(rng.normal(0.0, math.sqrt(0.2 * density))), NONE, UNIT, 0.2, 0.0)
    assert disturbance.density == pytest.approx(density, rel=0.6)


def test_window_errors_of_one_sign_indicate_a_change() -> None:
    disturbance = Disturbance(0.01**2)
    for _ in range(450):
        disturbance.add(0.0015, NONE, UNIT, 0.2, 0.0)
    assert disturbance.chi2 > 9.0


def test_the_curve_error_is_estimated_as_by_a_kalman_filter() -> None:
    """For x and the error only: a matrix Kalman filter with two states."""
    tuning = Tuning(0.0, 0.0, 0.0, 1.0, math.inf, 1.0, 1.0, 4.0, 0.0)
    model, curve = AuxiliaryModel((0.0, 1.0, 1e-3, 0.0), (0.0,) * 7 + (1.0, 0.0, 0.0), tuning), CurveError(0.0, 0.04)
    model.start(1e-2)
    model.reinit_speed(10.0, 1e-2)
    P, R, change = np.diag([1e-2, 0.04]), 4e-4, -0.05
    F = np.array([[1.0, change], [0.0, 1.0]])
    curve.predict(model, change, 0.0, 1.0)
    P = F @ P @ F.T
    assert (model.P[0], curve.x) == pytest.approx((P[0, 0], P[0, 1]))
    S, error = P[0, 0] + R, 0.03
    model.correct(error, R)
    curve.update(model, error, S, R)
    K = P[:, 0] / S
    expected = P - np.outer(K, P[0])
    assert (curve.error, curve.x, curve.variance) == pytest.approx((K[1] * error, expected[0, 1], expected[1, 1]))


@pytest.mark.parametrize(('size', 'kept'), [(0.9, 1.0), (2.0, 0.5)])
def test_covariances_shrink_only_as_far_as_the_variances_require(size: float, kept: float) -> None:
    """c = P h has c' P^-1 c = h' P h; beyond the variance of the error it shrinks to it."""
    tuning = Tuning(0.0, 0.0, 0.0, 1.0, math.inf, 1.0, 1.0, 4.0, 0.0)
    model, factor = AuxiliaryModel((0.0, 1.0, 1e-3, 0.0), (1.0,) * 10, tuning), np.random.default_rng(5)
    L = factor.standard_normal((5, 5))
    P, h = L @ L.T, factor.standard_normal(5)
    model.P = vec[float](P.ravel().tolist())
    c = P @ h * size / math.sqrt(h @ P @ h)
    curve = CurveError(0.0, 1.0, *c.tolist())
    curve.bound(model)
    assert (curve.x, curve.a1, curve.a2, curve.b1, curve.d0) == pytest.approx(tuple(kept * c))


Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
CONFIG = AmVffRlsConfig()
# Indices of var(a2), var(b1) and var(d0) in the covariance of theta.
A2, B1, D0 = 4, 7, 9


@pytest.fixture(scope='module')
def powered(journey: Journey) -> list[Sample]:
    return journey(60.0, traction=lambda t: 30.0 if t % 40.0 < 20.0 else 0.0, speed=8.0)


def learned(train_file: TrainFile, samples: list[Sample]) -> SpeedModelEstimator:
    return stepped(am_vff_rls(train_file, CONFIG), samples)


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
