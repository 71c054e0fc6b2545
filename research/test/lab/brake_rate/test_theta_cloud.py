# SPDX-License-Identifier: Apache-2.0
"""Particle filters on a grid: branching, pruning and weights; RBPF compared with one covariance per particle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from trainid_lab.brake_rate.pade_model import pade_model
from trainid_lab.brake_rate.particles import (
    Correction,
    LinearStep,
    correction,
    distance,
    effective_number,
    normal_weights,
    normalise,
    systematic,
)
from trainid_lab.brake_rate.theta_cloud import (
    MRule,
    ThetaCloud,
    all_values,
    m_algorithm,
    printed_groups,
    rbpf,
    rbpf_optimal,
)
from trainid_lab.brake_rate.theta_posterior import GRID, PRINTED_FIRST
from trainid_ros.interface.errors import InputError


@pytest.mark.parametrize(('dt', 'tau', 'lam'), [(1.0, 0.4, 1.6667), (0.2, 0.63, 2.9), (0.05, 1.5, 0.4)])
@pytest.mark.parametrize('f', [0.0, 0.73, 1.1])
def test_the_closed_form_is_the_exact_discretisation_of_the_printed_matrices(
    dt: float, tau: float, lam: float, f: float
) -> None:
    A = np.zeros((5, 5))
    A[0, 1] = A[1, 2] = 1.0
    A[2, 2:5] = -1.0 / tau, f / tau, -f / tau
    A[3, 3:5] = -lam, 2.0 * lam
    exact = expm(A * dt)
    model = pade_model(dt, tau, lam)
    assert np.max(np.abs(model.Phi0 + f * model.Phi1 - exact[:4, :4])) < 1e-13
    assert np.max(np.abs(model.Gamma0 + f * model.Gamma1 - exact[:4, 4])) < 1e-13


def test_the_printed_initial_state_is_the_equilibrium_for_a_command_of_minus_one() -> None:
    model = pade_model(1.0, 0.4, 1.6667)
    x = (model.Phi0 + model.Phi1) @ [0.0, 20.0, -1.0, -2.0] - (model.Gamma0 + model.Gamma1)
    assert x == pytest.approx([19.5, 19.0, -1.0, -2.0])
    step = model.step(-2.0, -1.0, 0.05)
    assert step.predict(np.array([[0.0], [20.0], [-1.0]]), np.ones(1))[:, 0] == pytest.approx([19.5, 19.0, -1.0])
    assert model.next_a_z(-2.0, -1.0) == pytest.approx(-2.0)


def test_a_pole_of_the_closed_form_is_rejected() -> None:
    with pytest.raises(InputError, match='lam tau must not be 1'):
        pade_model(1.0, 0.5, 2.0)


LOGS = st.lists(st.floats(-1000.0, 1000.0), min_size=1, max_size=30)


@given(LOGS, st.floats(-1e5, 1e5))
def test_normalised_weights_sum_to_one_at_any_scale(logs: list[float], shift: float) -> None:
    weights = np.exp(normalise(np.array(logs) + shift))
    assert weights.sum() == pytest.approx(1.0, abs=1e-9)
    ratio = normalise(np.array(logs))
    # Adding a number to 1e5 costs 1e-11 of it.
    assert np.exp(ratio) == pytest.approx(weights, abs=1e-9)


def test_impossible_particles_keep_zero_weight_unless_all_are_impossible() -> None:
    assert np.exp(normalise(np.array([-np.inf, 0.0, 0.0]))) == pytest.approx([0.0, 0.5, 0.5])
    assert np.exp(normalise(np.full(4, -np.inf))) == pytest.approx([0.25] * 4)


@given(LOGS, st.integers(1, 50), st.floats(0.0, 1.0, exclude_max=True))
def test_each_particle_is_kept_in_proportion_to_its_weight(logs: list[float], count: int, uniform: float) -> None:
    weights = np.exp(normalise(0.01 * np.array(logs)))
    kept = np.bincount(systematic(weights, count, uniform), minlength=len(weights))
    assert kept.sum() == count
    # Systematic resampling differs from the expectation by less than one, apart from rounding.
    assert np.all(np.abs(kept - count * weights) < 1.0 + 1e-6)


def test_resampling_is_unbiased() -> None:
    weights = np.array([0.07, 0.53, 0.0, 0.29, 0.11])
    draws = (np.arange(20_000) + 0.5) / 20_000
    kept = sum(np.bincount(systematic(weights, 7, float(u)), minlength=5) for u in draws) / len(draws)
    # The mean over all draws is the expectation; the grid of draws is 5e-5 fine.
    assert kept == pytest.approx(7 * weights, abs=1e-3)


def test_weights_that_sum_to_less_than_one_give_valid_indices() -> None:
    weights = np.full(10, 0.1 * (1.0 - 1e-9))
    assert weights.sum() < 1.0
    kept = systematic(weights, 1000, math.nextafter(1.0, 0.0))
    assert kept.max() == 9
    assert systematic(np.array([0.5, 0.2]), 4, 0.99).tolist() == [0, 0, 1, 1]


def test_weights_of_logarithms_by_hand() -> None:
    logs = np.array([-3.0, 0.0, 2.0])
    assert normal_weights(logs + 1e5) == pytest.approx(np.exp(logs) / np.exp(logs).sum(), abs=1e-9)
    assert normal_weights(np.array([-np.inf, 0.0, 0.0])) == pytest.approx([0.0, 0.5, 0.5])
    assert normal_weights(np.full(4, -np.inf)) == pytest.approx([0.25] * 4)


def test_effective_number_by_hand() -> None:
    assert effective_number(np.full(8, 0.125)) == pytest.approx(8.0)
    assert effective_number(np.array([1.0, 0.0, 0.0])) == pytest.approx(1.0)
    assert effective_number(np.array([0.5, 0.25, 0.25])) == pytest.approx(1.0 / 0.375)


H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
R = np.diag([0.3, 0.1])


def start(f: list[float]) -> tuple[ThetaCloud, LinearStep, Correction]:
    N = len(f)
    step = pade_model(1.0, 0.4, 1.6667).step(-2.0, -1.0, 0.05)
    cloud = ThetaCloud(np.array(f), np.full(N, -np.log(N)), np.repeat([[0.0], [20.0], [-1.0]], N, axis=1))
    P = step.predict_covariance(1e-3 * np.eye(3))
    return ThetaCloud(cloud.f, cloud.log_weights, step.predict(cloud.x, cloud.f)), step, correction(P, H, R)


def test_groups_equal_those_printed_and_the_missing_one_is_available() -> None:
    f = np.array([1.0, 0.9, 0.8, 0.5, 0.1, 0.0])
    printed = printed_groups(GRID, f, PRINTED_FIRST)
    rows = [[0.9, 0.8, 0.7]] * 3 + [[0.6, 0.5, 0.4], [0.2, 0.1, 0.0], [0.2, 0.1, 0.0]]
    assert np.allclose(printed.T, rows)
    assert np.allclose(printed_groups(GRID, f, 1)[:, 0], [1.0, 0.9, 0.8])


def test_children_have_the_state_of_their_own_value() -> None:
    cloud, step, fix = start([0.9, 0.5])
    y = np.array([19.4, 19.1])
    rule = MRule(2, 100, carries=True, stochastic=True)
    everything, rest = m_algorithm(cloud, all_values(GRID, cloud.f), step, fix, H, y, rule, 0.5)
    assert rest is everything
    for f in (1.0, 0.3):
        x = step.predict(np.array([[0.0], [20.0], [-1.0]]), np.array([f]))
        expected = (x + fix.K @ (y[:, None] - H @ x))[:, 0]
        found = everything.x[:, np.isclose(everything.f, f)]
        assert found == pytest.approx(np.column_stack([expected, expected]))
    assert everything.weights.sum() == pytest.approx(1.0)


def test_printed_pruning_keeps_the_largest_weights_and_stochastic_pruning_is_unbiased() -> None:
    cloud, step, fix = start([0.9, 0.5, 0.4])
    y = np.array([19.5, 19.0])
    children = all_values(GRID, cloud.f)
    heavy = m_algorithm(cloud, children, step, fix, H, y, MRule(3, 5, carries=False, stochastic=False), 0.5)
    assert sorted(heavy[1].log_weights)[0] - sorted(heavy[1].log_weights)[2] > np.log(0.5)
    assert set(heavy[1].f) == {heavy[0].f[int(np.argmax(heavy[0].log_weights))]}
    means = []
    for u in np.linspace(0.0, 0.999, 200):
        everything, kept = m_algorithm(
            cloud, children, step, fix, H, y, MRule(3, 5, carries=True, stochastic=True), float(u)
        )
        means.append(kept.f.mean())
    assert np.mean(means) == pytest.approx(everything.f @ everything.weights, abs=0.01)


def test_weights_are_retained_only_if_the_rule_says_so() -> None:
    cloud, step, fix = start([0.9, 0.9])
    cloud = ThetaCloud(cloud.f, np.log([0.9, 0.1]), cloud.x)
    same = cloud.f[None, :]
    y = np.array([19.0, 19.0])
    carried = m_algorithm(cloud, same, step, fix, H, y, MRule(2, 5, carries=True, stochastic=True), 0.5)[0]
    discarded = m_algorithm(cloud, same, step, fix, H, y, MRule(2, 5, carries=False, stochastic=True), 0.5)[0]
    assert carried.weights == pytest.approx([0.9, 0.1])
    assert discarded.weights == pytest.approx([0.5, 0.5])


def test_the_optimal_proposal_draws_from_the_posterior_of_the_grid() -> None:
    cloud, step, fix = start([0.5] * 4000)
    y = np.array([19.5, 19.0])
    rng = np.random.default_rng(8)
    drawn = rbpf_optimal(cloud, GRID, step, fix, H, y, rng.random(4000))
    x = step.predict(np.repeat([[0.0], [20.0], [-1.0]], len(GRID), axis=1), GRID)
    posterior = np.exp(-0.5 * distance(fix.W, y[:, None] - H @ x))
    posterior /= posterior.sum()
    shares = np.array([(drawn.f == value).mean() for value in GRID])
    assert np.max(np.abs(shares - posterior)) < 0.035
    likeliest = rbpf_optimal(cloud, GRID, step, fix, H, y, None)
    assert set(likeliest.f) == {GRID[int(np.argmax(posterior))]}


def test_one_shared_covariance_equals_one_for_each_particle() -> None:
    model, N, rng = pade_model(1.0, 0.4, 1.6667), 40, np.random.default_rng(5)
    H4, R3 = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]]), np.diag([0.3, 0.1, 1e-6])
    f = rng.uniform(0.3, 1.0, N)
    cloud = ThetaCloud(f, np.full(N, -np.log(N)), np.repeat([[0.0], [20.0], [-1.0]], N, axis=1))
    P = 1e-3 * np.eye(3)
    own_f, own_x, log_weights = f, np.tile([0.0, 20.0, -1.0, -2.0], (N, 1)), np.full(N, -np.log(N))
    truth, equal_steps = np.array([0.0, 20.0, -1.0, -2.0]), 0
    own_P = [np.diag([1e-3, 1e-3, 1e-3, 0.0]) for _ in range(N)]
    for k in range(8):
        # A command that changes, so that f multiplies a signal and not a constant.
        u = -1.0 + 0.1 * k
        a_z = float(own_x[0, 3])
        truth = (model.Phi0 + 0.7 * model.Phi1) @ truth + (model.Gamma0 + 0.7 * model.Gamma1) * u
        y = truth[:2] + rng.standard_normal(2) @ np.sqrt(R)
        jitter = 0.03 * rng.standard_normal(N)
        step = model.step(a_z, u, 0.05)
        cloud = ThetaCloud(cloud.f, cloud.log_weights, step.predict(cloud.x, cloud.f))
        fix = correction(step.predict_covariance(P), H, R)
        cloud = rbpf(cloud, step, fix, H, y, jitter, 0.5)
        P = fix.P
        own_f = own_f + jitter
        for i in range(N):
            Phi = model.Phi0 + own_f[i] * model.Phi1
            own_x[i] = Phi @ own_x[i] + (model.Gamma0 + own_f[i] * model.Gamma1) * u
            C = Phi @ own_P[i] @ Phi.T + 0.05 * np.outer(model.E, model.E)
            S = H4 @ C @ H4.T + R3
            nu = np.array([*y, model.next_a_z(a_z, u)]) - H4 @ own_x[i]
            K = C @ H4.T @ np.linalg.inv(S)
            own_x[i] += K @ nu
            own_P[i] = C - K @ S @ K.T
            log_weights[i] -= 0.5 * nu @ np.linalg.solve(S, nu)
        if not np.array_equal(cloud.f, own_f):  # resampled
            break
        equal_steps += 1
        weights = np.exp(log_weights - log_weights.max())
        assert cloud.weights == pytest.approx(weights / weights.sum(), abs=1e-9)
        assert np.max(np.abs(cloud.x.T - own_x[:, :3])) < 1e-9
    assert equal_steps >= 3
