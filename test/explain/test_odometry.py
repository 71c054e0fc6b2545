# SPDX-License-Identifier: Apache-2.0
"""Wheel ratio from distances between stops."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from trainid_ros.explain.dataset import Dataset, assemble
from trainid_ros.explain.odometry import Odometry
from trainid_ros.explain.run_data import Run
from trainid_ros.train.train_file import TrainFile


@pytest.fixture(scope='module')
def runs(maker: Any) -> list[Run]:
    made: list[Run] = maker(noise=0.0).runs(6, 8)
    return made


def worn(runs: Sequence[Run], ratio: float) -> list[Run]:
    return [replace(run, speed=run.speed * ratio, travelled=run.travelled * ratio) for run in runs]


def test_worn_wheel_measures_longer_distances(runs: list[Run], train_file: TrainFile) -> None:
    true = Odometry.of(assemble(runs, train_file), ())
    found = Odometry.of(assemble(worn(runs, 1.02), train_file), ())
    assert found.excess - true.excess == pytest.approx(0.02, abs=0.002)
    assert abs(true.excess) < 2.0 / math.sqrt(true.precision)
    assert 0.001 < 1.0 / math.sqrt(found.precision) < 0.01


def test_stops_of_the_line_take_precedence_over_positions(runs: list[Run], train_file: TrainFile) -> None:
    """The stops of the line are 1 % further apart than the measured positions."""
    dataset: Dataset = assemble(runs[:2], train_file)
    (a, b), (_, c) = runs[0].stops, runs[1].stops
    stops = sorted({a, a + 1.01 * (b - a), a + 1.01 * (b - a) - 1.01 * (b - c)})
    known, measured = Odometry.of(dataset, stops), Odometry.of(dataset, ())
    assert known.excess - measured.excess == pytest.approx(-0.01, abs=0.002)


def test_stops_of_another_line_are_not_used(runs: list[Run], train_file: TrainFile) -> None:
    dataset = assemble(runs, train_file)
    assert Odometry.of(dataset, (50_000.0, 60_000.0)) == Odometry.of(dataset, ())


@pytest.mark.parametrize(
    'fields', [{'stops': (math.nan, 0.0)}, {'positioned': False}, {'stops': (5.0, 5.0)}, {'stops': (0.0, 1e5)}]
)
def test_without_distances_the_ratio_is_unknown(runs: list[Run], train_file: TrainFile, fields: dict[str, Any]) -> None:
    dataset = assemble([replace(run, **fields) for run in runs], train_file)
    assert Odometry.of(dataset, ()) == Odometry(0.0, 0.0)


def test_outliers_add_no_distance(runs: list[Run], train_file: TrainFile) -> None:
    clean = Odometry.of(assemble(runs, train_file), ())
    spoiled = []
    for run in runs:
        speed = run.speed.copy()
        speed[100:103] += 8.0
        spoiled.append(replace(run, speed=speed, travelled=run.travelled + 3 * 0.2 * 8.0))
    found = Odometry.of(assemble(spoiled, train_file), ())
    assert found.excess == pytest.approx(clean.excess, abs=5e-4)
