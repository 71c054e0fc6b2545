# SPDX-License-Identifier: Apache-2.0
"""Columns and priors of nuisances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from test.explain.made_runs import TRAIN, Maker
from trainid_ros.explain.dataset import Dataset, Run, assemble
from trainid_ros.explain.model import Model
from trainid_ros.explain.nuisances import Bins, Spread, common_columns, common_std, prior_factor, run_columns

Array = NDArray[np.float64]
SKEW, MASS, NOISE, LOSSES, UNEVEN, LOW = 4, 8, 9, 10, 11, 12  # Columns of nuisances


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
    columns = common_columns(dataset, 0.2)
    unweighed, weighed = common_std(TRAIN, 0.2, weighed=False), common_std(TRAIN, 0.2, weighed=True)
    assert columns.shape == (dataset.time.size, unweighed.size)
    assert np.isfinite(columns).all()
    assert np.all(unweighed > 0.0)
    assert weighed[MASS] < unweighed[MASS]
    # A mass error is equivalent to a common gain error of both forces.
    payload, brake, wind = run_columns(dataset, 0.003).T
    np.testing.assert_allclose(columns[:, MASS], payload + brake)
    # A headwind adds to the speed in c v^2.
    np.testing.assert_allclose(wind, 0.003 * (np.square(dataset.speed + 0.5) - np.square(dataset.speed - 0.5)))


def test_brake_may_be_uneven_and_differ_near_a_stop(dataset: Dataset) -> None:
    (skew, uneven, low), brake = common_columns(dataset, 0.2)[:, [SKEW, UNEVEN, LOW]].T, dataset.joined('brake')
    np.testing.assert_array_equal(uneven, np.abs(skew))
    assert uneven.any()
    np.testing.assert_allclose(low[brake < 0.0], -brake[brake < 0.0] * np.exp(-dataset.speed[brake < 0.0] / 3.0))
    assert not low[brake == 0.0].any()
    slow = replace(TRAIN, brake=replace(TRAIN.brake, delay=2.0, time_constant=1.5))
    assert common_std(slow, 0.2, weighed=True)[UNEVEN] == pytest.approx(0.35)


def test_slow_samples_leave_the_time_of_changes_open() -> None:
    fast, slow = (common_std(TRAIN, period, weighed=True)[[SKEW - 1, SKEW]] for period in (0.2, 1.0))
    # A time uniform within a second has a standard deviation of 0.29 s.
    np.testing.assert_allclose(np.square(slow) - np.square(fast), (1.0 - 0.04) / 12.0)
    usual, late = (Model.of([resampled(run, each) for run in Maker().runs(3, 5)], TRAIN) for each in (1, 5))
    hidden = [model.evidence().maximise()[0].noise.jitter for model in (usual, late)]
    assert hidden[1] > 2.0 * hidden[0]


def resampled(run: Run, each: int) -> Run:
    """Return every so many samples of a run, with the mean forces in between."""
    count = (run.time.size - 1) // each
    kept = slice(0, count * each + 1, each)

    def mean(values: Array) -> Array:
        return np.append(values[0], values[1 : kept.stop].reshape(count, each).mean(axis=1))

    return replace(
        run, time=run.time[kept], dt=np.diff(run.time[kept], prepend=run.time[0]), speed=run.speed[kept],
        position=run.position[kept], gradient=mean(run.gradient), radius=run.radius[kept], tunnel=run.tunnel[kept],
        traction=mean(run.traction), brake=mean(run.brake), heat=run.heat[kept],
        since_release=run.since_release[kept], distance_run=run.distance_run[kept],
    )  # fmt: skip


def test_noise_of_gradients_returns_to_their_mean(dataset: Dataset) -> None:
    gradient = dataset.joined('gradient')
    rms = float(np.sqrt(np.mean(np.square(gradient))))
    exact, noisy, known = (common_columns(dataset, std)[:, NOISE] for std in (0.0, rms, 0.01 * rms))
    np.testing.assert_allclose(noisy, 0.5 * gradient)
    assert not exact.any()
    assert np.abs(known).max() < 0.001 * np.abs(gradient).max()
    level = assemble([replace(run, gradient=np.zeros_like(run.gradient)) for run in dataset.runs], TRAIN)
    assert not common_columns(level, 0.0)[:, NOISE].any()


def test_losses_show_only_in_a_drive_that_feeds_back(dataset: Dataset) -> None:
    assert not common_columns(dataset, 0.2)[:, LOSSES].any()
    runs = [replace(run, traction=run.traction - 0.25 * run.traction.max()) for run in dataset.runs]
    fed_back = assemble(runs, TRAIN)
    losses, traction = common_columns(fed_back, 0.2)[:, LOSSES], fed_back.joined('traction')
    assert np.all(losses >= 0.0)
    assert np.corrcoef(losses, np.abs(traction))[0, 1] == pytest.approx(1.0)


def test_prior_covariance(dataset: Dataset) -> None:
    bins = Bins.of(dataset, 100.0)
    correlation = bins.covariance()
    map_root = np.asarray(np.linalg.cholesky(correlation))
    root = prior_factor(np.array([0.5, 2.0]), map_root, Spread(0.01, 0.02, 0.3))
    covariance = root @ root.T
    np.testing.assert_allclose(np.diag(covariance), [0.25, 4.0, *[0.09] * bins.count])
    np.testing.assert_allclose(covariance[2:, 2:], 0.09 * correlation)
    np.testing.assert_allclose(correlation[0], np.exp(-bins.width * np.arange(bins.count) / 200.0))
    assert not covariance[:2, 2:].any()
    np.testing.assert_array_equal(Spread(0.01, 0.02, 0.3).of_run[:2], [0.01, 0.02])
