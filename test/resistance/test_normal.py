# SPDX-License-Identifier: Apache-2.0
"""Normal distributions of n parameters against the textbook formulas, for three and six parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.normal import (
    OUTLIER_WIDTH,
    Array,
    Normal,
    gate,
    independent,
    inflated,
    information_in,
    information_of,
    mixed,
    normal,
    normal_of,
    soft_update,
    weigh,
)

STD = np.array([0.9, 0.02, 5e-3, 0.03, 0.15, 0.2])


def some(n: int, seed: int = 1) -> Normal:
    """Correlated parameters whose standard deviations differ by orders of magnitude."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, 2 * n))
    S = root @ root.T
    r = STD[:n] / np.sqrt(np.diag(S))
    return normal(STD[:n] * rng.standard_normal(n), r[:, None] * S * r)


def regressor(n: int) -> Array:
    return np.array([1.0, 12.0, 150.0, -40.0, -3.0, 0.8])[:n]


def numbers(x: Array) -> vec[float]:
    return vec[float](x.tolist())


@pytest.mark.parametrize('n', [3, 6])
def test_without_outliers_an_update_is_that_of_recursive_least_squares(n: int) -> None:
    before, phi, y, R, slow = some(n), regressor(n), 5.0, 0.3, 2.0
    found, weight, score = soft_update(before, numbers(phi), y, R, slow, 0.0)
    nu, S = y - phi @ before.theta, phi @ before.P @ phi + R
    K = before.P @ phi / (phi @ before.P @ phi + slow * R)
    assert weight == 1.0
    assert score == pytest.approx(-0.5 * (nu * nu / S + math.log(2.0 * math.pi * S)), rel=1e-12)
    assert found.theta == pytest.approx(before.theta + K * nu, rel=1e-9)
    assert pytest.approx(before.P - np.outer(K, phi @ before.P), rel=1e-9, abs=1e-15) == found.P


@pytest.mark.parametrize('n', [3, 6])
def test_adding_information_gives_the_same_update(n: int) -> None:
    before, phi, y, R = some(n), regressor(n), 5.0, 0.3
    parts = information_of(before), information_in(numbers(phi), y, R)
    found = normal_of(numbers(np.array(list(parts[0])) + np.array(list(parts[1]))), n)
    expected = soft_update(before, numbers(phi), y, R, 1.0, 0.0)[0]
    std = np.sqrt(np.diag(expected.P))
    assert np.max(np.abs(found.theta - expected.theta) / std) < 1e-9
    assert np.max(np.abs(found.P - expected.P) / np.outer(std, std)) < 1e-9


@pytest.mark.parametrize('y', [1e3, -1e9, 1e150])
def test_an_outlier_changes_nothing_and_its_likelihood_is_bounded_below(y: float) -> None:
    before = some(6)
    found, weight, score = soft_update(before, numbers(regressor(6)), y, 0.3, 1.0, 0.05)
    assert found is before
    assert weight == 0.0
    assert score == pytest.approx(math.log(0.05 / (OUTLIER_WIDTH * math.sqrt(0.3))))


def test_prediction_is_the_quadratic_form() -> None:
    item, phi = some(6), regressor(6)
    assert item.predict(numbers(phi)) == pytest.approx((float(phi @ item.theta), float(phi @ item.P @ phi)))


def test_a_mixture_has_the_moments_of_samples_drawn_from_it() -> None:
    one, other = some(3, 1), some(3, 2)
    rng, n = np.random.default_rng(5), 200_000
    draws = [rng.multivariate_normal(item.theta, item.P, k) for item, k in ((one, n // 4), (other, 3 * n // 4))]
    together = np.concatenate(draws)
    found = mixed([one, other], [2.0, 6.0])
    assert np.abs(found.theta - together.mean(axis=0)) == pytest.approx(np.zeros(3), abs=0.01 * STD[:3].max())
    assert np.diag(found.P) == pytest.approx(together.var(axis=0), rel=0.02)
    assert pytest.approx(one.P, rel=1e-12) == mixed([one], [0.3]).P
    # Other weights for the covariance leave the mean.
    stated, off = mixed([one, other], [2.0, 6.0], [1.0, 1.0]), np.array([one.theta, other.theta]) - found.theta
    assert stated.theta.tolist() == found.theta.tolist()
    assert pytest.approx(0.5 * (one.P + other.P + np.outer(off[0], off[0]) + np.outer(off[1], off[1]))) == stated.P


def test_steps_increase_variances_up_to_the_limit_and_keep_correlations() -> None:
    item = some(3)
    steps = np.array([1e-2, 1e-5, 1e-6])
    assert pytest.approx(np.diag(steps), abs=1e-15) == inflated(item, steps).P - item.P
    most = np.array([1.0, 1e-3, 1e-4])
    limited = inflated(item, 1e9 * steps, most)
    assert np.diag(limited.P) == pytest.approx(most)
    assert np.linalg.eigvalsh(limited.P)[0] > 0.0
    assert (limited.theta == item.theta).all()


def test_independent_parameters_have_no_correlation() -> None:
    item = independent((1.0, 2.0), (4.0, 9.0))
    assert item.P.tolist() == [[4.0, 0.0], [0.0, 9.0]]


def test_the_weight_is_the_probability_that_an_observation_is_good() -> None:
    nu, S, R, eps = 1.3, 0.4, 0.25, 0.1
    good = 0.9 * math.exp(-0.5 * nu * nu / S) / math.sqrt(2.0 * math.pi * S)
    anything = 0.1 / (OUTLIER_WIDTH * 0.5)
    assert weigh(nu, S, R, eps)[0] == pytest.approx(good / (good + anything), rel=1e-12)
    assert weigh(nu, S, R, eps)[1] == pytest.approx(math.log(good + anything), rel=1e-12)
    # At the gate good and bad are equally likely.
    assert weigh(gate(eps) * 0.5, R, R, eps)[0] == pytest.approx(0.5, abs=1e-9)
    assert gate(0.0) == math.inf
