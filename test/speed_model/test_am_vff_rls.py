# SPDX-License-Identifier: Apache-2.0
"""The kernel on [x, theta] compared with matrix algebra; its prior; forgetting by errors of one sign, not by noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from test.speed_model.reference_am_vff_rls import AmVffRls
from trainid_ros.estimators.settings import SpeedModelConfig
from trainid_ros.speed_model.am_vff_rls import (
    AuxiliaryModel,
    Tuning,
    full,
    prior,
    prior_variances_given_b1,
    resistance_variance,
    running_mean,
    to_physical,
    to_speed_model,
)

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


Array = NDArray[np.float64]
THETA, P0 = prior((1.5, 0.03, 0.004), 9.80665 / 1080.0, SpeedModelConfig(), 0.05)
R = 4e-4
SHARE = 0.05
TUNING = Tuning(
    noise=1e-6, drift=1e-9, load=1e-8, share=SHARE, threshold=6.0, scale=50.0, low=0.5, gate=4.0, gate_floor=0.0
)


def matrix(m: AuxiliaryModel) -> Array:
    """Return the covariance of [x, theta], shape (5, 5)."""
    return np.array(list(m.P)).reshape(5, 5)


def state(m: AuxiliaryModel) -> Array:
    return np.array(list(m.z))


def driven(tuning: Tuning = TUNING) -> AuxiliaryModel:
    m = AuxiliaryModel(THETA, P0, tuning)
    m.start(R)
    m.reinit_speed(12.0, R)
    rng = np.random.default_rng(5)
    for k in range(40):
        m.coast(20.0 * (k % 7), 1.0)
        m.correct(float(rng.normal(0.0, 0.02)), R)
    return m


def relative(found: Array, expected: Array) -> float:
    std = np.sqrt(np.diag(expected))
    return float(np.max(np.abs(found - expected) / np.outer(std, std)))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 3.0), st.floats(-0.1, 0.1))
def test_updates_equal_those_of_the_reference(seed: int, period: float, change: float) -> None:
    """Noise, outliers and a change of the speed by ``change`` m/s in each step, which starts forgetting."""
    rng, m = np.random.default_rng(seed), driven()
    reference = AmVffRls(state(m), matrix(m), np.array(full(P0)).reshape(4, 4), TUNING)
    for k in range(60):
        u, scale = float(rng.uniform(-20.0, 60.0)), period * float(rng.uniform(0.5, 1.5))
        outlier = 5.0 if rng.random() < 0.05 else 0.0
        y = m.speed() + (change if k > 20 else 0.0) + 0.02 * float(rng.standard_normal()) + outlier
        found, lam = m.update(y, u, scale, R), reference.update(y, u, scale, R)
        assert found.forgetting == pytest.approx(lam, rel=1e-9)
        assert m.mean_error == pytest.approx(reference.m, rel=1e-6, abs=1e-9)
        std = np.sqrt(np.diag(reference.P))
        assert np.max(np.abs(state(m) - reference.z) / std) < 1e-6
        assert relative(matrix(m), reference.P) < 1e-6


def given_b1(P: Array) -> Array:
    """Return the covariance of a1, a2, d0 given b1, shape (3, 3)."""
    rest = [1, 2, 4]
    return np.array(P[np.ix_(rest, rest)] - np.outer(P[rest, 3], P[rest, 3]) / P[3, 3])


def test_forgetting_scales_information_towards_the_prior_and_keeps_the_mass() -> None:
    m, lam = driven(), 0.7
    m.mean_error = 2.0
    z, before = state(m), matrix(m)
    m.forget(lam)
    assert m.mean_error == 0.0
    after, floor = matrix(m), np.diag(np.reciprocal(prior_variances_given_b1(P0)))
    expected: Array = np.array(np.linalg.inv(lam * np.linalg.inv(given_b1(before)) + (1.0 - lam) * floor))
    assert relative(given_b1(after), expected) < 1e-5
    assert after[3] == pytest.approx(before[3], rel=1e-12)
    assert np.array_equal(state(m), z)
    assert np.array_equal(after, after.T)
    std = np.sqrt(np.diag(after))
    assert np.linalg.eigvalsh(after / np.outer(std, std)).min() > -1e-9


def test_repeated_forgetting_converges_to_the_prior() -> None:
    m, before = driven(), matrix(driven())
    for _ in range(200):
        m.forget(0.8)
    assert relative(given_b1(matrix(m)), np.diag(prior_variances_given_b1(P0))) < 1e-6
    assert matrix(m)[3] == pytest.approx(before[3], rel=1e-9)


def test_the_prior_of_the_davis_parameters_given_the_mass_is_diagonal() -> None:
    P = np.zeros((5, 5))
    P[1:, 1:] = np.array(full(P0)).reshape(4, 4)
    assert relative(given_b1(P), np.diag(prior_variances_given_b1(P0))) < 1e-9


def test_an_anchor_keeps_theta_and_a_stop_widens_only_b1() -> None:
    m = driven()
    z, P = state(m), matrix(m)
    m.reinit_speed(3.0, R)
    assert m.speed() == 3.0
    assert np.array_equal(state(m)[1:], z[1:])
    assert np.array_equal(matrix(m)[1:, 1:], P[1:, 1:])
    assert matrix(m)[0].tolist() == matrix(m)[:, 0].tolist() == [R, 0.0, 0.0, 0.0, 0.0]
    before = matrix(m)
    m.inflate_load_variance(0.5)
    wider = matrix(m) - before
    assert wider[3, 3] == pytest.approx(0.5e-8, rel=1e-6)
    assert np.count_nonzero(wider) == 1


def test_force_uncertainty_widens_only_x() -> None:
    m = driven()
    z, P = state(m), matrix(m)
    m.inflate_speed_variance(1e-4)
    wider = matrix(m) - P
    assert wider[0, 0] == pytest.approx(1e-4, rel=1e-9)
    assert np.count_nonzero(wider) == 1
    assert np.array_equal(state(m), z)


def chi2(errors: list[float]) -> Array:
    mean, found = 0.0, []
    for z in errors:
        mean = running_mean(mean, z, SHARE)
        found.append(mean * mean * (2.0 - SHARE) / SHARE)
    return np.array(found)


def test_white_errors_have_a_mean_chi_square_of_one() -> None:
    z = np.random.default_rng(2).standard_normal(60_000)
    found = chi2(z.tolist())[200:]
    assert found.mean() == pytest.approx(1.0, abs=0.1)
    assert np.mean(found > 6.0) == pytest.approx(0.014, abs=0.008)


def test_a_persistent_error_below_one_standard_deviation_is_detected() -> None:
    z = 0.8 + np.random.default_rng(2).standard_normal(400)
    assert np.mean(chi2(z.tolist())[60:] > 6.0) > 0.9


def test_a_single_outlier_does_not_cause_forgetting() -> None:
    assert chi2([1e6])[0] < 1.0
    assert running_mean(0.0, -1e300, SHARE) == -SHARE * 3.0
