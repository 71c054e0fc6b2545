# SPDX-License-Identifier: Apache-2.0
"""Particles and their covariance compared with the same steps in matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trainid_lab.brake_rate.group_cloud import GroupCloud as Reference
from trainid_lab.brake_rate.particles import SPEED, Array, error_covariance, speed_correction, speed_step, started
from trainid_ros.brake_rate.covariance import Covariance
from trainid_ros.brake_rate.group_cloud import GroupCloud
from trainid_ros.brake_rate.posterior import STATES, Start, Transition
from trainid_ros.vectors import vec

LEAN = (0.1, -0.2, 0.03, 0.02, -0.01, 0.05, 0.04, -0.2)
KEEP = (0.999, 0.998, 0.99, 0.99, 0.98, 1.0, 0.97, 0.5)
Q_E = (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4, 8e-4, 7e-4)
STDS = (0.1, 0.1, 0.25, 0.25, 0.02, 0.08, 0.06, 0.005)
INTERVAL = Transition(0.2, 0.1, 0.6, 0.012, 0.37, 0.99, 0.01, 1e-5, 1e-6, LEAN, KEEP, Q_E)
START = Start(10.0, -0.5, (1e-3, 2e-3, 3e-5), KEEP, Q_E)
R, LARGEST, WALK = 7e-4, 3.0, 4e-4
N = 40


def array(values: Any, *shape: int) -> Array:
    return np.array(list(values)).reshape(shape)


def matches(found: Any, expected: Array) -> None:
    np.testing.assert_allclose(array(found, *expected.shape), expected, rtol=1e-9, atol=1e-12)


def started_alike() -> tuple[GroupCloud, Covariance, Reference, Array]:
    """Return particles at an anchor, and the same in matrices."""
    f = np.sort(np.random.default_rng(31).normal(0.9, 0.1, N))
    cloud, covariance = GroupCloud([N]), Covariance()
    cloud.start(f.tolist(), [1.0])
    covariance.reset(STDS)
    cloud.anchor(START)
    covariance.anchor(START)
    x, slope = np.zeros((STATES, N)), np.zeros(STATES)
    x[0], x[1], slope[1] = START.speed, START.target * f, START.target
    return cloud, covariance, Reference(f, x, f.mean(), f.var(), slope), started(error_covariance(STDS), START)


@pytest.mark.parametrize('follows', [0, 3])
def test_steps_equal_those_of_matrices(follows: int) -> None:
    """Steps with and without an update of f, in turn: particles, covariance and moments stay the same."""
    cloud, covariance, reference, P = started_alike()
    rng, step, y = np.random.default_rng(7), speed_step(INTERVAL), 10.0
    for _ in range(4):
        for _ in range(follows):
            cloud.predict(INTERVAL)
            covariance.predict(INTERVAL)
            covariance.correct(R)
            cloud.follow(y, covariance.K)
            fix = speed_correction(step.predict_covariance(P), R)
            reference, P = reference.predicted(step), fix.P
            x = reference.x + fix.K * (y - reference.x[0])
            reference = reference._replace(x=x, slope=reference.slope - fix.K[:, 0] * reference.slope[0])
        cloud.predict(INTERVAL)
        covariance.predict(INTERVAL)
        reference, P = reference.predicted(step), step.predict_covariance(P)
        matches(covariance.P, P)
        assert cloud.speed_spread() == pytest.approx(reference.x[0].var(), rel=1e-6, abs=1e-15)
        for j in range(STATES):
            assert cloud.expected(j) == pytest.approx(reference.x[j].mean(), rel=1e-9, abs=1e-12)
            assert cloud.spread(j) == pytest.approx(reference.x[j].var(), rel=1e-6, abs=1e-15)
        y, uniform = cloud.expected(0) + 0.02 * float(rng.standard_normal()), float(rng.random())
        fix = speed_correction(P, R)
        S = covariance.correct(R)
        cloud.learn(INTERVAL, vec[float]([WALK]), y, covariance.K, S, LARGEST, vec[float]([1.0]), [uniform])
        reference = reference.learned(step, fix, SPEED, np.array([y]), WALK, LARGEST, uniform)
        P = fix.P
        matches(covariance.P, P)
        matches(cloud.f, reference.f)
        matches(cloud.x, reference.x)
        matches(cloud.slope, reference.slope)
        assert (cloud.rate, cloud.rate_variance) == pytest.approx((reference.mean, reference.variance), rel=1e-9)


def test_total_is_the_moments_of_rate_and_errors() -> None:
    cloud, covariance, reference, P = started_alike()
    step, share = speed_step(INTERVAL), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.5, 2.0])
    cloud.predict(INTERVAL)
    covariance.predict(INTERVAL)
    S = covariance.correct(R)
    cloud.learn(INTERVAL, vec[float]([WALK]), 9.9, covariance.K, S, LARGEST, vec[float]([1.0]), [0.4])
    fix = speed_correction(step.predict_covariance(P), R)
    reference = reference.predicted(step).learned(step, fix, SPEED, np.array([9.9]), WALK, LARGEST, 0.4)
    total = reference.f + share @ reference.x[3:]
    assert cloud.total(vec[float](share.tolist())) == pytest.approx((total.mean(), total.var()), rel=1e-9)
    expected = float(share @ fix.P[3:, 3:] @ share)
    assert covariance.error_variance(vec[float](share.tolist())) == pytest.approx(expected, rel=1e-9)


def test_a_pause_widens_f_and_what_moves_with_it() -> None:
    cloud, _, reference, _ = started_alike()
    step, added = speed_step(INTERVAL), 0.01
    cloud.predict(INTERVAL)
    cloud.widen(INTERVAL, added)
    reference = reference.predicted(step)
    off = (np.sqrt(1.0 + added / reference.variance) - 1.0) * (reference.f - reference.mean)
    matches(cloud.f, reference.f + off)
    matches(cloud.x, reference.x + step.gamma[:, None] * off)
    matches(cloud.variance, np.array([reference.variance + added]))


def test_impossible_rates_die_out() -> None:
    cloud, covariance, _, _ = started_alike()
    cloud.predict(INTERVAL)
    covariance.predict(INTERVAL)
    S = covariance.correct(R)
    cloud.learn(INTERVAL, vec[float]([WALK]), 9.9, covariance.K, S, 0.9, vec[float]([1.0]), [0.4])
    assert cloud.rate < 0.9
    assert (
        1.0 <= cloud.learn(INTERVAL, vec[float]([WALK]), 9.9, covariance.K, S, 0.0, vec[float]([1.0]), [0.4]) <= 3 * N
    )


def test_survivors_of_two_strata_follow_the_chain() -> None:
    """Without a transition the strata keep their moments; one whose speeds fit better gains weight."""
    cloud, covariance = GroupCloud([30, 10]), Covariance()
    cloud.start([0.5 + 0.001 * i for i in range(30)] + [1.5 + 0.001 * i for i in range(10)], [0.5, 0.5])
    covariance.reset(STDS)
    cloud.anchor(START)
    covariance.anchor(START)
    chain = vec[float]([1.0, 0.0, 0.0, 1.0])
    for _ in range(5):
        cloud.predict(INTERVAL)
        covariance.predict(INTERVAL)
        y = cloud.expected(0)
        S = covariance.correct(R)
        walk = vec[float]([1e-6, 1e-6])
        cloud.learn(INTERVAL, walk, y - 0.05, covariance.K, S, LARGEST, chain, [0.3, 0.8])
    assert list(cloud.mean) == pytest.approx([0.5145, 1.5045], abs=0.01)
    assert sum(cloud.weight) == pytest.approx(1.0)
    f = list(cloud.f)
    assert f[:30] == sorted(f[:30])
    assert f[30:] == sorted(f[30:])
