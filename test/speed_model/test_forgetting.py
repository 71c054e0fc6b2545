# SPDX-License-Identifier: Apache-2.0
"""Forgetting reacts to errors of one sign, not to white noise or single outliers."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.speed_model.forgetting import MOST, forgetting_factor, running_mean

SHARE = 0.05


def chi2(errors: list[float]) -> np.ndarray:
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
    assert running_mean(0.0, -1e300, SHARE) == -SHARE * MOST


def test_the_factor_is_one_then_falls_to_its_limit() -> None:
    assert forgetting_factor(6.0, 6.0, 50.0, 0.5) == 1.0
    assert forgetting_factor(11.0, 6.0, 50.0, 0.5) == pytest.approx(0.9)
    assert forgetting_factor(1e9, 6.0, 50.0, 0.5) == 0.5
