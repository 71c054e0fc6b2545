# SPDX-License-Identifier: Apache-2.0
"""Multi-innovation steps against batch least squares written here."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.estimators.resistance.multi_innovation import Belief, multi_innovation_step
from trainid_ros.estimators.resistance.speed_window import WindowResult

Array = NDArray[np.float64]


def observations(count: int, seed: int) -> list[WindowResult]:
    """Noisy observations at speeds from 2 to 22 m/s, each with its own noise."""
    rng = np.random.default_rng(seed)
    out = []
    for v in rng.uniform(2.0, 22.0, count).tolist():
        std = float(rng.uniform(0.2, 1.0))
        y = 1.7 + 0.02 * v + 0.008 * v * v + std * float(rng.standard_normal())
        out.append(WindowResult(y, (1.0, v, v * v), std, 0.0, 0.0, 4.8, speed_min=v, speed_max=v))
    return out


def batch(items: list[WindowResult], variances: list[float], theta0: Array, P0: Array) -> tuple[Array, Array]:
    """Weighted least squares with a Gaussian prior, in the information form."""
    H = np.array([item.phi for item in items])
    W = np.diag(1.0 / np.array(variances))
    y = np.array([item.y for item in items])
    P = np.linalg.inv(np.linalg.inv(P0) + H.T @ W @ H)
    return P @ (np.linalg.inv(P0) @ theta0 + H.T @ W @ y), P


def scaled_error(found: Belief, theta: Array, P: Array) -> float:
    """Largest difference of theta in standard deviations, and of P relative to them."""
    x, Q = found.arrays()
    std = np.sqrt(np.diag(P))
    return float(max(np.max(np.abs(x - theta) / std), np.max(np.abs(Q - P) / np.outer(std, std))))


@pytest.mark.parametrize('p', [1, 2, 4, 6])
def test_p_uses_at_p_times_the_variance_weigh_exactly_once(p: int) -> None:
    items = observations(60, seed=p)
    theta0, P0 = np.array([1.4, 0.0, 0.01]), np.diag([0.9, 0.02, 0.005]) ** 2
    belief = Belief.of(theta0, P0)
    # The stack slides over all observations, in at the start and out at the end: each is used p times.
    for end in range(1, len(items) + p):
        stack = items[max(0, end - p) : min(end, len(items))]
        belief = multi_innovation_step(belief, stack, [p * item.noise_std**2 for item in stack])
    theta, P = batch(items, [item.noise_std**2 for item in items], theta0, P0)
    assert scaled_error(belief, theta, P) < 1e-9


@pytest.mark.parametrize('penalty', [0.06, 1.0, 50.0])
def test_one_innovation_from_a_ridge_prior_is_the_ridge_regression_of_the_paper(penalty: float) -> None:
    """Eq. (7) of Liu et al.: (Phi' Phi + lambda I)^-1 Phi' Y, at every step and not only at the last."""
    items = observations(80, seed=7)
    belief = Belief.of(np.zeros(3), np.eye(3) / penalty)
    for count, item in enumerate(items, start=1):
        belief = multi_innovation_step(belief, (item,), (1.0,))
        H = np.array([x.phi for x in items[:count]])
        y = np.array([x.y for x in items[:count]])
        information = H.T @ H + penalty * np.eye(3)
        theta, P = np.linalg.solve(information, H.T @ y), np.linalg.inv(information)
        assert scaled_error(belief, theta, P) < 1e-9


def test_one_innovation_is_recursive_least_squares() -> None:
    items = observations(80, seed=8)
    theta, P = np.array([1.4, 0.0, 0.01]), np.diag([0.9, 0.02, 0.005]) ** 2
    belief = Belief.of(theta, P)
    for item in items:
        variance = item.noise_std**2
        belief = multi_innovation_step(belief, (item,), (variance,))
        h = np.array(item.phi)
        K = P @ h / (variance + h @ P @ h)
        theta, P = theta + K * (item.y - h @ theta), P - np.outer(K, h @ P)
    assert scaled_error(belief, theta, P) < 1e-9


def test_covariance_stays_symmetric_and_positive_over_many_equal_observations() -> None:
    item = WindowResult(3.0, (1.0, 15.0, 225.0), 0.1, 0.0, 0.0, 4.8, speed_min=15.0, speed_max=15.0)
    belief = Belief.of(np.zeros(3), np.diag([1e6, 1e6, 1e6]))
    for _ in range(3000):
        belief = multi_innovation_step(belief, (item,) * 4, (0.04,) * 4)
    _, P = belief.arrays()
    std = np.sqrt(np.diag(P))
    assert np.all(np.isfinite(std))
    assert np.max(np.abs(P - P.T) / np.outer(std, std)) < 1e-9
    assert np.min(np.linalg.eigvalsh(P / np.outer(std, std))) > -1e-9


def test_a_belief_widens_and_tells_when_it_is_lost() -> None:
    belief = Belief.of(np.array([1.0, 2.0, 3.0]), np.eye(3)).widen(np.diag([1.0, 0.0, 0.5]))
    assert belief.theta == (1.0, 2.0, 3.0)
    assert np.diag(belief.arrays()[1]).tolist() == [2.0, 1.0, 1.5]
    assert belief.is_finite()
    assert not Belief.of(np.array([1.0, np.nan, 3.0]), np.eye(3)).is_finite()
    assert not Belief.of(np.zeros(3), np.full((3, 3), np.inf)).is_finite()
