# SPDX-License-Identifier: Apache-2.0
"""The eight regressions against weighted least squares and ridge regression."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_lab.resistance.least_squares import least_squares, ridge
from trainid_lab.resistance.recursive import Vector
from trainid_lab.resistance.regressions import (
    Regression,
    begin,
    innovation_step,
    run,
    skip,
    solve_step,
    strict_step,
    use_counts,
)

Array = NDArray[np.float64]
COUNT = 400
Pairs = list[tuple[Vector, float]]


def observations(seed: int) -> tuple[Array, Array, Pairs]:
    rng = np.random.default_rng(seed)
    v = rng.uniform(20.0, 80.0, COUNT)
    Phi = np.stack([np.ones(COUNT), v, v * v], axis=1)
    y = Phi @ np.array([0.515, 8.597e-2, 7.512e-4]) + 0.75 * rng.standard_normal(COUNT)
    return Phi, y, [((1.0, float(x), float(x * x)), float(value)) for x, value in zip(v, y, strict=True)]


def curve_difference(Phi: Array, one: Vector, other: Array) -> float:
    return float(np.abs(Phi @ (np.array(one) - other)).max())


@pytest.mark.parametrize('p', [1, 2, 4, 6])
def test_mils_is_least_squares_with_each_observation_counted_p_times(p: int) -> None:
    Phi, y, pairs = observations(50 + p)
    state = run(innovation_step, Regression(p), pairs)
    counts = np.array(use_counts((True,) * COUNT, p, strict=False), dtype=float)
    assert curve_difference(Phi, state.theta, least_squares(Phi, y, counts).theta) < 1e-6
    assert state.steps == COUNT


@pytest.mark.parametrize('p', [2, 4])
def test_vmils_is_least_squares_weighted_by_use(p: int) -> None:
    Phi, y, pairs = observations(60 + p)
    good = np.random.default_rng(61).random(COUNT) > 0.3
    y[~good] += 30.0
    state = run(strict_step, Regression(p), pairs, good.tolist())
    counts = np.array(use_counts(tuple(good.tolist()), p, strict=True), dtype=float)
    assert curve_difference(Phi, state.theta, least_squares(Phi, y, counts).theta) < 1e-6
    assert state.steps == counts.sum() / p
    assert 0 < state.steps < np.sum(good) - p


def test_least_squares_step_by_step() -> None:
    Phi, y, pairs = observations(70)
    state = begin(Regression())
    for t, (phi, value) in enumerate(pairs[:50], 1):
        state = solve_step(state, phi, value, Regression())
        assert state.determined is (t >= 3)
        if t >= 5:
            assert curve_difference(Phi, state.theta, least_squares(Phi[:t], y[:t]).theta) < 1e-6


def test_all_corrected_forms_are_ridge_for_any_p() -> None:
    Phi, y, pairs = observations(71)
    expected = ridge(Phi, y, 50.0).theta
    for step, p, tolerance in ((solve_step, 1, 1e-9), (innovation_step, 1, 1e-9), (innovation_step, 4, 0.01)):
        state = run(step, Regression(p, penalty=50.0), pairs)
        assert curve_difference(Phi, state.theta, expected) < tolerance


def test_the_printed_penalty_is_diluted_by_p() -> None:
    Phi, y, pairs = observations(72)
    found = {p: run(innovation_step, Regression(p, 50.0, COUNT), pairs).theta for p in (1, 2, 4)}
    for p, theta in found.items():
        assert curve_difference(Phi, theta, ridge(Phi, y, 50.0 / p).theta) < 0.02
    assert all(abs(found[p][0]) < abs(found[q][0]) for p, q in pairwise(found))


def test_forgetting_in_both_forms_is_the_same() -> None:
    Phi, _, pairs = observations(73)
    regression = Regression(forgetting=0.97)
    solved, recursive = run(solve_step, regression, pairs), run(innovation_step, regression, pairs)
    assert curve_difference(Phi, recursive.theta, np.array(solved.theta)) < 1e-4


def test_no_stack_extends_across_a_bad_observation() -> None:
    state = begin(Regression(3))
    for phi, y in observations(74)[2][:2]:
        state = strict_step(state, phi, y, Regression(3))
    assert len(state.Y) == 2
    assert not skip(state).Y
    assert not skip(state).Phi
    assert state.steps == 0
