# SPDX-License-Identifier: Apache-2.0
"""The integral form: exact without noise, regressions computed by hand, and no bias, unlike the one-step form."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from trainid_lab.speed_model.integral_rls import (
    IntegralRls,
    IntegralRlsConfig,
    Tuning,
    regression,
    speed_integral_rls,
)
from trainid_ros.estimators.settings import SpeedModelConfig
from trainid_ros.interface.results import Rejection
from trainid_ros.speed_model.am_vff_rls import full, prior
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

K = 9.80665 / 1080.0
THETA, P0 = prior((1.5, 0.03, 0.004), K, SpeedModelConfig(), 0.05)
TUNING = Tuning(window=5, hop=2, kappa=0.3, clip=4.0, noise=0.0, drift=0.0, load=1e-8)


def model(x: float, u: float) -> float:
    a1, a2, b1, d0 = THETA
    return a1 * x * x + a2 * x + b1 * u + d0


def test_without_noise_the_true_model_is_kept_and_its_variance_shrinks() -> None:
    method = IntegralRls(THETA, P0, TUNING)
    x = 8.0
    method.reinit_speed(x, 1e-4)
    for n in range(200):
        u = 30.0 if n % 50 < 25 else -5.0
        x = model(x, u)
        learned = method.update(x, u, 1.0, 1e-4)
        assert learned.error == pytest.approx(0.0, abs=1e-9)
    assert method.theta() == pytest.approx(THETA, rel=1e-9)
    assert method.covariance(1.0)[7] < 0.2 * P0[7]


def test_a_regression_uses_the_change_over_the_window() -> None:
    xs, us = [8.0], [10.0, -3.0, 20.0]
    for u in us:
        xs.append(model(xs[-1], u))
    window = [value for x, u in zip(xs, us, strict=False) for value in (x * x, x, u, 1.0, x + 0.01)]
    error, summed = regression(THETA, tuple(window), xs[3] + 0.05)
    # The model is exact, so only the noise at both ends remains.
    assert error == pytest.approx(0.05 - 0.01, abs=1e-12)
    assert summed == pytest.approx((sum(x * x for x in xs[:3]), sum(xs[:3]), 27.0, 3.0))


def test_a_stop_restarts_the_window_and_widens_b1() -> None:
    method = IntegralRls(THETA, P0, TUNING)
    method.reinit_speed(8.0, 1e-4)
    for _ in range(4):
        method.coast(5.0, 1.0)
    numbers = method._numbers
    assert len(numbers) == 19 + 4 * 5
    method.reinit_speed(0.0, 1e-4)
    method.inflate_load_variance(1.0)
    stopped = method._numbers
    assert len(stopped) == 19
    assert stopped[12] - numbers[12] == pytest.approx(1e-8)


def test_white_noise_causes_no_bias(train_file: TrainFile, journey: Callable[..., list[Sample]]) -> None:
    errors = []
    for seed in range(3):
        estimator = speed_integral_rls(train_file, IntegralRlsConfig())
        for item in journey(400.0, traction=lambda t: 30.0 if t % 140.0 < 40.0 else 0.0, speed=8.0, seed=seed):
            estimator.step(item)
        e = estimator.estimate(0.0)
        errors.append(e.a + 12.0 * e.b + 144.0 * e.c - 2.76)
        assert e.mass_factor == pytest.approx(1.08, rel=0.02)
        assert math.isfinite(sum(e.covariance))
    assert abs(np.mean(errors)) < 0.2


@pytest.mark.parametrize('noise', [0.0, 4e-4])
def test_the_predicted_variance_matches_the_error(noise: float) -> None:
    """Parameters drawn from the prior (a tenth of it), white speed noise, gusts of the modelled size."""
    rng, variance, few = np.random.default_rng(20), 4e-4, tuple(0.01 * p for p in P0)
    tuning = TUNING._replace(window=10, hop=1, noise=noise)
    L = np.linalg.cholesky(np.array(full(few)).reshape(4, 4))  # type: ignore[arg-type]
    early: list[float] = []
    late: list[float] = []
    for _ in range(50):
        a1, a2, b1, d0 = np.array(THETA) + L @ rng.standard_normal(4)
        method, x = IntegralRls(THETA, few, tuning), 8.0  # type: ignore[arg-type]
        method.reinit_speed(x + 0.02 * rng.standard_normal(), variance)
        for n in range(150):
            u = 30.0 if n % 60 < 30 else -5.0
            x = a1 * x * x + a2 * x + b1 * u + d0 + math.sqrt(noise) * rng.standard_normal()
            learned = method.update(x + 0.02 * rng.standard_normal(), u, 1.0, variance)
            (early if n < 20 else late).append(learned.error**2 / learned.variance)
    # From 1000 and 6500 correlated squares; clipping is rare.
    assert np.mean(early) == pytest.approx(1.0, abs=0.2)
    assert np.mean(late) == pytest.approx(1.0, abs=0.1)


def test_the_estimate_becomes_valid_and_its_variance_matches_the_errors(
    train_file: TrainFile, journey: Callable[..., list[Sample]]
) -> None:
    estimator = speed_integral_rls(train_file, IntegralRlsConfig())
    ratios = []
    for item in journey(700.0, traction=lambda t: 30.0 if t % 140.0 < 40.0 else 0.0, speed=8.0, seed=4):
        e = step_and_estimate(estimator, item)
        if not isinstance(e, Rejection):
            ratios.append(e.prediction_error**2 / e.prediction_variance)
    assert estimator.converged
    assert 0.6 < np.mean(ratios) < 1.25


def test_an_outlier_is_clipped_and_a_lasting_change_is_followed() -> None:
    method = IntegralRls(THETA, tuple(1e-6 * p for p in P0), TUNING._replace(noise=3e-6))  # type: ignore[arg-type]
    method.reinit_speed(8.0, 4e-4)
    for _ in range(50):
        method.update(method.speed(), 0.0, 1.0, 4e-4)
    numbers = method._numbers
    std = math.sqrt(method.update(method.speed(), 0.0, 1.0, 4e-4).variance)
    method._numbers = numbers
    learned = method.update(method.speed() + 5.0, 0.0, 1.0, 4e-4)
    assert method.speed() - learned.predicted == pytest.approx(0.3 * 4.0 * std)
    for _ in range(200):
        method.update(13.0, 0.0, 1.0, 4e-4)
    assert method.speed() == pytest.approx(13.0, abs=0.1)
