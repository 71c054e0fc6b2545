# SPDX-License-Identifier: Apache-2.0
"""Least squares and its regularised forms against numpy and against their criteria."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_lab.resistance.least_squares import (
    Prior,
    add,
    fit_with_prior,
    least_squares,
    ridge,
    solve,
    unpacked,
)
from trainid_lab.resistance.recursive import covariance
from trainid_ros.interface.errors import NoAnswerError

Array = NDArray[np.float64]
TRUTH = np.array([2.0, 0.06, 1.8e-3])


def observations(seed: int, count: int = 200, noise: float = 0.5) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    v = rng.uniform(20.0, 80.0, count)
    Phi = np.stack([np.ones(count), v, v * v], axis=1)
    return Phi, Phi @ TRUTH + noise * rng.standard_normal(count)


def test_least_squares_is_that_of_numpy() -> None:
    Phi, y = observations(1)
    assert least_squares(Phi, y).theta == pytest.approx(np.linalg.lstsq(Phi, y, rcond=None)[0], rel=1e-9)


def test_an_integer_weight_equals_repeated_observations() -> None:
    Phi, y = observations(2, 30)
    counts = np.random.default_rng(4).integers(1, 5, 30)
    repeated = least_squares(np.repeat(Phi, counts, axis=0), np.repeat(y, counts))
    assert least_squares(Phi, y, counts.astype(float)).theta == pytest.approx(repeated.theta, rel=1e-9)


@pytest.mark.parametrize('penalty', [0.5, 50.0, 5000.0])
def test_ridge_minimises_the_sum_with_the_full_penalty(penalty: float) -> None:
    Phi, y = observations(3)
    theta = ridge(Phi, y, penalty).theta

    def gradient(share: float) -> Array:
        slope: Array = -2.0 * Phi.T @ (y - Phi @ theta) + 2.0 * share * penalty * theta
        return slope

    scale = np.abs(Phi.T @ y).max()
    assert np.abs(gradient(1.0)).max() < 1e-10 * scale
    assert abs(gradient(0.5)[0]) > 0.3 * penalty * abs(theta[0])  # lambda/2, as printed, does not give (7)


def test_only_the_scaled_penalty_does_not_depend_on_units() -> None:
    Phi, y = observations(5)
    units = np.array([1.0, 3.6, 3.6**2])
    printed = [Phi @ ridge(Phi, y, 50.0).theta, (Phi / units) @ ridge(Phi / units, y, 50.0).theta]
    scaled = [
        Phi @ ridge(Phi, y, 0.1, scaled=True).theta,
        (Phi / units) @ ridge(Phi / units, y, 0.1, scaled=True).theta,
    ]
    assert scaled[0] == pytest.approx(scaled[1], rel=1e-9)
    assert np.abs(printed[0] - printed[1]).max() > 0.01


def test_without_data_the_prior_is_returned_and_many_data_outweigh_it() -> None:
    Phi, y = observations(6, 5000)
    prior = Prior(np.array([5.0, 0.1, 0.003]), np.diag([1.0, 0.01, 1e-6]))
    assert fit_with_prior(Phi[:0], y[:0], prior).theta == pytest.approx(prior.theta)
    assert Phi @ fit_with_prior(Phi, y, prior).theta == pytest.approx(Phi @ least_squares(Phi, y).theta, abs=0.02)


def test_the_covariance_is_consistent_with_the_errors() -> None:
    errors = []
    for seed in range(300):
        Phi, y = observations(9000 + seed, 60)
        fit = least_squares(Phi, y)
        error = fit.theta - TRUTH
        errors.append(float(error @ np.linalg.solve(fit.covariance, error)) / 3.0)
    assert np.mean(errors) == pytest.approx(1.04, abs=0.2)


def test_undetermined_parameters_raise_an_error() -> None:
    Phi, y = observations(7)
    two_speeds = Phi[[0, 1, 0, 1, 0, 1]]
    for regressors in (Phi[:2], two_speeds):
        with pytest.raises(NoAnswerError, match='do not determine three parameters'):
            least_squares(regressors, y[: len(regressors)])
    assert np.isfinite(ridge(two_speeds, y[:6], 1.0).theta).all()


def test_normal_equations_updated_by_single_observations_equal_the_batch() -> None:
    Phi, y = observations(8, 40)
    information, moment = (0.0,) * 6, (0.0,) * 3
    for (one, v, v2), value in zip(Phi.tolist(), y.tolist(), strict=True):
        information, moment = add(information, moment, (one, v, v2), value)
    solved = solve(information, moment)
    assert solved is not None
    assert solved[0] == pytest.approx(least_squares(Phi, y).theta, rel=1e-9)
    assert unpacked(covariance(solved[1])) == pytest.approx(np.linalg.inv(Phi.T @ Phi), rel=1e-6)
