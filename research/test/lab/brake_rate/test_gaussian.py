# SPDX-License-Identifier: Apache-2.0
"""Kernels of the Gaussian filters compared with the matrices of their model, written out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_lab.brake_rate.kalman import anchored, drift, mixed, predict, recentred, update
from trainid_ros.brake_rate.motion_model import STATES, Start, Transition

Array = NDArray[np.float64]
N, RATE = STATES + 1, STATES
GAINS = (0.1, -0.2, 0.03, 0.02, -0.01, 0.05, 0.04, -0.2)
KEEP = (0.999, 0.998, 0.99, 0.99, 0.98, 1.0, 0.97, 0.5)
Q_E = (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4, 8e-4, 7e-4)
STEP = Transition(0.2, 0.15, 0.6, -0.05, -0.3, 0.97, 0.01, 1e-3, 2e-3, GAINS, KEEP, Q_E)


def draw(rng: np.random.Generator) -> tuple[Array, Array]:
    A = rng.standard_normal((N, N))
    return rng.standard_normal(N), A @ A.T


def transition() -> Array:
    F = np.diag([1.0, 0.6, 0.97, *KEEP, 1.0])
    F[0] = (1.0, 0.15, 0.2, *GAINS, -0.05)
    F[1, RATE] = -0.3
    return F


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_prediction_and_drift(rng: np.random.Generator) -> None:
    m, P = draw(rng)
    F, Q = transition(), np.diag([1e-3, 0.0, 2e-3, *Q_E, 0.0])
    mean, cov = predict(m, P, STEP)
    expected = F @ m
    expected[0] += 0.01
    assert np.allclose(mean, expected, rtol=1e-12)
    assert np.allclose(cov, F @ P @ F.T + Q, rtol=1e-12)
    # The drift acts from the start of the interval.
    q = np.zeros((N, N))
    q[RATE, RATE] = 0.04
    assert np.allclose(drift(cov, STEP.gain_v, STEP.gain_a, 0.04), F @ (P + q) @ F.T + Q, rtol=1e-12)


@pytest.mark.parametrize('learns', [True, False])
def test_update(rng: np.random.Generator, learns: bool) -> None:
    m, P = draw(rng)
    r, speed = 0.3, 1.7
    K = P[:, 0] / (P[0, 0] + r)
    if not learns:
        K[RATE] = 0.0
    A = np.eye(N)
    A[:, 0] -= K
    mean, cov = update(m, P, speed, r, learns=learns)
    assert np.allclose(mean, m + K * (speed - m[0]), rtol=1e-12)
    assert np.allclose(cov, A @ P @ A.T + r * np.outer(K, K), rtol=1e-9, atol=1e-9)


def test_a_mixture_has_the_moments_of_its_parts(rng: np.random.Generator) -> None:
    (m0, P0), (m1, P1) = draw(rng), draw(rng)
    mean, cov = mixed((0.3, 0.7), (m0, m1), (P0, P1))
    d = m1 - m0
    assert np.allclose(mean, 0.3 * m0 + 0.7 * m1)
    assert np.allclose(cov, 0.3 * P0 + 0.7 * P1 + 0.21 * np.outer(d, d))


def test_an_anchor_couples_the_brake_to_f_and_keeps_the_errors(rng: np.random.Generator) -> None:
    m, P = draw(rng)
    mean, cov = anchored(m, P, Start(12.0, -0.5, (0.01, 0.0025, 0.0001), KEEP, Q_E))
    assert mean[:3] == pytest.approx([12.0, -0.5 * m[RATE], 0.0])
    assert mean[3:RATE] == pytest.approx(np.array(KEEP) * m[3:RATE])
    assert cov[RATE, RATE] == P[RATE, RATE]
    assert cov[1, 1] - cov[1, RATE] ** 2 / cov[RATE, RATE] == pytest.approx(0.0025)
    assert np.diag(cov)[3:RATE] == pytest.approx(np.square(KEEP) * np.diag(P)[3:RATE] + np.array(Q_E))
    assert np.min(np.linalg.eigvalsh(cov)) > 0.0


def test_a_new_origin_shifts_only_the_errors(rng: np.random.Generator) -> None:
    m, P = draw(rng)
    moved, _ = recentred(m, P, GAINS)
    assert moved[3:RATE] == pytest.approx(m[3:RATE] - np.array(GAINS))
    assert np.array_equal(moved[[0, 1, 2, RATE]], m[[0, 1, 2, RATE]])
