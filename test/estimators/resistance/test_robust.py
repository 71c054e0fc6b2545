# SPDX-License-Identifier: Apache-2.0
"""The soft gate against its definition, and beliefs that drift and mix."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.estimators.resistance.robust import (
    OUTLIER_WIDTH,
    Belief,
    drifted,
    gate,
    mixed,
    predict,
    soft_update,
    weigh,
)

BELIEF: Belief = (1.4, 0.02, 0.01, 0.81, 0.001, -1e-5, 4e-4, 1e-6, 2.5e-5)


def matrix(belief: Belief) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    A, B, C, D, E, F = belief[3:]
    return np.array([[A, B, C], [B, D, E], [C, E, F]])


def test_without_outliers_an_update_is_that_of_recursive_least_squares() -> None:
    v, y, R, slow = 12.0, 5.0, 0.3, 2.0
    found, weight, score = soft_update(BELIEF, v, v * v, y, R, slow, 0.0)
    P, theta, phi = matrix(BELIEF), np.array(BELIEF[:3]), np.array([1.0, v, v * v])
    nu, S = y - phi @ theta, phi @ P @ phi + R
    K = P @ phi / (phi @ P @ phi + slow * R)
    assert weight == 1.0
    assert score == pytest.approx(-0.5 * (nu * nu / S + math.log(2.0 * math.pi * S)), rel=1e-12)
    assert np.array(found[:3]) == pytest.approx(theta + K * nu, rel=1e-9)
    assert matrix(found) == pytest.approx(P - np.outer(K, phi @ P), rel=1e-9)


def test_the_weight_is_the_probability_that_an_observation_is_good() -> None:
    nu, S, R, eps = 1.3, 0.4, 0.25, 0.1
    good = 0.9 * math.exp(-0.5 * nu * nu / S) / math.sqrt(2.0 * math.pi * S)
    anything = 0.1 / (OUTLIER_WIDTH * 0.5)
    assert weigh(nu, S, R, eps)[0] == pytest.approx(good / (good + anything), rel=1e-12)
    assert weigh(nu, S, R, eps)[1] == pytest.approx(math.log(good + anything), rel=1e-12)
    # At the gate good and bad are as likely, where the belief adds no doubt.
    assert weigh(gate(eps) * 0.5, R, R, eps)[0] == pytest.approx(0.5, abs=1e-9)
    assert gate(0.0) == math.inf


@pytest.mark.parametrize('y', [1e3, -1e9, 1e150])
def test_an_outlier_changes_nothing_and_its_score_does_not_sink_further(y: float) -> None:
    found, weight, score = soft_update(BELIEF, 12.0, 144.0, y, 0.3, 1.0, 0.05)
    assert found == BELIEF
    assert weight == 0.0
    assert score == pytest.approx(math.log(0.05 / (OUTLIER_WIDTH * math.sqrt(0.3))))


def test_prediction_is_the_quadratic_form() -> None:
    phi = np.array([1.0, 7.0, 53.0])
    mean, variance = predict(BELIEF, 7.0, 53.0)
    assert mean == pytest.approx(float(phi @ np.array(BELIEF[:3])))
    assert variance == pytest.approx(float(phi @ matrix(BELIEF) @ phi))


def test_a_mixture_has_the_moments_of_samples_drawn_from_it() -> None:
    other: Belief = (2.0, 0.0, 0.012, 0.3, 0.0, 0.0, 1e-4, 0.0, 1e-5)
    rng = np.random.default_rng(5)
    n = 200_000
    draws = [rng.multivariate_normal(b[:3], matrix(b), k) for b, k in ((BELIEF, n // 4), (other, 3 * n // 4))]
    together = np.concatenate(draws)
    found = mixed([BELIEF, other], [2.0, 6.0])
    assert np.array(found[:3]) == pytest.approx(together.mean(axis=0), rel=0.02)
    assert np.diag(matrix(found)) == pytest.approx(together.var(axis=0), rel=0.02)
    assert mixed([BELIEF], [0.3]) == pytest.approx(BELIEF, rel=1e-12)


def test_drift_widens_up_to_the_most_and_keeps_correlations() -> None:
    rates = 1e-3, 1e-6, 1e-7
    some = drifted(BELIEF, rates, 10.0, (9.0, 9.0, 9.0))
    assert np.diag(matrix(some)) - np.diag(matrix(BELIEF)) == pytest.approx([1e-2, 1e-5, 1e-6])
    most = drifted(BELIEF, rates, 1e9, (1.0, 1e-3, 1e-4))
    assert np.diag(matrix(most)) == pytest.approx([1.0, 1e-3, 1e-4])
    assert np.min(np.linalg.eigvalsh(matrix(most))) > 0.0
    assert most[:3] == BELIEF[:3]
