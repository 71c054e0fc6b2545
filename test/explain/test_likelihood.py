# SPDX-License-Identifier: Apache-2.0
"""Regression on whitened columns, the marginal likelihood, and whitening."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

from test.explain.made_runs import TRAIN, Maker, local_drag
from trainid_ros.explain.dataset import Dataset, Run, assemble
from trainid_ros.explain.effects import prior_cost
from trainid_ros.explain.likelihood import (
    Gram,
    Grid,
    Hyperparameters,
    MarginalLikelihood,
    Noise,
    Whitener,
    Whitening,
    eliminate,
    group_log_bayes,
    informations,
    integrated_covariance,
    log_bayes,
    posterior,
    rounding_of,
    share_of_mean,
)
from trainid_ros.explain.model import Model
from trainid_ros.explain.nuisances import run_columns
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
    grid, std = Grid.of(dataset), np.array([0.03, 0.02, 0.7])
    whitener = Whitener.of(grid, Noise(0.03, 0.2, 8.0, 0.02))
    columns = np.random.default_rng(2).standard_normal((dataset.point_time.size, 2))
    factors = dataset.column(run_columns(dataset, 0.003))
    total, cost = Gram.of(np.concatenate([columns, factors], axis=1), 3, whitener).reduced(std)
    apart = [factors * (dataset.point_run == k)[:, None] for k in range(len(dataset.runs))]
    X = whitener.apply(np.concatenate([columns, *apart], axis=1))
    order = [0, *range(2, X.shape[1]), 1]
    joint = eliminate((X.T @ X)[np.ix_(order, order)], np.diag(np.tile(std, 3)))
    assert (total[0, 0], total[0, 1], total[1, 1]) == pytest.approx((joint.yy, joint.b[0], joint.A[0, 0]))
    assert cost == pytest.approx(joint.log_det)
    white = Whitening.of(whitener, factors, std).apply(columns)
    np.testing.assert_allclose(white.T @ white, total)


Found = tuple[Hyperparameters, NDArray[np.float64]]


def evidence_of(count: int, seed: int, noise: float = 0.02) -> MarginalLikelihood:
    return Model.of(Maker(noise=noise).runs(count, seed), TRAIN).evidence()


@pytest.mark.parametrize('noise', [0.02, 0.1])
def test_noise_is_estimated_by_the_maximum(noise: float) -> None:
    evidence = evidence_of(2, 51, noise)
    hyper, logs = evidence.maximise()
    assert hyper.noise.speed == pytest.approx(noise, rel=0.5)
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
    evidence = evidence_of(2, 51, 0.1)
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
    evidence = evidence_of(3, 5)
    usual = np.log([0.03, 0.12, 8.0, 0.02, 0.005, 0.01, 0.25])
    assert evidence.excess(usual) == evidence.excess(usual - 1.0) == 0.0
    # Sensor noise and jitter do not count; gusts count by the speed error they cause.
    assert evidence.excess(usual + np.array([3.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0])) == 0.0
    assert evidence.excess(usual + np.array([0.0, 1.0, -2.0, 0.0, 0.0, 0.0, 0.0])) == pytest.approx(0.0)
    assert evidence.excess(usual + np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.8])) == pytest.approx(12.0)


INERTIA = 110.0
INITIAL_VARIANCE = 100.0


def grid_of(times: Array, share: Array, change: Array) -> Grid:
    """Return the grid of one run."""
    inside, order = np.ones((times.size, 1), dtype=bool), np.arange(times.size)
    dt = np.diff(times, prepend=times[0])[:, None]
    rounding = 1e-3 * share[:, None]
    hidden = rounding, change[:, None], INERTIA, rounding[:, 0], 1e-3
    return Grid((0, times.size), inside, order, dt, share[:, None], *hidden)


def covariance(times: Array, share: Array, change: Array, noise: Noise) -> Array:
    """Return the covariance of speed errors: integrated Ornstein-Uhlenbeck gusts, impulses, noise, initial speed."""
    t, tau = times - times[0], noise.gust_time
    earlier = np.minimum(t[:, None], t[None, :])
    decay = np.exp(-t / tau)
    apart = np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    gusts = (noise.gust * tau / INERTIA) ** 2 * (2.0 * earlier / tau - 1.0 + decay[:, None] + decay[None, :] - apart)
    impulses = np.cumsum(np.square(noise.jitter * change))
    before = np.minimum(np.arange(t.size)[:, None], np.arange(t.size)[None, :])
    return np.asarray(gusts + impulses[before] + (noise.speed**2 + 1e-3) * np.diag(share) + INITIAL_VARIANCE)


@pytest.mark.parametrize('jitter', [0.0, 0.05])
@pytest.mark.parametrize('gust_time', [1.5, 20.0])
def test_the_filter_whitens_the_dense_covariance(jitter: float, gust_time: float) -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.4, 3.0, 40))
    share, change = rng.uniform(0.2, 1.0, 40), rng.uniform(0.0, 1.0, 40) * (rng.random(40) < 0.3)
    change[0] = 0.0
    noise = Noise(0.03, 0.4, gust_time, jitter)
    whitener = Whitener.of(grid_of(times, share, change), noise)
    Z = whitener.apply(np.eye(40))
    C = covariance(times, share, change, noise)
    np.testing.assert_allclose(Z @ C @ Z.T, np.eye(40), atol=1e-6)
    assert whitener.log_det == pytest.approx(np.linalg.slogdet(C)[1], rel=1e-6)


def test_missing_measurement_has_no_weight() -> None:
    times, share, change = np.arange(30.0), np.ones(30), np.zeros(30)
    noise = Noise(0.03, 0.4, 5.0, 0.0)
    share[7] = np.inf
    values = np.random.default_rng(0).standard_normal((30, 1))
    spoiled = values.copy()
    spoiled[7] = 1e3
    whitener = Whitener.of(grid_of(times, share, change), noise)
    np.testing.assert_array_equal(whitener.apply(values), whitener.apply(spoiled))
    assert whitener.apply(spoiled)[7, 0] == 0.0


def test_runs_are_whitened_independently(dataset: Dataset) -> None:
    grid, noise = Grid.of(dataset), Noise(0.03, 0.2, 8.0, 0.02)
    whitener = Whitener.of(grid, noise)
    column = np.random.default_rng(1).standard_normal((dataset.point_time.size, 1))
    together, log_det = whitener.apply(column), 0.0
    for run, points in zip(dataset.runs, grid.runs, strict=True):
        alone = Whitener.of(Grid.of(assemble([run], TRAIN)), noise)
        np.testing.assert_allclose(together[points], alone.apply(column[points]), rtol=1e-9)
        log_det += alone.log_det
    assert whitener.log_det == pytest.approx(log_det, rel=1e-12)


def test_factors_of_runs_are_whitened(dataset: Dataset) -> None:
    """Whitening equals the inverse of the covariance of noise and factors, also with a factor that does not act."""
    whitener = Whitener.of(Grid.of(dataset), Noise(0.03, 0.2, 8.0, 0.02))
    factors, std = dataset.column(run_columns(dataset, 0.003)), np.array([0.03, 0.02, 0.7])
    factors[whitener.grid.runs[1], 1] = 0.0
    Z, white = (w.apply(np.eye(len(factors))) for w in (Whitening.of(whitener, factors, std), whitener))
    for run in whitener.grid.runs:
        scaled = white[run, run] @ factors[run] * std
        expected = white[run, run].T @ np.linalg.inv(np.eye(len(scaled)) + scaled @ scaled.T) @ white[run, run]
        np.testing.assert_allclose(Z[run, run].T @ Z[run, run], expected, atol=1e-9 * np.abs(expected).max())


def test_mean_of_many_samples_keeps_their_common_noise_and_that_of_none_is_infinite(dataset: Dataset) -> None:
    np.testing.assert_allclose(share_of_mean(np.array([1.0, 5.0, 1e9])), [1.0, 0.28, 0.1])
    count = dataset.point_count.copy()
    count[4] = 0.0
    grid = Grid.of(replace(dataset, point_count=count))
    missing = np.isinf(grid.share[grid.inside])
    assert grid.order[missing].tolist() == [4]


STEP = 1.0 / 3.6  # m/s


def rounded(run: Run) -> Run:
    """Return a run whose speeds are given in whole km/h."""
    return replace(run, speed=np.round(run.speed / STEP) * STEP)


def test_rounded_speeds_repeat_their_error_while_they_are_steady(dataset: Dataset) -> None:
    hiding, variance = rounding_of(assemble([rounded(run) for run in dataset.runs], TRAIN))
    assert variance == pytest.approx(STEP**2 / 12.0)
    brake = dataset.average(dataset.joined('brake')) < 0.0
    # Speeds that change by more than a step each second have independent errors.
    assert np.median(hiding[brake]) < variance
    assert np.median(hiding[~brake]) > 2.0 * variance
    assert hiding.max() < 10.0 * variance
    assert rounding_of(dataset)[1] == 0.0


def test_rounding_is_no_noise_of_the_sensor() -> None:
    hyper, _ = Model.of([rounded(run) for run in Maker().runs(3, 51)], TRAIN).evidence().maximise()
    assert hyper.noise.speed < 0.04
    assert hyper.noise.gust < 0.2


def test_stated_noise_of_gradients_is_usual() -> None:
    rng = np.random.default_rng(5)
    runs = [
        replace(run, gradient=run.gradient + 5.0 * np.repeat(rng.standard_normal(run.time.size), 5)[: run.time.size])
        for run in Maker().runs(4, 5)
    ]
    usual, stated = (replace(TRAIN, line=replace(TRAIN.line, gradient_std=std)) for std in (0.2, 5.0))
    excess = [(evidence := Model.of(runs, file).evidence()).excess(evidence.maximise()[1]) for file in (usual, stated)]
    assert excess[0] > 10.0
    assert excess[1] < 2.0


def test_the_covariance_of_integrated_gusts_is_their_double_integral() -> None:
    tau, step, ends = 4.0, 0.02, (3.0, 10.0)
    at = step * (np.arange(round(ends[-1] / step)) + 0.5)
    gusts = np.exp(-np.abs(at[:, None] - at[None, :]) / tau) * (step / tau) ** 2
    expected = [[gusts[at < one][:, at < other].sum() for other in ends] for one in ends]
    np.testing.assert_allclose(integrated_covariance(np.array(ends), tau), expected, rtol=1e-4)
