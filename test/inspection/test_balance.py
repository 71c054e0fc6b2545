# SPDX-License-Identifier: Apache-2.0
"""Slopes in the balance of forces."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.inspection.suggestion import PER_MILLE, is_near, nearest_unit, partial_slope, regress

COUNT = 400
TIME = np.array([2.0 * k for k in range(COUNT)], dtype=np.float64)


def columns(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a force, and a gradient that goes with it in part, each of shape (n,)."""
    force, gradient = np.random.default_rng(seed).normal(size=(2, COUNT))
    return force, gradient + 0.5 * force


def test_a_partial_slope_is_that_of_the_whole_regression() -> None:
    force, gradient = columns(0)
    y = 3.0 * force - 0.7 * gradient + 2.0 + 0.1 * np.random.default_rng(1).normal(size=COUNT)
    slope = partial_slope(y, gradient, [force], TIME)
    whole = regress(y, [gradient, force], np.ones(COUNT, dtype=bool))
    assert slope is not None
    assert whole is not None
    assert slope.value == pytest.approx(whole.slopes[0], rel=1e-9)
    less = regress(y, [force], np.ones(COUNT, dtype=bool))
    assert less is not None
    gain = (slope.value * slope.spread) ** 2 / np.var(y)
    assert gain == pytest.approx(whole.share - less.share, rel=1e-6)
    assert slope.share == pytest.approx(gain / (1.0 - less.share), rel=1e-6)


def test_the_standard_deviation_covers_errors_alike_in_time() -> None:
    """An error that lasts for 20 s counts once, not ten times."""
    errors, stds = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        x, noise = (np.repeat(rng.normal(size=COUNT // 10), 10) for _ in range(2))
        slope = partial_slope(0.5 * x + noise, x, [], TIME)
        assert slope is not None
        errors.append(slope.value - 0.5)
        stds.append(slope.std)
    assert float(np.std(errors)) == pytest.approx(float(np.mean(stds)), rel=0.15)


def test_a_column_that_others_explain_has_no_slope() -> None:
    force, _ = columns(2)
    assert partial_slope(force, 2.0 * force + 1.0, [force], TIME) is None


def test_a_slope_names_the_unit_it_is_near() -> None:
    assert [nearest_unit(size, PER_MILLE) for size in (1.4, 7.0, 15.0, 900.0, 100.0)] == [
        *('per_mille', 'percent', 'deg', 'rad', ''),
    ]
    assert is_near(1.59, 1.0)
    assert not is_near(1.61, 1.0)
    assert math.isclose(PER_MILLE['deg'], 17.453, rel_tol=1e-4)
