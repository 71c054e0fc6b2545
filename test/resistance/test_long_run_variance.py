# SPDX-License-Identifier: Apache-2.0
"""Innovations beyond their variance widen the published covariance; their correlation gives the slow noise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.resistance.normal import Inflation, SlowNoise


def inflation(std: float, rho: float = 0.0, seed: int = 1) -> list[float]:
    """Return the factors for innovations of unit predicted variance."""
    rng, item, x, found = np.random.default_rng(seed), Inflation(), 0.0, []
    for _ in range(20_000):
        x = rho * x + (1.0 - rho * rho) ** 0.5 * float(rng.standard_normal())
        item.add(std * x, 1.0, 1.2)
        found.append(item.factor)
    return found


def test_correct_variances_hardly_inflate_the_covariance() -> None:
    found = inflation(1.0)
    assert min(found) == 1.0
    # A mean of about 15 squares has a standard deviation of a third.
    assert np.mean(found) < 1.25


def test_large_and_correlated_errors_inflate_the_covariance() -> None:
    assert np.mean(inflation(2.0)) == pytest.approx(3.6, rel=0.2)  # 4, reduced by the limit of one batch
    assert np.mean(inflation(1.0, rho=0.5)) == pytest.approx(3.0, rel=0.2)  # (1 + rho) / (1 - rho)


def test_the_contribution_of_one_batch_is_limited() -> None:
    item = Inflation()
    for _ in range(40):
        item.add(1e6, 1.0, 1.2)
    assert item.factor == pytest.approx(2.0)


@pytest.mark.parametrize(('rho', 'expected'), [(0.0, 1.0), (0.6, 4.0), (-0.5, 1.0 / 3.0)])
def test_the_factor_is_long_run_over_marginal_variance(rho: float, expected: float) -> None:
    """AR(1): (1 + rho) / (1 - rho). A batch of 20 contains most of it, and large sums are capped."""
    rng = np.random.default_rng(22)
    slow, x, found = SlowNoise(), 0.0, []
    for _ in range(40_000):
        x = rho * x + math.sqrt(1.0 - rho * rho) * float(rng.standard_normal())
        slow.add(0.3 * x, 0.0, 0.09 * slow.factor, (0.1, 10.0))
        found.append(slow.factor)
    assert float(np.mean(found[2000:])) == pytest.approx(expected, rel=0.25)


def test_one_batch_of_a_step_does_not_count_as_noise() -> None:
    slow = SlowNoise()
    for _ in range(20):
        slow.add(50.0, 0.0, 1.0, (0.1, 10.0))
    assert slow.factor <= 1.5
