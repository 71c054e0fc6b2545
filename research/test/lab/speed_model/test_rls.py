# SPDX-License-Identifier: Apache-2.0
"""The algorithms of the paper compared with (5) and (7) written out in their computable order."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from trainid_lab.speed_model.rls import (
    AM_RLS,
    AM_VFF_RLS,
    NO_CLAMP,
    RLS,
    VFF_RLS,
    Rls,
    RlsConfig,
    Tuning,
    learn,
    paper_rls,
)
from trainid_ros.interface.results import Reason, Rejection, SpeedModelEstimate
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Journey = Callable[..., list[Sample]]
THETA = (-1e-5, 0.9999, 0.0018, -0.003)
P0 = (1e-4, 0.0, 0.0, 0.0, 1e-2, 0.0, 0.0, 1e-4, 0.0, 1.0)
CASES = [
    Tuning(1.0, 0.0, NO_CLAMP, 1e9),
    Tuning(1.0, 0.1, NO_CLAMP, 1e9),
    Tuning(0.0, 0.0, NO_CLAMP, 1e9),
    Tuning(0.0, 0.1, 0.97, 1e9),
    Tuning(0.1, 0.03, 0.97, 1e9),
]


@pytest.mark.parametrize('tuning', CASES)
def test_the_recursion_is_the_algorithm_of_the_paper(tuning: Tuning) -> None:
    rng = np.random.default_rng(11)
    u = 30.0 * (np.arange(300) % 40 < 20) - 10.0
    y = 10.0 + np.concatenate([[0.0], np.cumsum(0.0018 * u[:-1])]) + 0.03 * rng.standard_normal(300)
    theta, P = np.array(THETA).reshape(4, 1), np.diag([P0[0], P0[4], P0[7], P0[9]])
    numbers: tuple[float, ...] = (float(y[0]), *THETA, *P0)
    x, factors = float(y[0]), []
    for n in range(1, 300):
        numbers, learned = learn(numbers, float(y[n]), float(u[n - 1]), 1.0, 0.03, tuning)
        phi = np.array([[x * x], [x], [u[n - 1]], [1.0]])
        eps = y[n] - (phi.T @ theta)[0, 0]
        g = (phi.T @ P @ phi)[0, 0]
        lam = max(tuning.low, 1.0 - eps**2 / (tuning.sigma * (1.0 + g))) if tuning.sigma else 1.0
        K = P @ phi / (g + lam)
        theta = theta + K * eps
        P = (np.eye(4) - K @ phi.T) @ P / lam
        x = (phi.T @ theta)[0, 0]
        x += tuning.kappa * (y[n] - x)
        factors.append(lam)
        assert learned.error == pytest.approx(eps, abs=1e-7)
        assert learned.forgetting == pytest.approx(lam, abs=1e-6)
    assert (min(factors) < 0.99) == (tuning.sigma > 0.0)
    std = np.sqrt(np.diag(P))
    assert np.array(numbers[1:5]) == pytest.approx(theta.ravel(), abs=1e-5 * float(std.min()))
    assert numbers[0] == pytest.approx(x, abs=1e-7)


def test_as_printed_the_forgetting_factor_turns_negative() -> None:
    numbers = (10.0, *THETA, *P0)
    assert learn(numbers, 12.0, 0.0, 1.0, 0.02, Tuning(0.0, 1e-3, NO_CLAMP, 1e9))[1].forgetting < 0.0
    assert learn(numbers, 12.0, 0.0, 1.0, 0.02, Tuning(0.0, 1e-3, 0.9, 1e9))[1].forgetting == 0.9


def test_the_gate_rejects_and_predicts() -> None:
    numbers = (10.0, *THETA, *(1e-12 * p for p in P0))
    after, learned = learn(numbers, 12.0, 0.0, 1.0, 0.02, Tuning(0.0, 0.0, 0.9, 5.0))
    assert learned.rejected
    assert after == (learned.predicted, *numbers[1:])
    method = Rls(THETA, P0, AM_RLS)
    method._numbers = numbers
    method.coast(0.0, 1.0)
    assert method.speed() == pytest.approx(learned.predicted)


@pytest.mark.parametrize('config', [RLS, VFF_RLS, AM_RLS, AM_VFF_RLS])
def test_on_a_journey_the_mass_is_estimated_and_few_samples_are_lost(
    train_file: TrainFile, journey: Journey, config: RlsConfig
) -> None:
    estimator = paper_rls(train_file, config)
    answers = [
        step_and_estimate(estimator, item)
        for item in journey(300.0, traction=lambda t: 30.0 if t % 140.0 < 40.0 else 0.0, speed=8.0)
    ]
    used = [a for a in answers if isinstance(a, SpeedModelEstimate)]
    assert len(used) > 1400
    assert all(math.isfinite(sum(e.covariance)) for e in used)
    assert used[-1].mass_factor == pytest.approx(1.08, rel=0.15)


def test_a_diverged_run_restarts(train_file: TrainFile, sample: Callable[..., Sample]) -> None:
    config = replace(AM_VFF_RLS, forgetting_scale=1e-3)
    estimator = paper_rls(train_file, config)
    answers = [step_and_estimate(estimator, sample(i, speed=15.0 + (i % 3))) for i in range(50)]
    assert any(isinstance(a, Rejection) and a.reason is Reason.NUMERICAL for a in answers)
    assert estimator.method.theta()[2] > 0.0
