# SPDX-License-Identifier: Apache-2.0
"""Steps, moments and drift of the particles compared with the plain numpy reference; impossible rates; two strata."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from test.brake_rate.particles import INTERVAL, Particles, R, assert_equal, both
from trainid_ros.brake_rate.motion_model import STATES
from trainid_ros.interface.vectors import vec

PROBABILITY = st.floats(0.01, 0.99)


@settings(max_examples=20, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.booleans(),
    PROBABILITY,
    PROBABILITY,
    PROBABILITY,
    st.lists(st.floats(-3.0, 3.0), max_size=6),
)
def test_steps_equal_those_of_the_reference(
    seed: int, jumping: bool, W: float, starts: float, ends: float, deviations: list[float]
) -> None:
    """With and without an update of f, in turn: particles, covariance, weights and moments stay the same."""
    sizes, weight = ([26, 14], [W, 1.0 - W]) if jumping else ([40], [1.0])
    chain = [1.0 - starts, starts, ends, 1.0 - ends] if jumping else [1.0]
    product, reference = both(sizes, seed, weight)
    cloud, rng = product.cloud, np.random.default_rng(seed)
    for deviation in deviations:
        for _ in range(int(rng.integers(0, 3))):
            product.predict()
            reference.predict()
            product.follow(10.0)
            reference.follow(10.0)
        product.predict()
        reference.predict()
        assert_equal(product.covariance.P, reference.P)
        y = cloud.expected(0) + deviation * float(np.sqrt(reference.P[0, 0] + R))
        step = (y, [4e-4, 1e-2][: len(sizes)], rng.random(len(sizes)).tolist(), 1.2, chain)
        product.update(*step)
        reference.update(*step)
        expected = reference.cloud
        assert_equal(product.covariance.P, reference.P)
        assert_equal(cloud.f, expected.f)
        assert_equal(cloud.x, expected.x, 1e-8)
        assert_equal(cloud.weight, expected.W)
        assert_equal(cloud.mean, expected.mean)
        assert_equal(cloud.variance, expected.variance, 1e-8)
        assert_equal(cloud.slope, expected.slope, 1e-7)
        rate = float(expected.W @ expected.mean)
        assert cloud.rate == pytest.approx(rate, rel=1e-9)
        assert cloud.rate_variance == pytest.approx(expected.W @ (expected.variance + (expected.mean - rate) ** 2))


@pytest.mark.parametrize('follows', [0, 3])
def test_the_moments_of_the_motion_are_those_of_the_particles(follows: int) -> None:
    product, reference = both([40], 31, [1.0])
    for item in (product, reference):
        item.predict()
        item.update(9.98, [4e-4], [0.4])
        for _ in range(follows):
            item.predict()
            item.follow(10.0)
        item.predict()
    cloud, x = product.cloud, reference.cloud.x
    assert cloud.speed_spread() == pytest.approx(x[0].var(), rel=1e-6, abs=1e-15)
    for j in range(STATES):
        assert cloud.expected(j) == pytest.approx(x[j].mean(), rel=1e-9, abs=1e-12)
        assert cloud.spread(j) == pytest.approx(x[j].var(), rel=1e-6, abs=1e-15)


def test_impossible_rates_die_out() -> None:
    particles, _ = both([40], 31, [1.0])
    particles.predict()
    particles.update(9.9, [4e-4], [0.4], f_max=0.9)
    assert particles.cloud.rate < 0.9
    children = 3 * int(particles.cloud.N)
    assert 1.0 <= particles.update(9.9, [4e-4], [0.4], f_max=0.0) <= children


def test_survivors_of_two_strata_follow_the_chain() -> None:
    """Without a transition the strata keep their moments; one whose speeds fit better gains weight."""
    f = [0.5 + 0.001 * i for i in range(30)] + [1.5 + 0.001 * i for i in range(10)]
    two = Particles([30, 10], f, [0.5, 0.5])
    for _ in range(5):
        two.predict()
        y = two.cloud.expected(0)
        two.update(y - 0.05, [1e-6, 1e-6], [0.3, 0.8], T=(1.0, 0.0, 0.0, 1.0))
    assert list(two.cloud.mean) == pytest.approx([0.5145, 1.5045], abs=0.01)
    assert sum(two.cloud.weight) == pytest.approx(1.0)
    f = list(two.cloud.f)
    assert f[:30] == sorted(f[:30])
    assert f[30:] == sorted(f[30:])


def test_total_is_the_moments_of_rate_and_errors() -> None:
    particles, reference = both([40], 31, [1.0])
    share = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.5, 2.0])
    for item in (particles, reference):
        item.predict()
        item.update(9.9, [4e-4], [0.4])
    total = reference.cloud.f + share @ reference.cloud.x[3:]
    assert particles.cloud.total(vec[float](share.tolist())) == pytest.approx((total.mean(), total.var()), rel=1e-9)
    expected = float(share @ reference.P[3:, 3:] @ share)
    assert particles.covariance.error_variance(vec[float](share.tolist())) == pytest.approx(expected, rel=1e-9)


def test_a_pause_adds_to_the_variance_of_f_and_moves_the_states_with_it() -> None:
    (particles, reference), added = both([40], 31, [1.0]), 0.01
    particles.predict()
    particles.cloud.inflate_variance(INTERVAL, added)
    reference.predict()
    cloud = reference.cloud
    off = (np.sqrt(1.0 + added / cloud.variance[0]) - 1.0) * (cloud.f - cloud.mean[0])
    assert_equal(particles.cloud.f, cloud.f + off)
    assert_equal(particles.cloud.x, cloud.x + reference.model.gamma[:, None] * off)
    assert_equal(particles.cloud.variance, cloud.variance + added)
    assert np.std(list(particles.cloud.f)) == pytest.approx(math.sqrt(np.var(cloud.f) + added), rel=1e-9)
