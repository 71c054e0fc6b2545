# SPDX-License-Identifier: Apache-2.0
"""Wheel ratio, slip, and the point of the train that gradients are given for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from test.explain.made_runs import TRAIN, Extra, Maker, disturbed
from trainid_ros.explain.dataset import Dataset, Run, assemble
from trainid_ros.explain.effects import SHOWN
from trainid_ros.explain.model import POINTS, Model, Odometry, find_slip, preferred_point, read_at
from trainid_ros.explain.result import Verdict
from trainid_ros.explain.workflow import explain


@pytest.fixture(scope='module')
def runs() -> list[Run]:
    return Maker(noise=0.0).runs(6, 8)


def odometry(runs: list[Run], stops: Sequence[float] = ()) -> Odometry:
    return Odometry.of(assemble(runs, TRAIN), stops)


def test_worn_wheel_measures_longer_distances(runs: list[Run]) -> None:
    true = odometry(runs)
    found = odometry([replace(run, speed=run.speed * 1.02, travelled=run.travelled * 1.02) for run in runs])
    assert found.excess - true.excess == pytest.approx(0.02, abs=0.002)
    assert abs(true.excess) < 2.0 / math.sqrt(true.precision)
    assert 0.001 < 1.0 / math.sqrt(found.precision) < 0.01


def test_stops_of_the_line_take_precedence_over_positions(runs: list[Run]) -> None:
    """The stops of the line are 1 % further apart than the measured positions."""
    (a, b), (_, c) = runs[0].stops, runs[1].stops
    stops = sorted({a, a + 1.01 * (b - a), a + 1.01 * (b - a) - 1.01 * (b - c)})
    known, measured = odometry(runs[:2], stops), odometry(runs[:2])
    assert known.excess - measured.excess == pytest.approx(-0.01, abs=0.002)
    assert odometry(runs[:2], (50_000.0, 60_000.0)) == measured  # stops of another line


@pytest.mark.parametrize(
    'fields', [{'stops': (math.nan, 0.0)}, {'positioned': False}, {'stops': (5.0, 5.0)}, {'stops': (0.0, 1e5)}]
)
def test_without_distances_the_ratio_is_unknown(runs: list[Run], fields: dict[str, Any]) -> None:
    assert odometry([replace(run, **fields) for run in runs]) == Odometry(0.0, 0.0)


def test_outliers_add_no_distance(runs: list[Run]) -> None:
    burst, more = (slice(100, 103), 8.0), 3 * 0.2 * 8.0
    spoiled = [replace(disturbed(run, burst), travelled=run.travelled + more) for run in runs]
    assert odometry(spoiled).excess == pytest.approx(odometry(runs).excess, abs=5e-4)


BURST = 6


def spoiled(sign: float) -> Dataset:
    """Return four runs with a burst under traction and one while braking; sign +1: as the force, 0: random."""
    rng, runs = np.random.default_rng(4), []
    for run in Maker().runs(4, 13):
        starts = (40, int(np.argmax(run.brake < 0.0)) + 25)
        force = [np.sign(run.traction[at] + run.brake[at]) for at in starts]
        signs = [sign * of_force if sign else rng.choice([-1.0, 1.0]) for of_force in force]
        runs.append(disturbed(run, *((slice(at, at + BURST), 1.5 * s) for at, s in zip(starts, signs, strict=True))))
    return assemble(runs, TRAIN)


def test_bursts_with_the_sign_of_the_force_are_slip() -> None:
    dataset = spoiled(1.0)
    found = find_slip(dataset)
    assert found is not None
    term = found.term
    assert found.evidence > 10.0
    assert found.square == pytest.approx(8 * BURST * 1.5**2 / dataset.dt.size, rel=0.2)
    assert term.parameters['share'] == pytest.approx(8 * BURST / dataset.dt.size, rel=0.2)
    assert abs(term.parameters['speed'] - 1.5) < 2.0 * term.std['speed']
    assert [find_slip(spoiled(other)) for other in (-1.0, 0.0)] == [None, None]


def test_starts_and_stops_that_are_bent_are_no_slip() -> None:
    first, last = slice(0, BURST), slice(-BURST, None)
    for edges in ((first, last), (first,), (last,)):
        bent = [disturbed(run, *((at, 1.5 if at is first else -1.5) for at in edges)) for run in Maker().runs(6, 13)]
        assert find_slip(assemble(bent, TRAIN)) is None


def test_bursts_of_one_run_are_not_confirmed_by_the_others() -> None:
    first, *others = Maker().runs(6, 13)
    slipping = disturbed(first, *((slice(at, at + BURST), 1.5) for at in (20, 35, 50, 65)))
    found = find_slip(assemble([slipping, *others], TRAIN))
    assert found is None or found.evidence < SHOWN
    assert find_slip(assemble([slipping], TRAIN)) is None


def test_bursts_without_a_force_are_ignored() -> None:
    """There are half as many of these, as from a faulty wheel sensor while coasting."""
    runs = []
    for run in Maker().runs(4, 13):
        braking = int(np.argmax(run.brake < 0.0))
        bursts = ((40, 1.5), (braking + 25, -1.5), (braking - 30, 1.5))
        runs.append(disturbed(run, *((slice(at, at + BURST), size) for at, size in bursts)))
    found = find_slip(assemble(runs, TRAIN))
    assert found is not None
    assert found.term.parameters['speed'] == pytest.approx(1.5, rel=0.3)


def test_clean_data_and_single_outliers_are_no_slip(dataset: Dataset) -> None:
    assert find_slip(dataset) is None
    rng, runs = np.random.default_rng(5), []
    for run in Maker().runs(4, 14):
        single = rng.choice(np.arange(5, run.time.size - 5), 15, replace=False)
        runs.append(disturbed(run, (single, rng.choice([-1.0, 1.0], 15))))
    assert find_slip(assemble(runs, TRAIN)) is None


LENGTH = 100.0
BEHIND = LENGTH * (np.arange(100) + 0.5) / 100.0


def hill(position: Any) -> Any:
    """Return the gradient of the fixture's line [per mille in rising position]."""
    return np.where((position > 300.0) & (position < 600.0), 5.0, 0.0)


