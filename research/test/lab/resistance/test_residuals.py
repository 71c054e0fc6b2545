# SPDX-License-Identifier: Apache-2.0
"""Noise variance, correlation and outliers from residuals."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_lab.resistance.windowed import Residuals


def residuals_of(values: list[float]) -> Residuals:
    residuals = Residuals()
    for value in values:
        residuals = residuals.add(value)
    return residuals


def test_without_residuals_the_variance_is_the_declared_one() -> None:
    assert Residuals().variance(0.8) == pytest.approx(0.64)
    assert Residuals().long_run_variance(0.8) == pytest.approx(0.64)


def test_white_noise_is_estimated_and_has_equal_long_run_variance() -> None:
    residuals = residuals_of((0.5 * np.random.default_rng(80).standard_normal(4000)).tolist())
    assert residuals.variance(2.0) == pytest.approx(0.25, rel=0.1)
    assert residuals.long_run_variance(2.0) == pytest.approx(0.25, rel=0.25)


def test_positive_correlation_raises_and_negative_lowers_the_long_run_variance() -> None:
    noise = np.random.default_rng(81).standard_normal(4000)
    together, alternating = noise[1:] + noise[:-1], noise[1:] - noise[:-1]
    factors = [
        residuals_of(x.tolist()).long_run_variance(1.0) / residuals_of(x.tolist()).variance(1.0)
        for x in (together, alternating)
    ]
    assert factors[0] == pytest.approx(1.0 + 2.0 * 0.5 * 8.0 / 9.0, rel=0.15)
    assert 0.1 <= factors[1] < 0.3


def test_an_outlier_lies_beyond_the_robust_spread() -> None:
    residuals = Residuals()
    for value in np.random.default_rng(82).standard_normal(200):
        assert residuals.is_outlier(40.0, 3.0) is (len(residuals.recent) == 51)
        residuals = residuals.remember(float(value))
    assert not residuals.is_outlier(1.0, 3.0)
    assert residuals.is_outlier(6.0, 3.0)
