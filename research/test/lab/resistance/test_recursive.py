# SPDX-License-Identifier: Apache-2.0
"""Recursive least squares against the printed matrix equations and against ridge regression at every step."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_lab.resistance.least_squares import ridge, unpacked
from trainid_lab.resistance.recursive import (
    covariance,
    forget,
    prediction_variance,
    regularised_rls,
    rls,
    shrink,
    start,
)

Array = NDArray[np.float64]
TRUTH = np.array([2.0, 0.06, 1.8e-3])


def observations(seed: int, count: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    v = rng.uniform(20.0, 80.0, count)
    Phi = np.stack([np.ones(count), v, v * v], axis=1)
    return Phi, Phi @ TRUTH + 0.7 * rng.standard_normal(count)


def printed(theta: Array, P: Array, phi: Array, y: float, N: float, penalty: float) -> tuple[Array, Array]:
    """One step of (12)-(16) exactly as printed."""
    Q = N / penalty * P @ np.linalg.inv(N / penalty * np.eye(3) + P)
    L = Q @ phi / (1.0 + phi @ Q @ phi)
    P = (np.eye(3) - np.outer(L, phi)) @ Q
    return theta + L * (y - phi @ theta) - penalty / N * P @ theta, P


@pytest.mark.parametrize('penalty', [1.0, 50.0, 5000.0])
def test_rls_from_p0_over_lambda_is_ridge_at_every_step(penalty: float) -> None:
    Phi, y = observations(21, 300)
    theta, UD = start(1.0 / penalty)
    for t, ((f1, f2, f3), value) in enumerate(zip(Phi.tolist(), y.tolist(), strict=True), 1):
        theta, UD = rls(theta, UD, (f1, f2, f3), value)
        assert np.abs(np.array(theta) - ridge(Phi[:t], y[:t], penalty).theta).max() < 1e-9


def test_regularised_rls_is_the_printed_equations() -> None:
    Phi, y = observations(22, 200)
    theta, UD = start(1e3, 1e-3)
    expected, P_expected = np.full(3, 1e-3), 1e3 * np.eye(3)
    for (f1, f2, f3), value in zip(Phi.tolist(), y.tolist(), strict=True):
        theta, UD = regularised_rls(theta, UD, (f1, f2, f3), value, 50.0 / 200.0)
        expected, P_expected = printed(expected, P_expected, np.array([f1, f2, f3]), value, 200.0, 50.0)
        assert np.array(theta) == pytest.approx(expected, abs=1e-4)
    assert unpacked(covariance(UD)) == pytest.approx(P_expected, rel=1e-4)


@pytest.mark.parametrize(('until', 'share'), [(100, 0.5), (200, 1.0), (400, 2.0)])
def test_the_printed_penalty_grows_with_time(until: int, share: float) -> None:
    Phi, y = observations(23, 400)
    theta, UD = start(1e6)
    for (f1, f2, f3), value in zip(Phi[:until].tolist(), y[:until].tolist(), strict=True):
        theta, UD = regularised_rls(theta, UD, (f1, f2, f3), value, 50.0 / 200.0)
    assert np.array(theta) == pytest.approx(ridge(Phi[:until], y[:until], share * 50.0).theta, abs=1e-5)


def test_no_penalty_changes_nothing() -> None:
    theta, UD = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3, 1.0, 2.0, 3.0)
    assert shrink(theta, UD, 0.0) == (theta, UD)


def test_factors_are_those_of_the_covariance() -> None:
    U, D = np.array([[1.0, 0.1, 0.2], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]]), np.diag([1.0, 2.0, 3.0])
    UD = (0.1, 0.2, 0.3, 1.0, 2.0, 3.0)
    P = U @ D @ U.T
    assert unpacked(covariance(UD)) == pytest.approx(P)
    phi = np.array([1.0, -2.0, 0.5])
    assert prediction_variance(UD, (1.0, -2.0, 0.5)) == pytest.approx(phi @ P @ phi)


def test_the_covariance_stays_positive_without_excitation() -> None:
    theta, UD = start(1e6, 1e-6)
    for _ in range(20_000):
        theta, UD = rls(theta, UD, (1.0, 60.0, 3600.0), 8.0)
    assert min(UD[3:]) > 0.0
    assert prediction_variance(UD, (1.0, 60.0, 3600.0)) == pytest.approx(1.0 / 20_000, rel=1e-3)


def test_forgetting_reduces_the_weight_of_older_observations() -> None:
    Phi, y = observations(24, 100)
    mu = 0.95
    theta, UD = start(1e8)
    for (f1, f2, f3), value in zip(Phi.tolist(), y.tolist(), strict=True):
        theta, UD = rls(theta, forget(UD, mu), (f1, f2, f3), value)
    weights = mu ** np.arange(99, -1, -1)
    root = np.sqrt(weights)[:, None]
    expected = np.linalg.lstsq(root * Phi, root[:, 0] * y, rcond=None)[0]
    assert Phi @ np.array(theta) == pytest.approx(Phi @ expected, abs=1e-4)
