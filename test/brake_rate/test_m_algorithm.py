# SPDX-License-Identifier: Apache-2.0
"""Steps of the M-algorithm compared with the same in matrices; impossible rates, and two strata."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from trainid_lab.brake_rate.particles import SPEED, Array, speed_correction
from trainid_ros.brake_rate.motion_model import STATES


@pytest.mark.parametrize('follows', [0, 3])
def test_steps_equal_those_of_matrices(alike: Any, matches: Callable[[Any, Array], None], follows: int) -> None:
    """Steps with and without an update of f, in turn: particles, covariance and moments stay the same."""
    particles, matrices, P, step = alike
    cloud, covariance = particles.cloud, particles.covariance
    rng, y = np.random.default_rng(7), 10.0
    for _ in range(4):
        for _ in range(follows):
            particles.predict()
            covariance.correct(particles.r)
            cloud.follow(y, covariance.K)
            fix = speed_correction(step.predict_covariance(P), particles.r)
            matrices, P = matrices.predicted(step), fix.P
            x = matrices.x + fix.K * (y - matrices.x[0])
            matrices = matrices._replace(x=x, slope=matrices.slope - fix.K[:, 0] * matrices.slope[0])
        particles.predict()
        matrices, P = matrices.predicted(step), step.predict_covariance(P)
        matches(covariance.P, P)
        assert cloud.speed_spread() == pytest.approx(matrices.x[0].var(), rel=1e-6, abs=1e-15)
        for j in range(STATES):
            assert cloud.expected(j) == pytest.approx(matrices.x[j].mean(), rel=1e-9, abs=1e-12)
            assert cloud.spread(j) == pytest.approx(matrices.x[j].var(), rel=1e-6, abs=1e-15)
        y, uniform = cloud.expected(0) + 0.02 * float(rng.standard_normal()), float(rng.random())
        particles.update(y, [4e-4], [uniform])
        fix = speed_correction(P, particles.r)
        matrices, P = matrices.learned(step, fix, SPEED, np.array([y]), 4e-4, 3.0, uniform), fix.P
        matches(covariance.P, P)
        matches(cloud.f, matrices.f)
        matches(cloud.x, matrices.x)
        matches(cloud.slope, matrices.slope)
        assert (cloud.rate, cloud.rate_variance) == pytest.approx((matrices.mean, matrices.variance), rel=1e-9)


def test_impossible_rates_die_out(alike: Any) -> None:
    particles = alike.particles
    particles.predict()
    particles.update(9.9, [4e-4], [0.4], largest=0.9)
    assert particles.cloud.rate < 0.9
    children = 3 * particles.cloud.N
    assert 1.0 <= particles.update(9.9, [4e-4], [0.4], largest=0.0) <= children


def test_survivors_of_two_strata_follow_the_chain(particles: Callable[..., Any]) -> None:
    """Without a transition the strata keep their moments; one whose speeds fit better gains weight."""
    f = [0.5 + 0.001 * i for i in range(30)] + [1.5 + 0.001 * i for i in range(10)]
    two = particles([30, 10], f, [0.5, 0.5])
    for _ in range(5):
        two.predict()
        y = two.cloud.expected(0)
        two.update(y - 0.05, [1e-6, 1e-6], [0.3, 0.8], chain=(1.0, 0.0, 0.0, 1.0))
    assert list(two.cloud.mean) == pytest.approx([0.5145, 1.5045], abs=0.01)
    assert sum(two.cloud.weight) == pytest.approx(1.0)
    f = list(two.cloud.f)
    assert f[:30] == sorted(f[:30])
    assert f[30:] == sorted(f[30:])
