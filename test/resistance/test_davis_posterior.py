# SPDX-License-Identifier: Apache-2.0
"""Prediction and drift of the Davis parameters."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.resistance.davis_posterior import (
    DavisPosterior,
    drift_rates,
    drifted,
    largest_std,
    length_under_train,
    predict,
)

ESTIMATE: DavisPosterior = (1.4, 0.02, 0.01, 0.81, 0.001, -1e-5, 4e-4, 1e-6, 2.5e-5)


def matrix(estimate: DavisPosterior) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    A, B, C, D, E, F = estimate[3:]
    return np.array([[A, B, C], [B, D, E], [C, E, F]])


def test_prediction_is_the_quadratic_form() -> None:
    phi = np.array([1.0, 7.0, 53.0])
    mean, variance = predict(ESTIMATE, 7.0, 53.0)
    assert mean == pytest.approx(float(phi @ np.array(ESTIMATE[:3])))
    assert variance == pytest.approx(float(phi @ matrix(ESTIMATE) @ phi))


def test_drift_increases_variances_up_to_the_limit_and_keeps_correlations() -> None:
    rates = 1e-3, 1e-6, 1e-7
    some = drifted(ESTIMATE, rates, 10.0, (9.0, 9.0, 9.0))
    assert np.diag(matrix(some)) - np.diag(matrix(ESTIMATE)) == pytest.approx([1e-2, 1e-5, 1e-6])
    most = drifted(ESTIMATE, rates, 1e9, (1.0, 1e-3, 1e-4))
    assert np.diag(matrix(most)) == pytest.approx([1.0, 1e-3, 1e-4])
    assert np.min(np.linalg.eigvalsh(matrix(most))) > 0.0
    assert most[:3] == ESTIMATE[:3]


def mean_over(length: float, train_length: float) -> float:
    """Return integral over variance of the mean over a train of a process with the autocorrelation exp(-d / length)."""
    u = np.linspace(-train_length, train_length, 200_001)
    weights = (train_length - np.abs(u)) / train_length**2
    variance = float(np.sum(weights * np.exp(-np.abs(u) / length)) * (u[1] - u[0]))
    return length / variance


@pytest.mark.parametrize(('length', 'train_length'), [(250.0, 30.0), (250.0, 650.0), (1000.0, 200.0), (1000.0, 1000.0)])
def test_the_map_error_under_a_train_is_correlated_further(length: float, train_length: float) -> None:
    assert length_under_train(length, train_length) == pytest.approx(mean_over(length, train_length), rel=1e-4)


def test_the_map_error_under_a_short_train_is_that_of_the_map() -> None:
    assert length_under_train(250.0, 1e-9) == pytest.approx(250.0)
    assert length_under_train(250.0, 0.2499) == pytest.approx(length_under_train(250.0, 0.2501), rel=1e-6)


def test_after_an_hour_the_drift_is_its_share_of_the_prior() -> None:
    rates = drift_rates(0.1, (4.0, 1.0, 0.25))
    assert [3600.0 * rate for rate in rates] == pytest.approx([0.04, 0.01, 0.0025])


@pytest.mark.parametrize(
    ('sign', 'driven'),
    [
        (1.0, (3.0, 20.0)),  # largest at the fastest speed
        (-1.0, (3.0, 20.0)),  # a and c make up for each other: largest at an end or in between
        (-1.0, (0.0, 0.0)),  # nothing learned yet
    ],
)
def test_the_largest_deviation_is_that_at_the_worst_speed(sign: float, driven: tuple[float, float]) -> None:
    # w is exact at 15 m/s where the errors of a and c cancel.
    shape = np.array([0.9, 0.0, sign * 0.004])
    P = np.outer(shape, shape) + np.diag([1e-3, 1e-6, 1e-8])
    speeds = np.linspace(*driven, 200)
    phi = np.stack((np.ones(200), speeds, speeds**2))
    stds = np.sqrt(np.einsum('it,ij,jt->t', phi, P, phi))
    covariance = tuple(P.ravel().tolist())
    assert largest_std(covariance, driven, 0.0) == pytest.approx(float(stds.max()), rel=0.01)
    assert largest_std(covariance, driven, 50.0) == 50.0
