# SPDX-License-Identifier: Apache-2.0
"""Particles of the product after a restart of the motion, and the same in the plain numpy reference."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from test.brake_rate.reference_gsma import Array, Cloud, Model, correct, follow, predict, update
from trainid_ros.brake_rate.gsma import Covariance
from trainid_ros.brake_rate.m_algorithm import GroupCloud
from trainid_ros.brake_rate.motion_model import STATES, Start, Transition
from trainid_ros.interface.vectors import vec

LEAN = (0.1, -0.2, 0.03, 0.02, -0.01, 0.05, 0.04, -0.2)
KEEP = (0.999, 0.998, 0.99, 0.99, 0.98, 1.0, 0.97, 0.5)
Q_E = (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4, 8e-4, 7e-4)
STDS = (0.1, 0.1, 0.25, 0.25, 0.02, 0.08, 0.06, 0.005)
INTERVAL = Transition(0.2, 0.1, 0.6, 0.012, 0.37, 0.99, 0.01, 1e-5, 1e-6, LEAN, KEEP, Q_E)
START = Start(10.0, -0.5, (1e-3, 2e-3, 3e-5), KEEP, Q_E)
R = 7e-4


class Particles:
    """A cloud with its algorithm and covariance."""

    def __init__(self, sizes: list[int], f: list[float], weight: list[float]) -> None:
        self.cloud, self.covariance = GroupCloud(sizes), Covariance()
        self.cloud.start(f, weight)
        self.covariance.reset(STDS)
        self.cloud.reinit_motion(START)
        self.covariance.reinit_motion(START)

    def predict(self) -> None:
        self.cloud.predict(INTERVAL)
        self.covariance.predict(INTERVAL)

    def follow(self, y: float) -> None:
        self.covariance.correct(R)
        self.cloud.follow(y, self.covariance.K)

    def update(
        self, y: float, q: Iterable[float], draws: list[float], f_max: float = 3.0, T: Iterable[float] = (1.0,)
    ) -> float:
        K, S = self.covariance.K, self.covariance.correct(R)
        return self.cloud.update(INTERVAL, vec[float](list(q)), y, K, S, f_max, vec[float](list(T)), draws)


def model() -> Model:
    """Return the interval as matrices on x = [v, a, b, e]."""
    Phi, gamma, known = np.eye(STATES), np.zeros(STATES), np.zeros(STATES)
    Phi[0] = (1.0, INTERVAL.reach, INTERVAL.dt, *LEAN)
    Phi[range(1, STATES), range(1, STATES)] = (INTERVAL.decay, INTERVAL.rho, *KEEP)
    gamma[:2], known[0] = (INTERVAL.gain_v, INTERVAL.gain_a), INTERVAL.known
    return Model(Phi, gamma, known, np.diag([INTERVAL.q_v, 0.0, INTERVAL.q_b, *Q_E]))


class Reference:
    """The same particles in matrices."""

    def __init__(self, sizes: list[int], f: list[float], weight: list[float]) -> None:
        of, rates, n = np.repeat(np.arange(len(sizes)), sizes), np.array(f), len(sizes)
        x, slope = np.zeros((STATES, len(f))), np.zeros((STATES, n))
        x[0], x[1], slope[1] = START.speed, START.target * rates, START.target
        mean, variance = (np.array([g(rates[of == k]) for k in range(n)]) for g in (np.mean, np.var))
        self.cloud = Cloud(rates, x, of, np.array(weight), mean, variance, slope)
        stds = np.array(STDS) * KEEP
        self.P, self.model = np.diag([*START.variances, *(stds**2 + Q_E)]), model()

    def predict(self) -> None:
        self.cloud, self.P = predict(self.cloud, self.P, self.model)

    def follow(self, y: float) -> None:
        _, K, self.P = correct(self.P, R)
        self.cloud = follow(self.cloud, y, K)

    def update(
        self, y: float, q: Iterable[float], draws: list[float], f_max: float = 3.0, T: Iterable[float] = (1.0,)
    ) -> None:
        S, K, self.P = correct(self.P, R)
        walk, chain, n = np.array(list(q)), np.array(list(T)), len(draws)
        self.cloud = update(self.cloud, self.model, y, S, K, walk, chain.reshape(n, n), f_max, np.array(draws))


def both(sizes: list[int], seed: int, weight: list[float]) -> tuple[Particles, Reference]:
    """Return particles with random rates, in order within each stratum, in both forms."""
    rng = np.random.default_rng(seed)
    f = [rate for size in sizes for rate in np.sort(rng.normal(0.9, 0.1, size)).tolist()]
    return Particles(sizes, f, weight), Reference(sizes, f, weight)


def assert_equal(found: Iterable[float], expected: Array, rtol: float = 1e-9) -> None:
    np.testing.assert_allclose(np.array(list(found)).reshape(expected.shape), expected, rtol=rtol, atol=1e-12)
