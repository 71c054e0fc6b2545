# SPDX-License-Identifier: Apache-2.0
"""Wheel ratio, slip, and the point of the train that gradients are given for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import Dataset, Run, assemble
from trainid_ros.explain.model import POINTS, Model, Odometry, find_slip, preferred_point, read_at
from trainid_ros.explain.result import Verdict
from trainid_ros.explain.workflow import explain
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


BURST = 6


def spoiled(maker: Any, train_file: TrainFile, sign: float) -> Dataset:
    """Return four runs with a burst under traction and one while braking; sign +1: as the force, 0: random."""
    rng, runs = np.random.default_rng(4), []
    for run in maker().runs(4, 13):
        speed = run.speed.copy()
        for at in (40, int(np.argmax(run.brake < 0.0)) + 25):
            with_force = np.sign(run.traction[at] + run.brake[at])
            speed[at : at + BURST] += 1.5 * (sign * with_force if sign else rng.choice([-1.0, 1.0]))
        runs.append(replace(run, speed=speed))
    return assemble(runs, train_file)


def test_bursts_with_the_sign_of_the_force_are_slip(maker: Any, train_file: TrainFile) -> None:
    dataset = spoiled(maker, train_file, 1.0)
    found = find_slip(dataset)
    assert found is not None
    term, evidence = found
    assert evidence > 10.0
    assert term.parameters['share'] == pytest.approx(8 * BURST / dataset.dt.size, rel=0.2)
    assert abs(term.parameters['speed'] - 1.5) < 2.0 * term.std['speed']


@pytest.mark.parametrize('sign', [-1.0, 0.0])
def test_bursts_of_other_sign_are_no_slip(maker: Any, train_file: TrainFile, sign: float) -> None:
    assert find_slip(spoiled(maker, train_file, sign)) is None


def test_bursts_without_a_force_are_ignored(maker: Any, train_file: TrainFile) -> None:
    """There are half as many of these, as from a faulty wheel sensor while coasting."""
    runs = []
    for run in maker().runs(4, 13):
        speed = run.speed.copy()
        braking = int(np.argmax(run.brake < 0.0))
        for at, size in ((40, 1.5), (braking + 25, -1.5), (braking - 30, 1.5)):
            speed[at : at + BURST] += size
        runs.append(replace(run, speed=speed))
    found = find_slip(assemble(runs, train_file))
    assert found is not None
    assert found[0].parameters['speed'] == pytest.approx(1.5, rel=0.3)


def test_single_outliers_are_no_slip(maker: Any, train_file: TrainFile) -> None:
    rng, runs = np.random.default_rng(5), []
    for run in maker().runs(4, 14):
        single = rng.choice(np.arange(5, run.time.size - 5), 15, replace=False)
        speed = run.speed.copy()
        speed[single] += rng.choice([-1.0, 1.0], 15)
        runs.append(replace(run, speed=np.maximum(speed, 0.0)))
    assert find_slip(assemble(runs, train_file)) is None


def test_clean_data_have_no_slip(dataset: Dataset) -> None:
    assert find_slip(dataset) is None


LENGTH = 100.0
BEHIND = LENGTH * (np.arange(100) + 0.5) / 100.0


def hill(position: Any) -> Any:
    """Return the gradient of the fixture's line [per mille in rising position]."""
    return np.where((position > 300.0) & (position < 600.0), 5.0, 0.0)


def mean_excess(point: str) -> Callable[[float, float, int], float]:
    """Return the mean gradient under the train less the gradient given at one of its points."""

    def extra(position: float, _: float, direction: int) -> float:
        under = hill(position - direction * (BEHIND - POINTS[point] * LENGTH)).mean()
        return direction * float(under - hill(position))

    return extra


def model_of(runs: list[Run], train_file: TrainFile) -> Model:
    return Model.of(runs, train_file)


@pytest.mark.parametrize('point', POINTS)
def test_point_is_found_and_mean_under_train_restored(maker: Any, train_file: TrainFile, point: str) -> None:
    runs = maker().runs(6, 11, mean_excess(point))
    model = model_of(runs, train_file)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) == point
    assert preferred_point(model, hyper, 1e6) is None

    for run in read_at(point, runs, LENGTH):
        middle = run.position - 0.5 * run.direction * run.dt * run.speed
        places = middle[:, None] - run.direction * (BEHIND - POINTS[point] * LENGTH)
        true = run.direction * hill(places).mean(axis=1)
        assert np.abs(run.gradient - true).max() < 1.0
        assert np.abs(run.gradient - true).mean() < 0.1


def test_means_under_the_train_are_recognised(maker: Any, train_file: TrainFile) -> None:
    model = model_of(maker().runs(6, 12), train_file)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) is None


def test_level_track_gives_no_point(maker: Any, train_file: TrainFile) -> None:
    runs = [replace(run, gradient=np.zeros(run.time.size)) for run in maker().runs(4, 13)]
    model = model_of(runs, train_file)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) is None


def test_gradients_at_a_point_cause_no_gap(maker: Any, train_file: TrainFile) -> None:
    reported = explain(maker().runs(8, 14, mean_excess('middle')), train_file)
    assert reported.gradient_point == 'middle'
    assert reported.verdict is Verdict.NO_GAP
