# SPDX-License-Identifier: Apache-2.0
"""Kernels on plain floats against matrices."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.estimators.brake_rate.belief import Interval
from trainid_ros.estimators.brake_rate.gaussian import Cov, Mean, anchored, drift, mixed, predict, update

Array = NDArray[np.float64]
UPPER = np.triu_indices(4)


def matrix(P: Cov) -> Array:
    full = np.zeros((4, 4))
    full[UPPER] = P
    return full + np.triu(full, 1).T


def draw(rng: np.random.Generator) -> tuple[Mean, Cov]:
    A = rng.standard_normal((4, 4))
    v, a, b, f = rng.standard_normal(4).tolist()
    P = (A @ A.T)[UPPER].tolist()
    return (v, a, b, f), (P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8], P[9])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_prediction_and_drift(rng: np.random.Generator) -> None:
    m, P = draw(rng)
    step = Interval(0.2, 0.15, 0.6, -0.05, -0.3, 0.97, 0.01, 1e-3, 2e-3)
    F = np.array([[1.0, 0.15, 0.2, -0.05], [0.0, 0.6, 0.0, -0.3], [0.0, 0.0, 0.97, 0.0], [0.0, 0.0, 0.0, 1.0]])
    mean, cov = predict(m, P, step)
    assert np.allclose(mean, F @ m + [0.01, 0.0, 0.0, 0.0], rtol=1e-12)
    assert np.allclose(matrix(cov), F @ matrix(P) @ F.T + np.diag([1e-3, 0.0, 2e-3, 0.0]), rtol=1e-12)
    # A drift that acts from the start of the interval.
    q = 0.04
    whole = F @ (matrix(P) + np.diag([0.0, 0.0, 0.0, q])) @ F.T + np.diag([1e-3, 0.0, 2e-3, 0.0])
    assert np.allclose(matrix(drift(cov, step.gain_v, step.gain_a, q)), whole, rtol=1e-12)


@pytest.mark.parametrize('learns', [True, False])
def test_update(rng: np.random.Generator, learns: bool) -> None:
    m, P = draw(rng)
    C, r, speed = matrix(P), 0.3, 1.7
    K = C[:, 0] / (C[0, 0] + r)
    if not learns:
        K[3] = 0.0
    A = np.eye(4)
    A[:, 0] -= K
    mean, cov = update(m, P, speed, r, learns=learns)
    assert np.allclose(mean, m + K * (speed - m[0]), rtol=1e-12)
    assert np.allclose(matrix(cov), A @ C @ A.T + r * np.outer(K, K), rtol=1e-10)


def test_a_mixture_has_the_moments_of_its_parts(rng: np.random.Generator) -> None:
    parts = [draw(rng) for _ in range(2)]
    weights = (0.3, 0.7)
    mean, cov = mixed(weights, (parts[0][0], parts[1][0]), (parts[0][1], parts[1][1]))
    centre = sum(w * np.array(m) for w, (m, _) in zip(weights, parts, strict=True))
    spread = sum(
        w * (matrix(P) + np.outer(np.array(m) - centre, np.array(m) - centre))
        for w, (m, P) in zip(weights, parts, strict=True)
    )
    assert np.allclose(mean, centre)
    assert np.allclose(matrix(cov), spread)


def test_an_anchor_ties_the_brake_to_its_rate() -> None:
    mean, cov = anchored(0.9, 0.04, 12.0, -0.5, (0.01, 0.0025, 0.0001))
    assert mean == pytest.approx((12.0, -0.45, 0.0, 0.9))
    C = matrix(cov)
    assert C[1, 1] - C[1, 3] ** 2 / C[3, 3] == pytest.approx(0.0025)
