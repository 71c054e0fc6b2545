# SPDX-License-Identifier: Apache-2.0
"""The kernels on [x, theta] compared with matrix algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.speed_model.auxiliary_model import (
    Moments,
    anchor,
    correct,
    forget,
    moments,
    predict,
    prior_floor,
    widen_load,
    widen_speed,
)
from trainid_ros.speed_model.physical_parameters import SpeedModelConfig, full, prior

Array = NDArray[np.float64]
THETA, P0 = prior((1.5, 0.03, 0.004), 9.80665 / 1080.0, SpeedModelConfig(), 0.05)
R = 4e-4


def matrix(m: Moments) -> Array:
    """Return the covariance of [x, theta], shape (5, 5)."""
    P = np.empty((5, 5))
    P[0] = P[:, 0] = m[5:10]
    P[1:, 1:] = np.array(full(m[10:])).reshape(4, 4)
    return P


def state(m: Moments) -> Array:
    return np.array(m[:5])


def driven(steps: int = 40) -> Moments:
    m = moments(12.0, R, THETA, P0)
    rng = np.random.default_rng(5)
    for k in range(steps):
        m = predict(m, 20.0 * (k % 7), 1.0, 1e-6, 1e-9)
        m = correct(m, float(rng.normal(0.0, 0.02)), R)
    return m


def relative(found: Array, expected: Array) -> float:
    std = np.sqrt(np.diag(expected))
    return float(np.max(np.abs(found - expected) / np.outer(std, std)))


def test_prediction_equals_that_of_the_extended_kalman_filter() -> None:
    m, u, scale, noise, drift = driven(), 15.0, 1.3, 2e-6, 3e-9
    z, P = state(m), matrix(m)

    def step(z: Array) -> Array:
        x, a1, a2, b1, d0 = z
        return np.array([x + scale * (a1 * x * x + (a2 - 1.0) * x + b1 * u + d0), a1, a2, b1, d0])

    # Complex-step differentiation: the Jacobian to machine precision.
    h = 1e-20
    F = np.array([step(z + 1j * h * e).imag / h for e in np.eye(5)]).T
    Q = np.diag([noise * scale, 0.0, 0.0, 0.0, 0.0])
    P[4, 4] += drift * scale
    after = predict(m, u, scale, noise, drift)
    assert state(after) == pytest.approx(step(z), rel=1e-14)
    assert relative(matrix(after), F @ P @ F.T + Q) < 1e-9


def test_correction_equals_that_of_the_kalman_filter() -> None:
    m = predict(driven(), 3.0, 1.0, 1e-6, 0.0)
    P, error = matrix(m), 0.03
    K = P[:, 0] / (P[0, 0] + R)
    after = correct(m, error, R)
    assert state(after) == pytest.approx(state(m) + K * error, rel=1e-13)
    expected = (np.eye(5) - np.outer(K, np.eye(5)[0])) @ P
    assert relative(matrix(after), 0.5 * (expected + expected.T)) < 1e-9


def given_b1(P: Array) -> Array:
    """Return the covariance of a1, a2, d0 given b1, shape (3, 3)."""
    rest = [1, 2, 4]
    return np.array(P[np.ix_(rest, rest)] - np.outer(P[rest, 3], P[rest, 3]) / P[3, 3])


def test_forgetting_scales_information_towards_the_prior_and_keeps_the_mass() -> None:
    m, lam = driven(), 0.7
    after = forget(m, lam, prior_floor(P0))
    C, floor = given_b1(matrix(m)), np.diag(np.reciprocal(prior_floor(P0)))
    expected: Array = np.array(np.linalg.inv(lam * np.linalg.inv(C) + (1.0 - lam) * floor))
    assert relative(given_b1(matrix(after)), expected) < 1e-5
    assert matrix(after)[3] == pytest.approx(matrix(m)[3], rel=1e-12)
    assert state(after) == pytest.approx(state(m), rel=0)
    std = np.sqrt(np.diag(matrix(after)))
    assert np.linalg.eigvalsh(matrix(after) / np.outer(std, std)).min() > -1e-9


def test_repeated_forgetting_converges_to_the_prior() -> None:
    m, before = driven(), matrix(driven())
    for _ in range(200):
        m = forget(m, 0.8, prior_floor(P0))
    assert relative(given_b1(matrix(m)), np.diag(prior_floor(P0))) < 1e-6
    assert matrix(m)[3] == pytest.approx(before[3], rel=1e-9)


def test_the_prior_of_the_davis_parameters_given_the_mass_is_diagonal() -> None:
    P = np.zeros((5, 5))
    P[1:, 1:] = np.array(full(P0)).reshape(4, 4)
    assert relative(given_b1(P), np.diag(prior_floor(P0))) < 1e-9


def test_an_anchor_keeps_theta_and_a_stop_widens_only_b1() -> None:
    m = driven()
    at = anchor(m, 3.0, R)
    assert state(at)[0] == 3.0
    assert at[1:5] == m[1:5]
    assert at[10:] == m[10:]
    assert at[5:10] == (R, 0.0, 0.0, 0.0, 0.0)
    wider = matrix(widen_load(m, 1e-8)) - matrix(m)
    assert wider[3, 3] == pytest.approx(1e-8, rel=1e-6)
    assert np.count_nonzero(wider) == 1


def test_force_uncertainty_widens_only_x() -> None:
    m = driven()
    after = widen_speed(m, 1e-4)
    assert after[5] - m[5] == pytest.approx(1e-4, rel=1e-9)
    assert (*after[:5], *after[6:]) == (*m[:5], *m[6:])


def test_arrays_give_the_same_result_as_floats() -> None:
    single = driven()
    pair: Any = tuple(np.array([x, x]) for x in single)
    floor = prior_floor(P0)

    def all_three(m: Any) -> Array:
        return np.array(forget(correct(predict(m, 4.0, 1.0, 1e-6, 1e-9), 0.01, R), 0.9, floor))

    assert all_three(pair)[:, 1] == pytest.approx(all_three(single), rel=1e-14, abs=0)
