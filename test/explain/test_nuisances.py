# SPDX-License-Identifier: Apache-2.0
"""Bins of the line, and the columns and priors of nuisances."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.explain.dataset import Dataset
from trainid_ros.explain.nuisances import Bins, Spread, common_columns, common_std, prior_factor, run_columns
from trainid_ros.train.train_file import TrainFile


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


def test_each_nuisance_has_a_column_and_a_prior(dataset: Dataset, train_file: TrainFile) -> None:
    columns = common_columns(dataset)
    unweighed, weighed = common_std(train_file, weighed=False), common_std(train_file, weighed=True)
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
