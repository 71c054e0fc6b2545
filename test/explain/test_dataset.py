# SPDX-License-Identifier: Apache-2.0
"""Grid points: the response to a resistance, means over one second, and outliers of the speed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import Dataset, assemble, find_outliers
from trainid_ros.train.train_file import TrainFile


def test_correct_model_leaves_only_noise(dataset: Dataset) -> None:
    assert 0.015 < dataset.gap.std() < 0.03
    assert dataset.point_count.sum() == (~dataset.outlier).sum()
    assert np.all(dataset.point_count <= 5.0)


def test_response_to_a_missing_resistance_is_its_gap(maker: Any, train_file: TrainFile) -> None:
    runs = maker(noise=0.0).runs(2, 4, lambda *_: 0.5)
    found = assemble(runs, train_file)
    missing = found.column(np.full(found.dt.size, 0.5))
    initial = found.gap[found.starts][found.run_of]
    np.testing.assert_allclose(found.average(found.gap - initial), missing, atol=0.03)
    assert np.abs(missing).max() > 0.3
    known = assemble(runs, train_file, np.full(found.dt.size, 0.5))
    np.testing.assert_allclose(known.gap, initial, atol=0.03)


def test_columns_are_integrated_independently(dataset: Dataset) -> None:
    both = np.random.default_rng(0).standard_normal((dataset.dt.size, 2))
    np.testing.assert_allclose(dataset.column(both)[:, 1], dataset.column(both[:, 1]))


def test_single_outliers_are_detected(maker: Any, train_file: TrainFile) -> None:
    runs = maker().runs(2, 6)
    speed = runs[0].speed.copy()
    spoiled = [20, 60, 61, 130, 250]
    speed[spoiled] += [0.5, -0.6, -0.6, 1.0, -0.4]
    found = assemble([replace(runs[0], speed=speed), runs[1]], train_file)
    assert found.outlier[spoiled].all()
    assert found.outlier.sum() <= len(spoiled) + 3
    np.testing.assert_allclose(found.deviation[spoiled], [0.5, -0.6, -0.6, 1.0, -0.4], atol=0.1)
    clean = assemble(runs, train_file)
    np.testing.assert_allclose(found.speed, clean.speed, atol=0.1)


def test_permanent_step_is_no_outlier() -> None:
    gap = 0.02 * np.random.default_rng(1).standard_normal(300)
    starts = np.array([0])
    few = find_outliers(gap, starts).sum()
    gap[120:] += 0.5
    assert find_outliers(gap, starts).sum() <= few + 1
    assert few <= 1


def test_burst_is_an_outlier_with_its_flanks() -> None:
    gap = 0.01 * np.random.default_rng(3).standard_normal(200)
    # The flanks of a burst of slip are too small to be outliers by themselves.
    gap[100:107] += [0.1, 0.6, 1.2, 1.3, 1.2, 0.6, 0.1]
    outlier = find_outliers(gap, np.array([0]))
    assert outlier[100:107].all()
    assert not outlier[:99].any()
    assert not outlier[108:].any()


def test_burst_cut_by_the_edge_of_a_run_is_an_outlier() -> None:
    gap = 0.01 * np.random.default_rng(4).standard_normal(200)
    gap[:12] += 1.1
    gap[50] += 3.0
    for one in (gap, gap[::-1]):
        outlier = find_outliers(one, np.array([0]))
        outlier = outlier if one is gap else outlier[::-1]
        assert np.flatnonzero(outlier).tolist() == [*range(12), 50]


def test_runs_of_few_samples_have_no_outliers() -> None:
    assert not find_outliers(np.array([0.0, 5.0, 0.0, 9.0]), np.array([0, 1, 2])).any()


def test_node_of_outliers_only_has_no_samples(maker: Any, train_file: TrainFile) -> None:
    runs = maker().runs(1, 6)
    speed = runs[0].speed.copy()
    speed[100:105] += 3.0
    found = assemble([replace(runs[0], speed=speed)], train_file)
    point = int(np.searchsorted(found.point_starts, 100, side='right')) - 1
    assert found.point_count[point] == 0.0
    assert found.time[100] <= found.point_time[point] <= found.time[104]
    assert np.isfinite(found.average(found.gap)).all()
    assert found.column(np.ones(found.dt.size))[point] == 0.0


def test_columns_are_means_of_integrated_kicks(maker: Any, train_file: TrainFile) -> None:
    runs = maker().runs(2, 6)
    speed = runs[0].speed.copy()
    speed[[60, 61]] += 3.0
    found = assemble([replace(runs[0], speed=speed), runs[1]], train_file)
    resistance = np.random.default_rng(1).standard_normal(found.dt.size)
    kick = -resistance * found.dt / found.inertia
    response = np.concatenate([np.cumsum(kick[found.run_of == k]) for k in range(2)])
    np.testing.assert_allclose(found.column(resistance), found.average(response), atol=1e-14)


def test_direction_of_each_sample(dataset: Dataset) -> None:
    assert dataset.direction.shape == dataset.time.shape
    assert [int(dataset.direction[start]) for start in dataset.starts] == [1, -1, 1]
    assert dataset.joined('speed').shape == dataset.speed.shape
    with pytest.raises(AttributeError):
        dataset.joined('colour')
