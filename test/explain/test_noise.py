# SPDX-License-Identifier: Apache-2.0
"""Noise and nuisances: whitening, sections of the line, columns and their priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from test.explain.made_runs import TRAIN
from trainid_ros.explain.dataset import Dataset, assemble
from trainid_ros.explain.noise import (
    Bins,
    Grid,
    Noise,
    Spread,
    Whitener,
    Whitening,
    common_columns,
    common_std,
    prior_factor,
    run_columns,
    share_of_mean,
)

Array = NDArray[np.float64]
INERTIA = 110.0
INITIAL_VARIANCE = 100.0


def grid_of(times: Array, share: Array, change: Array) -> Grid:
    """Return the grid of one run."""
    inside, order = np.ones((times.size, 1), dtype=bool), np.arange(times.size)
    dt = np.diff(times, prepend=times[0])[:, None]
    return Grid((0, times.size), inside, order, dt, share[:, None], change[:, None], INERTIA)


def covariance(times: Array, share: Array, change: Array, noise: Noise) -> Array:
    """Return the covariance of speed errors: integrated Ornstein-Uhlenbeck gusts, impulses, noise, initial speed."""
    t, tau = times - times[0], noise.gust_time
    earlier = np.minimum(t[:, None], t[None, :])
    decay = np.exp(-t / tau)
    apart = np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    gusts = (noise.gust * tau / INERTIA) ** 2 * (2.0 * earlier / tau - 1.0 + decay[:, None] + decay[None, :] - apart)
    impulses = np.cumsum(np.square(noise.jitter * change))
    before = np.minimum(np.arange(t.size)[:, None], np.arange(t.size)[None, :])
    return np.asarray(gusts + impulses[before] + noise.speed**2 * np.diag(share) + INITIAL_VARIANCE)


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
    factors, std = dataset.column(run_columns(dataset)), np.array([0.03, 0.02])
    factors[whitener.grid.runs[1], 1] = 0.0
    Z, white = (w.apply(np.eye(len(factors))) for w in (Whitening.of(whitener, factors, std), whitener))
    for run in whitener.grid.runs:
        scaled = white[run, run] @ factors[run] * std
        expected = white[run, run].T @ np.linalg.inv(np.eye(len(scaled)) + scaled @ scaled.T) @ white[run, run]
        np.testing.assert_allclose(Z[run, run].T @ Z[run, run], expected, atol=1e-9 * np.abs(expected).max())


def test_mean_of_many_samples_keeps_their_common_noise() -> None:
    np.testing.assert_allclose(share_of_mean(np.array([1.0, 5.0, 1e9])), [1.0, 0.28, 0.1])


def test_a_node_without_samples_has_infinite_noise(dataset: Dataset) -> None:
    count = dataset.point_count.copy()
    count[4] = 0.0
    grid = Grid.of(replace(dataset, point_count=count))
    missing = np.isinf(grid.share[grid.inside])
    assert grid.order[missing].tolist() == [4]


@pytest.mark.parametrize('length', [1.0, 100.0, 350.0])
def test_shares_of_the_train_sum_to_one(dataset: Dataset, length: float) -> None:
    bins = Bins.of(dataset, length)
    shares = bins.shares(dataset, length)
    assert shares.shape == (dataset.time.size, bins.count)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    fine = Bins.of(dataset, length, fine=True)
    assert fine.width == pytest.approx(0.5 * bins.width)
    assert fine.edges[0] <= dataset.joined('position').min() - length
    assert fine.edges[-1] >= dataset.joined('position').max() + length


def test_train_lies_behind_its_front(dataset: Dataset) -> None:
    bins = Bins(-1000.0, 100.0, 30)
    shares = bins.shares(dataset, 100.0)
    middle = bins.edges[:-1] + 50.0
    behind = (shares @ middle - dataset.joined('position')) * dataset.direction
    np.testing.assert_allclose(behind, -50.0, atol=50.0)
    assert np.all(behind < 1e-9)


def test_each_nuisance_has_a_column_and_a_prior(dataset: Dataset) -> None:
    columns = common_columns(dataset)
    unweighed, weighed = common_std(TRAIN, weighed=False), common_std(TRAIN, weighed=True)
    assert columns.shape == (dataset.time.size, unweighed.size)
    assert np.isfinite(columns).all()
    assert np.all(unweighed > 0.0)
    assert weighed[-1] < unweighed[-1]
    # A mass error is equivalent to a common gain error of both forces.
    np.testing.assert_allclose(columns[:, -1], run_columns(dataset).sum(axis=1))


def test_prior_covariance(dataset: Dataset) -> None:
    bins = Bins.of(dataset, 100.0)
    correlation = bins.covariance()
    map_root = np.asarray(np.linalg.cholesky(correlation))
    root = prior_factor(np.array([0.5, 2.0]), map_root, Spread(0.01, 0.02, 0.3))
    covariance = root @ root.T
    np.testing.assert_allclose(np.diag(covariance), [0.25, 4.0, *[0.09] * bins.count])
    np.testing.assert_allclose(covariance[2:, 2:], 0.09 * correlation)
    assert not covariance[:2, 2:].any()
    np.testing.assert_array_equal(Spread(0.01, 0.02, 0.3).of_run, [0.01, 0.02])
