# SPDX-License-Identifier: Apache-2.0
"""Regression on whitened columns and the marginal likelihood."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

from test.explain.made_runs import TRAIN, Maker, local_drag
from trainid_ros.explain.dataset import Dataset, Run
from trainid_ros.explain.effects import prior_cost
from trainid_ros.explain.likelihood import (
    Gram,
    Hyperparameters,
    MarginalLikelihood,
    eliminate,
    group_log_bayes,
    informations,
    log_bayes,
    posterior,
)
from trainid_ros.explain.model import Model
from trainid_ros.explain.noise import Grid, Noise, Whitener, Whitening, run_columns
from trainid_ros.interface.errors import NoAnswerError

Array = NDArray[np.float64]
ROWS, NUISANCES, CANDIDATES = 40, 4, 3


# y, nuisances and candidates: unit noise, and one candidate in y.
COLUMNS = np.random.default_rng(7).standard_normal((ROWS, 1 + NUISANCES + CANDIDATES))
COLUMNS[:, 0] += 0.8 * COLUMNS[:, 1 + NUISANCES] + COLUMNS[:, 1:5] @ [1.0, -0.5, 0.3, 0.0]
# Factor of a prior covariance that is not diagonal.
ROOT = np.tril(np.random.default_rng(8).uniform(0.2, 1.0, (NUISANCES, NUISANCES)))
FOUND = eliminate(COLUMNS.T @ COLUMNS, ROOT)


def evidence(candidates: list[int], std: float) -> float:
    """Return twice the log density of y under nuisances and some candidates."""
    N, C = COLUMNS[:, 1 : 1 + NUISANCES] @ ROOT, COLUMNS[:, [1 + NUISANCES + k for k in candidates]]
    covariance = np.eye(ROWS) + N @ N.T + std * std * C @ C.T
    return 2.0 * float(multivariate_normal.logpdf(COLUMNS[:, 0], cov=covariance))


def test_likelihood_and_bayes_factors_of_columns() -> None:
    nothing = evidence([], 1.0)
    total = nothing + ROWS * np.log(2.0 * np.pi)
    assert -FOUND.yy - FOUND.log_det == pytest.approx(total, abs=1e-9)
    single = [evidence([k], 0.7) - nothing for k in range(CANDIDATES)]
    np.testing.assert_allclose(log_bayes(np.diag(FOUND.A), FOUND.b, 0.7), single, atol=1e-9)
    assert single[0] > 5.0
    group = evidence([0, 1, 2], 0.4) - nothing
    assert group_log_bayes(FOUND.A, FOUND.b, 0.4) == pytest.approx(group, abs=1e-9)


@pytest.mark.parametrize('sign', [1, -1])
def test_sign_restricts_the_amplitude_to_one_side(sign: int) -> None:
    A, b, std = float(FOUND.A[0, 0]), float(FOUND.b[0]), 0.7
    x = np.linspace(0.0, sign * 12.0, 200_001)
    likelihood = np.exp(b * x - 0.5 * A * x * x)
    mean = np.trapezoid(likelihood * 2.0 * norm.pdf(x, scale=std), sign * x)
    found = log_bayes(np.array([A]), np.array([b]), std, sign)
    assert float(found[0]) == pytest.approx(2.0 * np.log(mean), abs=1e-5)


def test_groups_of_candidates_are_alone() -> None:
    found = informations(COLUMNS[:, : 1 + NUISANCES], [COLUMNS[:, 5:6], COLUMNS[:, 6:8]], ROOT)
    for one, part in zip(found, (slice(0, 1), slice(1, 3)), strict=True):
        np.testing.assert_allclose(one.A, FOUND.A[part, part], atol=1e-10)
        np.testing.assert_allclose(one.b, FOUND.b[part], atol=1e-10)
        assert (one.yy, one.log_det) == pytest.approx((FOUND.yy, FOUND.log_det))


def test_posterior_solves_the_normal_equations() -> None:
    X = COLUMNS[:, : 1 + NUISANCES]
    mean, covariance = posterior(X.T @ X, ROOT)
    precision = X[:, 1:].T @ X[:, 1:] + np.linalg.inv(ROOT @ ROOT.T)
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), atol=1e-12)
    np.testing.assert_allclose(mean, np.linalg.solve(precision, X[:, 1:].T @ X[:, 0]), atol=1e-12)


def test_factors_of_single_runs_equal_separate_columns(dataset: Dataset) -> None:
    """Elimination by run equals elimination of one column for each run and factor."""
    grid, std = Grid.of(dataset), np.array([0.03, 0.02])
    whitener = Whitener.of(grid, Noise(0.03, 0.2, 8.0, 0.02))
    columns = np.random.default_rng(2).standard_normal((dataset.point_time.size, 2))
    factors = dataset.column(run_columns(dataset))
    total, cost = Gram.of(np.concatenate([columns, factors], axis=1), 2, whitener).reduced(std)
    apart = [factors * (dataset.point_run == k)[:, None] for k in range(len(dataset.runs))]
    X = whitener.apply(np.concatenate([columns, *apart], axis=1))
    order = [0, *range(2, X.shape[1]), 1]
    joint = eliminate((X.T @ X)[np.ix_(order, order)], np.diag(np.tile(std, 3)))
    assert (total[0, 0], total[0, 1], total[1, 1]) == pytest.approx((joint.yy, joint.b[0], joint.A[0, 0]))
    assert cost == pytest.approx(joint.log_det)
    white = Whitening.of(whitener, factors, std).apply(columns)
    np.testing.assert_allclose(white.T @ white, total)


Found = tuple[Hyperparameters, NDArray[np.float64]]


def evidence_of(runs: list[Run]) -> MarginalLikelihood:
    return Model.of(runs, TRAIN).evidence()


def test_noise_is_estimated() -> None:
    found = [evidence_of(Maker(noise=size).runs(2, 51)).maximise()[0].noise.speed for size in (0.02, 0.1)]
    assert found == pytest.approx([0.02, 0.1], rel=0.5)


def test_maximum_is_a_maximum() -> None:
    evidence = evidence_of(Maker().runs(2, 52))
    hyper, logs = evidence.maximise()
    assert evidence.at(logs) == pytest.approx(hyper.evidence)
    for step in (*np.eye(logs.size), *-np.eye(logs.size)):
        assert evidence.at(logs + 0.5 * step) < hyper.evidence + 0.2


class Bounded(MarginalLikelihood):
    """A likelihood that cannot be computed where the noise of the speed is larger than a limit [m/s]."""

    limit = 0.0

    def _computed(self, x: Array) -> float:
        if x[0] > np.log(self.limit):
            raise np.linalg.LinAlgError
        return super()._computed(x)


def test_the_maximum_is_searched_where_the_likelihood_can_be_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence = evidence_of(Maker(noise=0.1).runs(2, 51))
    free = evidence.maximise()[0].noise.speed
    evidence.__class__ = Bounded
    for limit in (0.8 * free, 0.035):
        monkeypatch.setattr(Bounded, 'limit', limit)
        hyper, logs = evidence.maximise()
        assert 0.03 < hyper.noise.speed <= limit
        assert evidence.at(logs) == pytest.approx(hyper.evidence)
        assert evidence.at(logs + 1.0) == -np.inf
    monkeypatch.setattr(Bounded, 'limit', 1e-9)
    with pytest.raises(NoAnswerError, match='too much from that of the train file to be compared'):
        evidence.maximise()


def test_true_effect_gains_more_than_its_prior_cost(dragged_model: Model, dragged_sizes: Found) -> None:
    model, (hyper, logs) = dragged_model, dragged_sizes
    drag = local_drag(120.0, 330.0, 2.0)
    fitted = model.with_terms((drag,)).fit(hyper)
    (term,) = fitted.terms
    gain = fitted.evidence().at(logs) - model.evidence().at(logs)
    assert gain > prior_cost(term, model.dataset) + 20.0
    for name, true in (('start', 100.0), ('end', 350.0), ('permille', 2.5)):
        assert abs(term.parameters[name] - true) < 4.0 * term.std[name]
    assert drag.std == {}
    assert model.terms == ()


def test_residual_is_reduced_by_the_response_of_effects(dragged_model: Model) -> None:
    model, drag = dragged_model, local_drag(120.0, 330.0, 2.0)
    added = model.with_terms((drag,))
    response = model.dataset.column(model.evaluator.resistance('local_drag', drag.parameters))
    np.testing.assert_allclose(added.residual, model.residual - response)
    assert added.with_terms(()).columns.shape == model.columns.shape
    assert added.without_terms.sum() == model.nuisance_columns.shape[1]
    assert prior_cost(local_drag(120.0, 330.0, 20.0), model.dataset) > prior_cost(drag, model.dataset)


def test_excess_counts_values_above_the_prior_median() -> None:
    evidence = evidence_of(Maker().runs(3, 5))
    usual = np.log([0.03, 0.12, 8.0, 0.02, 0.005, 0.01, 0.25])
    assert evidence.excess(usual) == evidence.excess(usual - 1.0) == 0.0
    # Sensor noise and jitter do not count; gusts count by the speed error they cause.
    assert evidence.excess(usual + np.array([3.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0])) == 0.0
    assert evidence.excess(usual + np.array([0.0, 1.0, -2.0, 0.0, 0.0, 0.0, 0.0])) == pytest.approx(0.0)
    assert evidence.excess(usual + np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.8])) == pytest.approx(12.0)