def mean_excess(point: str) -> Extra:
    """Return the mean gradient under the train less the gradient given at one of its points."""

    def extra(position: float, _: float, direction: int) -> float:
        under = hill(position - direction * (BEHIND - POINTS[point] * LENGTH)).mean()
        return direction * float(under - hill(position))

    return extra


@pytest.mark.parametrize('point', POINTS)
def test_point_is_found_and_mean_under_train_restored(point: str) -> None:
    runs = Maker().runs(6, 11, mean_excess(point))
    model = Model.of(runs, TRAIN)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) == point
    assert preferred_point(model, hyper, 1e6) is None

    for run in read_at(point, runs, LENGTH):
        middle = run.position - 0.5 * run.direction * run.dt * run.speed
        places = middle[:, None] - run.direction * (BEHIND - POINTS[point] * LENGTH)
        true = run.direction * hill(places).mean(axis=1)
        assert np.abs(run.gradient - true).max() < 1.0
        assert np.abs(run.gradient - true).mean() < 0.1


@pytest.mark.parametrize('hilly', [True, False])
def test_means_under_the_train_and_level_track_give_no_point(hilly: bool) -> None:
    model = Model.of([replace(run, gradient=run.gradient * hilly) for run in Maker().runs(6, 12)], TRAIN)
    hyper, _ = model.evidence().maximise()
    assert preferred_point(model, hyper, 0.0) is None


def test_gradients_at_a_point_cause_no_gap() -> None:
    reported = explain(Maker().runs(8, 14, mean_excess('middle')), TRAIN)
    assert reported.gradient_point == 'middle'
    assert reported.verdict is Verdict.NO_GAP
