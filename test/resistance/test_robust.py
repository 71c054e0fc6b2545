# SPDX-License-Identifier: Apache-2.0
"""The soft gate against its definition, and drift of three parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.resistance.robust import OUTLIER_WIDTH, DavisPosterior, drifted, gate, predict, weigh

ESTIMATE: DavisPosterior = (1.4, 0.02, 0.01, 0.81, 0.001, -1e-5, 4e-4, 1e-6, 2.5e-5)


def matrix(estimate: DavisPosterior) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    A, B, C, D, E, F = estimate[3:]
    return np.array([[A, B, C], [B, D, E], [C, E, F]])


def test_the_weight_is_the_probability_that_an_observation_is_good() -> None:
    nu, S, R, eps = 1.3, 0.4, 0.25, 0.1
    good = 0.9 * math.exp(-0.5 * nu * nu / S) / math.sqrt(2.0 * math.pi * S)
    anything = 0.1 / (OUTLIER_WIDTH * 0.5)
    assert weigh(nu, S, R, eps)[0] == pytest.approx(good / (good + anything), rel=1e-12)
    assert weigh(nu, S, R, eps)[1] == pytest.approx(math.log(good + anything), rel=1e-12)
    # At the gate good and bad are equally likely.
    assert weigh(gate(eps) * 0.5, R, R, eps)[0] == pytest.approx(0.5, abs=1e-9)
    assert gate(0.0) == math.inf


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
