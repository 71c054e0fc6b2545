# SPDX-License-Identifier: Apache-2.0
"""The fit in distance: exact from any start without noise, consistent covariance with noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trainid_lab.resistance.trajectory.levenberg import integrated_least_squares, levenberg
from trainid_lab.resistance.trajectory.newton import NewtonConfig


def test_integrated_least_squares_is_exact_without_noise(ride: Any) -> None:
    x = integrated_least_squares(ride.stages, ride.speed)
    assert np.max(np.abs(x - [*ride.theta, 17.0])) < 1e-9


@pytest.mark.parametrize('seed', range(8))
def test_random_starts_converge_to_the_truth(ride: Any, seed: int) -> None:
    box = NewtonConfig()
    start = np.random.default_rng(seed).uniform(box.low, box.high)
    fit = levenberg(ride.stages, ride.speed, np.array([*start, 17.0]))
    assert fit.converged
    assert np.max(np.abs(fit.theta - ride.theta)) < 1e-9


def test_standard_deviations_are_consistent(ride: Any) -> None:
    rng, nees = np.random.default_rng(11), []
    for _ in range(40):
        fit = levenberg(ride.stages, ride.speed + 0.18 * rng.standard_normal(ride.speed.size))
        e = fit.theta - ride.theta
        nees.append(e @ np.linalg.solve(0.18**2 * fit.covariance[:3, :3], e) / 3.0)
    # Mean of 120 squares of normal numbers: outside 0.6 to 1.5 by chance in one of 10^4 runs.
    assert 0.6 < np.mean(nees) < 1.5


def test_a_fixed_initial_speed_stays_fixed(ride: Any) -> None:
    guess = np.array([*ride.theta, 17.2])
    assert levenberg(ride.stages, ride.speed, guess, free_start=False).start == 17.2
    assert levenberg(ride.stages, ride.speed, guess).start == pytest.approx(17.0, abs=1e-9)
