# SPDX-License-Identifier: Apache-2.0
"""Multi-innovation steps against an independent batch least squares."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step, posterior_of
from trainid_ros.resistance.davis_posterior import DavisPosterior

Array = NDArray[np.float64]
PRIOR: DavisPosterior = (1.4, 0.0, 0.01, 0.81, 0.001, -1e-5, 4e-4, 1e-6, 2.5e-5)
UPPER = np.triu_indices(3)


def observations(count: int, seed: int) -> tuple[Array, Array, Array]:
    """Speeds from 2 to 22 m/s, observations and their variances."""
    rng = np.random.default_rng(seed)
    v, variance = rng.uniform(2.0, 22.0, count), rng.uniform(0.04, 1.0, count)
    return v, 1.7 + 0.02 * v + 0.008 * v * v + np.sqrt(variance) * rng.standard_normal(count), variance


def matrix(estimate: DavisPosterior) -> Array:
    P = np.zeros((3, 3))
    P[UPPER] = estimate[3:]
    return P + np.triu(P, 1).T


def batch(v: Array, y: Array, weights: Array, prior: DavisPosterior = PRIOR) -> tuple[Array, Array]:
    """Weighted least squares with a Gaussian prior, in the information form."""
    H = np.column_stack([np.ones_like(v), v, v * v])
    before = np.linalg.inv(matrix(prior))
    P = np.asarray(np.linalg.inv(before + H.T @ (weights[:, None] * H)), dtype=np.float64)
    theta = np.asarray(P @ (before @ np.array(prior[:3]) + H.T @ (weights * y)), dtype=np.float64)
    return theta, P


def run(
    v: Array, y: Array, variance: Array, p: int, prior: DavisPosterior = PRIOR, slow: float = 1.0
) -> tuple[float, ...]:
    state, parts = (*information_of(prior), *NOTHING), deque([NOTHING] * p)
    for at, value, R in zip(v.tolist(), y.tolist(), variance.tolist(), strict=True):
        state, newest, _, _ = mils_step(state, parts.popleft(), at, at * at, value, R, slow, 0.0, p)
        parts.append(newest)
    return state[:9]


def scaled_error(found: DavisPosterior, theta: Array, P: Array) -> float:
    """Largest difference of theta in standard deviations, and of P relative to them."""
    std = np.sqrt(np.diag(P))
    differences = np.abs(np.array(found[:3]) - theta) / std
    return float(max(differences.max(), np.max(np.abs(matrix(found) - P) / np.outer(std, std))))


@pytest.mark.parametrize('p', [1, 2, 4, 10])
def test_p_uses_at_p_times_the_variance_have_total_weight_one(p: int) -> None:
    """The newest p - 1 observations have been used only in part: 1/p, 2/p and so on."""
    v, y, variance = observations(80, seed=p)
    used = np.minimum(1.0, np.arange(80, 0, -1) / p)
    assert scaled_error(posterior_of(run(v, y, variance, p)), *batch(v, y, used / variance)) < 1e-9


def test_observations_with_correlated_noise_have_less_weight() -> None:
    v, y, variance = observations(80, seed=3)
    found = posterior_of(run(v, y, variance, 1, slow=2.5))
    assert scaled_error(found, *batch(v, y, 1.0 / (2.5 * variance))) < 1e-9


@pytest.mark.parametrize('penalty', [0.06, 1.0, 50.0])
def test_one_innovation_from_a_ridge_prior_is_the_ridge_regression_of_the_paper(penalty: float) -> None:
    """Eq. (7) of Liu et al.: (Phi' Phi + lambda I)^-1 Phi' Y, at every step and not only at the last."""
    v, y, _ = observations(60, seed=7)
    ridge: DavisPosterior = (0.0, 0.0, 0.0, 1.0 / penalty, 0.0, 0.0, 1.0 / penalty, 0.0, 1.0 / penalty)
    for count in range(1, 61, 7):
        some = v[:count], y[:count], np.ones(count)
        assert scaled_error(posterior_of(run(*some, 1, prior=ridge)), *batch(*some, prior=ridge)) < 1e-9


def test_estimate_and_information_convert_into_each_other() -> None:
    assert posterior_of(information_of(PRIOR)) == pytest.approx(PRIOR, rel=1e-12)
    A, B, C, D, E, F, *h = information_of(PRIOR)
    assert np.array([[A, B, C], [B, D, E], [C, E, F]]) == pytest.approx(np.linalg.inv(matrix(PRIOR)), rel=1e-9)
    assert h == pytest.approx(np.linalg.solve(matrix(PRIOR), np.array(PRIOR[:3])), rel=1e-9)


def test_covariance_stays_positive_over_many_equal_observations() -> None:
    count = 30_000
    found = posterior_of(run(np.full(count, 15.0), np.full(count, 3.0), np.full(count, 0.01), 4))
    P = matrix(found)
    std = np.sqrt(np.diag(P))
    assert np.all(np.isfinite(std))
    assert np.min(np.linalg.eigvalsh(P / np.outer(std, std))) > -1e-9
    assert found[0] + 15.0 * found[1] + 225.0 * found[2] == pytest.approx(3.0, abs=1e-5)
