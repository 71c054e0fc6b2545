# SPDX-License-Identifier: Apache-2.0
"""The mixed model against its definition: dense covariance matrices, and fleets whose effects are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from test.fleet.surrogate import DAY, ERROR, LEVEL, MEAN, fleet_rows
from trainid_ros.fleet.mixed_model import CHANNELS, Cells, Labels, _Problem, cells_of, fit, labels_of, shared_effects

W15 = CHANNELS[0]


def cells(seed: int, trains: int, days: int, lines: int = 1) -> tuple[Cells, Labels]:
    rows = fleet_rows(seed, trains, days, lines=lines)
    labels = labels_of(rows)
    return cells_of(rows, W15, labels), labels


def test_effects_and_likelihood_are_those_of_the_dense_model() -> None:
    found, labels = cells(1, 5, 4, lines=2)
    effects = shared_effects(found, labels)
    assert effects.names == ('line', 'day', 'line on a day')
    problem = _Problem(found, effects, 5, np.ones(found.value.size, dtype=np.bool_), LEVEL[0])
    x = np.array([-2.0, -1.0, 0.5, 0.1, -0.4, -1.5])
    solution = problem.solve(x)
    kappa2, error, train, *common = problem.variances(x)
    n = found.value.size
    design = np.zeros((n, effects.factor.size))
    for column in effects.of_cell.T:
        design[np.arange(n), column] += 1.0
    of_train = np.eye(5)[found.train]
    prior = np.array(common)[effects.factor[1:]]
    cov = np.diag(kappa2 * found.std**2 + error) + train * of_train @ of_train.T
    cov += design[:, 1:] @ np.diag(prior) @ design[:, 1:].T
    inverse, one = np.linalg.inv(cov), np.ones(n)
    mean = one @ inverse @ found.value / (one @ inverse @ one)
    residual = inverse @ (found.value - mean)
    assert problem.origin + solution.b[0] == pytest.approx(mean)
    np.testing.assert_allclose(solution.u, train * of_train.T @ residual, atol=1e-9)
    np.testing.assert_allclose(solution.b[1:], prior * (design[:, 1:].T @ residual), atol=1e-9)
    # REML: the likelihood at the mean, and the information on it; constants do not count.
    log_l = multivariate_normal(np.full(n, mean), cov).logpdf(found.value) - 0.5 * np.log(one @ inverse @ one)
    assert -solution.loss == pytest.approx(float(log_l) + 0.5 * n * np.log(2.0 * np.pi))


def test_standard_deviations_of_a_fleet_are_found() -> None:
    found, labels = cells(2, 40, 25)
    model = fit(found, labels, LEVEL[0])
    assert model.mean == pytest.approx(MEAN[0], abs=0.3)
    assert model.stds['train'] == pytest.approx(LEVEL[0], rel=0.3)
    assert model.stds['day'] == pytest.approx(DAY[0], rel=0.4)
    assert np.sqrt(model.variance).mean() == pytest.approx(ERROR[0], rel=0.1)
    assert model.degrees >= 16.0
    z = (found.value - model.common - model.train[found.train]) / np.sqrt(model.variance)
    assert np.std(z) == pytest.approx(1.0, abs=0.1)


def test_single_bad_runs_do_not_count() -> None:
    found, labels = cells(3, 30, 20)
    clean = fit(found, labels, LEVEL[0])
    bad = np.random.default_rng(4).random(found.value.size) < 0.03
    spoilt = fit(
        Cells(found.value + 3.0 * bad, *(getattr(found, name) for name in Cells.__slots__[1:])), labels, LEVEL[0]
    )
    assert spoilt.degrees < clean.degrees
    np.testing.assert_allclose(spoilt.train - spoilt.train.mean(), clean.train - clean.train.mean(), atol=0.08)


def test_days_of_two_trains_have_no_effect_of_their_own() -> None:
    found, labels = cells(5, 2, 10)
    assert shared_effects(found, labels).names == ()
