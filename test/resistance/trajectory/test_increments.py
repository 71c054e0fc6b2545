# SPDX-License-Identifier: Apache-2.0
"""Variances of increments: white noise, a random walk, and rounding."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.resistance.trajectory.increments import half_variance, rounding_variance
from trainid_ros.resistance.trajectory.pieces import Trajectory


def test_half_variance_of_noise_and_of_a_walk() -> None:
    rng, one = np.random.default_rng(31), np.zeros(20_000, dtype=np.intp)
    assert half_variance(0.2 * rng.standard_normal(one.size), one, 1) == pytest.approx(0.04, rel=0.1)
    walk = np.cumsum(0.1 * rng.standard_normal(one.size))
    assert half_variance(walk, one, 10) == pytest.approx(0.05, rel=0.2)


def test_increments_between_pieces_do_not_count() -> None:
    y = np.repeat(np.array([0.0, 5.0, -3.0]), 3)
    assert half_variance(y, np.repeat(np.arange(3), 3), 2) == 0.0


@pytest.mark.parametrize('quantum', [0.01, 0.28])
def test_rounding_variance_is_that_of_increments_of_rounded_motion(quantum: float) -> None:
    rng = np.random.default_rng(32)
    dt = np.full(20_000, 0.2)
    dt[0] = 0.0
    exact = 30.0 + np.cumsum(0.05 * rng.standard_normal(dt.size))
    spoiled = np.where(rng.random(dt.size) < 0.005, rng.uniform(0.0, 40.0, dt.size), exact)
    rounded = quantum * np.round(spoiled / quantum)
    given = Trajectory(rounded, dt, np.zeros(dt.size), np.zeros(dt.size), 110.0)
    errors = rounded - spoiled
    assert half_variance(errors, np.zeros(dt.size, dtype=np.intp), 100) == pytest.approx(
        rounding_variance(given), rel=0.15
    )
