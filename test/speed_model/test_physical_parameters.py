# SPDX-License-Identifier: Apache-2.0
"""The map between speed model and physical parameters, and the prior of theta."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.estimators.settings import SpeedModelConfig
from trainid_ros.speed_model.am_vff_rls import full, prior, resistance_variance, to_physical, to_speed_model

T = 0.2
DAVIS, K = (1.7, 0.02, 0.0086), 9.80665 / 1080.0


def test_the_map_is_forward_euler_and_invertible() -> None:
    theta = to_speed_model(DAVIS, K)
    x, u = 14.0, 25.0
    stepped = x + T * K * (u - (1.7 + 0.02 * x + 0.0086 * x * x))
    assert theta[0] * x * x + theta[1] * x + theta[2] * u + theta[3] == pytest.approx(stepped, rel=1e-15)
    # 1 - a2 loses digits: a2 is 1 - 4e-5.
    assert to_physical(theta, K) == pytest.approx((*DAVIS, 1.0), rel=1e-10)


def test_the_prior_follows_from_the_settings() -> None:
    """Monte Carlo with a tenth of the standard deviations, where the map is linear; the covariance is scaled back."""
    config, davis = SpeedModelConfig(), (1.5, 0.03, 0.004)
    rng = np.random.default_rng(3)
    n = 100_000
    floors = (config.prior_std_a, config.prior_std_b, config.prior_std_c)
    a, b, c = (
        v + 0.1 * math.hypot(config.prior_share * v, s) * rng.standard_normal(n)
        for v, s in zip(davis, floors, strict=True)
    )
    scale = 1.0 + 0.1 * 0.05 * rng.standard_normal(n)
    thetas = np.stack([-T * K * c, 1.0 - T * K * b, T * K * scale, -T * K * a])
    theta0, P0 = prior(davis, K, config, 0.05)
    found = np.array(full(P0)).reshape(4, 4)
    std = np.sqrt(np.diag(found))
    assert theta0 == to_speed_model(davis, K)
    assert np.cov(thetas) * 100.0 / np.outer(std, std) == pytest.approx(found / np.outer(std, std), abs=0.02)


def test_a_symmetric_matrix_survives_the_round_trip() -> None:
    rng = np.random.default_rng(1)
    A = rng.standard_normal((4, 4))
    assert np.array(full(tuple((A + A.T)[np.triu_indices(4)].tolist()))).reshape(4, 4) == pytest.approx(A + A.T)


def test_the_variance_of_the_resistance_follows_from_its_jacobian() -> None:
    theta, S = prior(DAVIS, K, SpeedModelConfig(), 0.05)

    def w(t: np.ndarray, v: float) -> float:
        a, b, c, _ = to_physical(tuple(t), K)
        return a + b * v + c * v * v

    for v in (0.5, 12.0, 22.0):
        steps = 1e-4 * np.diag(np.sqrt(np.array(full(S)).reshape(4, 4).diagonal()))
        middle = np.array(theta)
        slope = [(w(middle + h, v) - w(middle - h, v)) / (2.0 * h[i]) for i, h in enumerate(steps)]
        expected = np.array(slope) @ np.array(full(S)).reshape(4, 4) @ slope
        assert resistance_variance(S, v, K) == pytest.approx(expected, rel=1e-6)
