# SPDX-License-Identifier: Apache-2.0
"""Least squares, regularised forms and recursions against numpy, their criteria and the printed equations."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from research.papers import liu_numerics as printed
from trainid_lab.resistance.least_squares import Prior, add, fit_with_prior, least_squares, ridge, solve, unpacked
from trainid_lab.resistance.recursive import (
    Vector,
    covariance,
    forget,
    prediction_variance,
    regularised_rls,
    rls,
    shrink,
    start,
)
from trainid_lab.resistance.regressions import (
    Regression,
    begin,
    innovation_step,
    mils,
    regularised_mils,
    run,
    skip,
    solve_step,
    stacked,
    strict_step,
    use_counts,
)
from trainid_ros.interface.errors import NoAnswerError

Array = NDArray[np.float64]
Pairs = list[tuple[Vector, float]]
TRUTH = np.array([2.0, 0.06, 1.8e-3])
COUNT = 400
FLAGS = st.lists(st.booleans(), max_size=60).map(tuple)


def observations(seed: int, count: int = COUNT, noise: float = 0.7) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    v = rng.uniform(20.0, 80.0, count)
    Phi = np.stack([np.ones(count), v, v * v], axis=1)
    return Phi, Phi @ TRUTH + noise * rng.standard_normal(count)


def pairs_of(Phi: Array, y: Array) -> Pairs:
    return [((one, v, v2), value) for (one, v, v2), value in zip(Phi.tolist(), y.tolist(), strict=True)]


def curve_difference(Phi: Array, one: Vector, other: Array) -> float:
    return float(np.abs(Phi @ (np.array(one) - other)).max())


def test_least_squares_is_that_of_numpy() -> None:
    Phi, y = observations(1, 200, 0.5)
    assert least_squares(Phi, y).theta == pytest.approx(np.linalg.lstsq(Phi, y, rcond=None)[0], rel=1e-9)


def test_an_integer_weight_equals_repeated_observations() -> None:
    Phi, y = observations(2, 30, 0.5)
    counts = np.random.default_rng(4).integers(1, 5, 30)
    repeated = least_squares(np.repeat(Phi, counts, axis=0), np.repeat(y, counts))
    assert least_squares(Phi, y, counts.astype(float)).theta == pytest.approx(repeated.theta, rel=1e-9)


@pytest.mark.parametrize('penalty', [0.5, 50.0, 5000.0])
def test_ridge_minimises_the_sum_with_the_full_penalty(penalty: float) -> None:
    Phi, y = observations(3, 200, 0.5)
    theta = ridge(Phi, y, penalty).theta

    def gradient(share: float) -> Array:
        slope: Array = -2.0 * Phi.T @ (y - Phi @ theta) + 2.0 * share * penalty * theta
        return slope

    scale = np.abs(Phi.T @ y).max()
    assert np.abs(gradient(1.0)).max() < 1e-10 * scale
    assert abs(gradient(0.5)[0]) > 0.3 * penalty * abs(theta[0])  # lambda/2, as printed, does not give (7)


def test_only_the_scaled_penalty_does_not_depend_on_units() -> None:
    Phi, y = observations(5, 200, 0.5)
    units = np.array([1.0, 3.6, 3.6**2])
    printed = [Phi @ ridge(Phi, y, 50.0).theta, (Phi / units) @ ridge(Phi / units, y, 50.0).theta]
    scaled = [
        Phi @ ridge(Phi, y, 0.1, scaled=True).theta,
        (Phi / units) @ ridge(Phi / units, y, 0.1, scaled=True).theta,
    ]
    assert scaled[0] == pytest.approx(scaled[1], rel=1e-9)
    assert np.abs(printed[0] - printed[1]).max() > 0.01


def test_without_data_the_prior_is_returned_and_many_data_outweigh_it() -> None:
    Phi, y = observations(6, 5000, 0.5)
    prior = Prior(np.array([5.0, 0.1, 0.003]), np.diag([1.0, 0.01, 1e-6]))
    assert fit_with_prior(Phi[:0], y[:0], prior).theta == pytest.approx(prior.theta)
    assert Phi @ fit_with_prior(Phi, y, prior).theta == pytest.approx(Phi @ least_squares(Phi, y).theta, abs=0.02)


def test_the_covariance_is_consistent_with_the_errors() -> None:
    errors = []
    for seed in range(300):
        Phi, y = observations(9000 + seed, 60, 0.5)
        fit = least_squares(Phi, y)
        error = fit.theta - TRUTH
        errors.append(float(error @ np.linalg.solve(fit.covariance, error)) / 3.0)
    assert np.mean(errors) == pytest.approx(1.04, abs=0.2)


def test_undetermined_parameters_raise_an_error() -> None:
    Phi, y = observations(7, 200, 0.5)
    two_speeds = Phi[[0, 1, 0, 1, 0, 1]]
    for regressors in (Phi[:2], two_speeds):
        with pytest.raises(NoAnswerError, match='do not determine three parameters'):
            least_squares(regressors, y[: len(regressors)])
    assert np.isfinite(ridge(two_speeds, y[:6], 1.0).theta).all()


def test_normal_equations_updated_by_single_observations_equal_the_batch() -> None:
    Phi, y = observations(8, 40, 0.5)
    information, moment = (0.0,) * 6, (0.0,) * 3
    for phi, value in pairs_of(Phi, y):
        information, moment = add(information, moment, phi, value)
    solved = solve(information, moment)
    assert solved is not None
    assert solved[0] == pytest.approx(least_squares(Phi, y).theta, rel=1e-9)
    assert unpacked(covariance(solved[1])) == pytest.approx(np.linalg.inv(Phi.T @ Phi), rel=1e-6)


@pytest.mark.parametrize('penalty', [1.0, 50.0, 5000.0])
def test_rls_from_p0_over_lambda_is_ridge_at_every_step(penalty: float) -> None:
    Phi, y = observations(21, 300)
    theta, UD = start(1.0 / penalty)
    for t, (phi, value) in enumerate(pairs_of(Phi, y), 1):
        theta, UD = rls(theta, UD, phi, value)
        assert np.abs(np.array(theta) - ridge(Phi[:t], y[:t], penalty).theta).max() < 1e-9


def test_regularised_rls_is_the_printed_equations() -> None:
    Phi, y = observations(22, 200)
    theta, UD = start(1e3, 1e-3)
    expected, P_expected = np.full(3, 1e-3), 1e3 * np.eye(3)
    for phi, value in pairs_of(Phi, y):
        theta, UD = regularised_rls(theta, UD, phi, value, 50.0 / 200.0)
        expected, P_expected = printed.regularised_rls(expected, P_expected, np.array(phi), value, 200, 50.0)
        assert np.array(theta) == pytest.approx(expected, abs=1e-4)
    assert unpacked(covariance(UD)) == pytest.approx(P_expected, rel=1e-4)


@pytest.mark.parametrize(('until', 'share'), [(100, 0.5), (200, 1.0), (400, 2.0)])
def test_the_printed_penalty_grows_with_time(until: int, share: float) -> None:
    Phi, y = observations(23, 400)
    theta, UD = start(1e6)
    for phi, value in pairs_of(Phi[:until], y[:until]):
        theta, UD = regularised_rls(theta, UD, phi, value, 50.0 / 200.0)
    assert np.array(theta) == pytest.approx(ridge(Phi[:until], y[:until], share * 50.0).theta, abs=1e-5)


def test_no_penalty_changes_nothing() -> None:
    theta, UD = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3, 1.0, 2.0, 3.0)
    assert shrink(theta, UD, 0.0) == (theta, UD)


def test_factors_are_those_of_the_covariance() -> None:
    U, D = np.array([[1.0, 0.1, 0.2], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]]), np.diag([1.0, 2.0, 3.0])
    UD = (0.1, 0.2, 0.3, 1.0, 2.0, 3.0)
    P = U @ D @ U.T
    assert unpacked(covariance(UD)) == pytest.approx(P)
    phi = np.array([1.0, -2.0, 0.5])
    assert prediction_variance(UD, (1.0, -2.0, 0.5)) == pytest.approx(phi @ P @ phi)


def test_the_covariance_stays_positive_without_excitation() -> None:
    theta, UD = start(1e6, 1e-6)
    for _ in range(20_000):
        theta, UD = rls(theta, UD, (1.0, 60.0, 3600.0), 8.0)
    assert min(UD[3:]) > 0.0
    assert prediction_variance(UD, (1.0, 60.0, 3600.0)) == pytest.approx(1.0 / 20_000, rel=1e-3)


def test_forgetting_reduces_the_weight_of_older_observations() -> None:
    Phi, y = observations(24, 100)
    mu = 0.95
    theta, UD = start(1e8)
    for phi, value in pairs_of(Phi, y):
        theta, UD = rls(theta, forget(UD, mu), phi, value)
    weights = mu ** np.arange(99, -1, -1)
    root = np.sqrt(weights)[:, None]
    expected = np.linalg.lstsq(root * Phi, root[:, 0] * y, rcond=None)[0]
    assert Phi @ np.array(theta) == pytest.approx(Phi @ expected, abs=1e-4)


@pytest.mark.parametrize('p', [1, 2, 4, 6])
def test_mils_is_least_squares_with_each_observation_counted_p_times(p: int) -> None:
    Phi, y = observations(50 + p)
    state = run(innovation_step, Regression(p), pairs_of(Phi, y))
    counts = np.array(use_counts((True,) * COUNT, p, strict=False), dtype=float)
    assert curve_difference(Phi, state.theta, least_squares(Phi, y, counts).theta) < 1e-6
    assert state.steps == COUNT


@pytest.mark.parametrize('p', [2, 4])
def test_vmils_is_least_squares_weighted_by_use(p: int) -> None:
    Phi, y = observations(60 + p)
    good = np.random.default_rng(61).random(COUNT) > 0.3
    y[~good] += 30.0
    state = run(strict_step, Regression(p), pairs_of(Phi, y), good.tolist())
    counts = np.array(use_counts(tuple(good.tolist()), p, strict=True), dtype=float)
    assert curve_difference(Phi, state.theta, least_squares(Phi, y, counts).theta) < 1e-6
    assert state.steps == counts.sum() / p
    assert 0 < state.steps < np.sum(good) - p


def test_least_squares_step_by_step() -> None:
    Phi, y = observations(70)
    state = begin(Regression())
    for t, (phi, value) in enumerate(pairs_of(Phi, y)[:50], 1):
        state = solve_step(state, phi, value, Regression())
        assert state.determined is (t >= 3)
        if t >= 5:
            assert curve_difference(Phi, state.theta, least_squares(Phi[:t], y[:t]).theta) < 1e-6


def test_all_corrected_forms_are_ridge_for_any_p() -> None:
    Phi, y = observations(71)
    expected = ridge(Phi, y, 50.0).theta
    for step, p, tolerance in ((solve_step, 1, 1e-9), (innovation_step, 1, 1e-9), (innovation_step, 4, 0.01)):
        state = run(step, Regression(p, penalty=50.0), pairs_of(Phi, y))
        assert curve_difference(Phi, state.theta, expected) < tolerance


def test_the_printed_penalty_is_diluted_by_p() -> None:
    Phi, y = observations(72)
    found = {p: run(innovation_step, Regression(p, 50.0, COUNT), pairs_of(Phi, y)).theta for p in (1, 2, 4)}
    for p, theta in found.items():
        assert curve_difference(Phi, theta, ridge(Phi, y, 50.0 / p).theta) < 0.02
    assert all(abs(found[p][0]) < abs(found[q][0]) for p, q in pairwise(found))


def test_forgetting_in_both_forms_is_the_same() -> None:
    Phi, y = observations(73)
    regression = Regression(forgetting=0.97)
    solved, recursive = (run(step, regression, pairs_of(Phi, y)) for step in (solve_step, innovation_step))
    assert curve_difference(Phi, recursive.theta, np.array(solved.theta)) < 1e-4


def test_no_stack_extends_across_a_bad_observation() -> None:
    state = begin(Regression(3))
    for phi, y in pairs_of(*observations(74, 2)):
        state = strict_step(state, phi, y, Regression(3))
    assert len(state.Y) == 2
    assert not skip(state).Y
    assert not skip(state).Phi
    assert state.steps == 0


@pytest.mark.parametrize('penalty', [0.0, 50.0])
@pytest.mark.parametrize('p', [1, 2, 4, 6])
def test_a_step_is_the_printed_one(p: int, penalty: float) -> None:
    rng = np.random.default_rng(40 + p)
    N = 80
    theta, UD = start(1e3, 1e-3)
    expected, P_expected = np.full(3, 1e-3), 1e3 * np.eye(3)
    stack_phi, stack_y = tuple[Vector, ...](), tuple[float, ...]()
    for v in rng.uniform(20.0, 80.0, N):
        stack_phi, stack_y = stacked(stack_phi, stack_y, (1.0, float(v), float(v * v)), float(rng.normal(6.0)), p)
        Phi, Y = np.array(stack_phi).T, np.array(stack_y)
        Q = P_expected if penalty == 0.0 else np.linalg.inv(np.linalg.inv(P_expected) + penalty / N * np.eye(3))
        L = Q @ Phi @ np.linalg.inv(np.eye(len(Y)) + Phi.T @ Q @ Phi)
        P_expected = (np.eye(3) - L @ Phi.T) @ Q
        expected = expected + L @ (Y - Phi.T @ expected) - penalty / N * P_expected @ expected
        theta, UD = regularised_mils(theta, UD, stack_phi, stack_y, penalty / N)
        assert np.array(theta) == pytest.approx(expected, abs=1e-5)
    assert unpacked(covariance(UD)) == pytest.approx(P_expected, rel=1e-3)


def test_the_order_inside_a_step_does_not_matter() -> None:
    theta, UD = start(10.0)
    stack = ((1.0, 30.0, 900.0), (1.0, 40.0, 1600.0), (1.0, 70.0, 4900.0))
    forward, _ = mils(theta, UD, stack, (3.0, 5.0, 9.0))
    backward, _ = mils(theta, UD, stack[::-1], (9.0, 5.0, 3.0))
    assert forward == pytest.approx(backward, rel=1e-6)


@given(FLAGS, st.integers(1, 6))
def test_a_strict_step_needs_p_consecutive_good_observations(good: tuple[bool, ...], p: int) -> None:
    windows = [range(t - p + 1, t + 1) for t in range(p - 1, len(good)) if all(good[t - p + 1 : t + 1])]
    counts = use_counts(good, p, strict=True)
    assert counts == tuple(sum(t in window for window in windows) for t in range(len(good)))
    assert all(count == 0 for count, fine in zip(counts, good, strict=True) if not fine)


def test_without_bad_observations_each_is_used_p_times_except_at_the_ends() -> None:
    assert use_counts((True,) * 6, 3, strict=False) == (3, 3, 3, 3, 2, 1)
    assert use_counts((True,) * 6, 3, strict=True) == (1, 2, 3, 3, 2, 1)
    assert use_counts((True, True, False, True, True, True), 3, strict=True) == (0, 0, 0, 1, 1, 1)
