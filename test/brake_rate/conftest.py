# SPDX-License-Identifier: Apache-2.0
"""Particles at an anchor, and the same in matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest

from trainid_lab.brake_rate.linear_group_cloud import LinearGroupCloud
from trainid_lab.brake_rate.particles import Array, LinearStep, error_covariance, speed_step, started
from trainid_ros.brake_rate.gsma import Covariance
from trainid_ros.brake_rate.m_algorithm import GroupCloud, MAlgorithm
from trainid_ros.brake_rate.motion_model import STATES, Start, Transition
from trainid_ros.interface.vectors import vec

LEAN = (0.1, -0.2, 0.03, 0.02, -0.01, 0.05, 0.04, -0.2)
KEEP = (0.999, 0.998, 0.99, 0.99, 0.98, 1.0, 0.97, 0.5)
Q_E = (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4, 8e-4, 7e-4)
STDS = (0.1, 0.1, 0.25, 0.25, 0.02, 0.08, 0.06, 0.005)
INTERVAL = Transition(0.2, 0.1, 0.6, 0.012, 0.37, 0.99, 0.01, 1e-5, 1e-6, LEAN, KEEP, Q_E)
START = Start(10.0, -0.5, (1e-3, 2e-3, 3e-5), KEEP, Q_E)
N = 40


class Particles:
    """A cloud with its algorithm and covariance, at an anchor."""

    def __init__(self, sizes: list[int], f: list[float], weight: list[float]) -> None:
        self.cloud, self.covariance, self.interval, self.r = GroupCloud(sizes), Covariance(), INTERVAL, 7e-4
        self.algorithm = MAlgorithm(self.cloud)
        self.cloud.start(f, weight)
        self.covariance.reset(STDS)
        self.cloud.reinit_motion(START)
        self.covariance.reinit_motion(START)

    def predict(self) -> None:
        self.cloud.predict(INTERVAL)
        self.covariance.predict(INTERVAL)

    def update(
        self, y: float, walk: list[float], uniforms: list[float], largest: float = 3.0, chain: Sequence[float] = (1.0,)
    ) -> float:
        K, S = self.covariance.K, self.covariance.correct(self.r)
        return self.algorithm.update(INTERVAL, vec[float](walk), y, K, S, largest, vec[float](chain), uniforms)


class Alike(NamedTuple):
    """Particles of one stratum, the same in matrices with the covariance P given f, and the step of both."""

    particles: Particles
    matrices: LinearGroupCloud
    P: Array
    step: LinearStep


@pytest.fixture
def particles() -> Callable[[list[int], list[float], list[float]], Particles]:
    return Particles


@pytest.fixture
def alike() -> Alike:
    f = np.sort(np.random.default_rng(31).normal(0.9, 0.1, N))
    x, slope = np.zeros((STATES, N)), np.zeros(STATES)
    x[0], x[1], slope[1] = START.speed, START.target * f, START.target
    matrices = LinearGroupCloud(f, x, float(f.mean()), float(f.var()), slope)
    P = started(error_covariance(STDS), START)
    return Alike(Particles([N], f.tolist(), [1.0]), matrices, P, speed_step(INTERVAL))


@pytest.fixture
def matches() -> Callable[[Any, Array], None]:
    def check(found: Any, expected: Array) -> None:
        np.testing.assert_allclose(np.array(list(found)).reshape(expected.shape), expected, rtol=1e-9, atol=1e-12)

    return check
