# SPDX-License-Identifier: Apache-2.0
"""GSMA with its default settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

Journey = Callable[..., list[Sample]]
CONFIG = GsmaConfig()
STATED = Davis(1.5, 0.03, 0.004)
TAU, LAG, DT, GRADIENT = 0.4, 3, 0.2, 6.0
INERTIA = 1000.0 * 1.08 / 9.80665


def exactly_known(train_file: TrainFile) -> TrainFile:
    train, line = replace(train_file.train, mass_std=0.0, force_std=0.0), replace(train_file.line, gradient_std=0.0)
    return replace(train_file, train=train, line=line, brake=replace(train_file.brake, timing_std=0.0))


def gsma(train_file: TrainFile, config: GsmaConfig = CONFIG, seed: int = 1) -> Gsma:
    return Gsma(train_file, config, np.random.default_rng(seed))


def braking(t: float) -> float:
    """Return the levels of one long braking from 4 s on; the gradient assists it."""
    return 0.0 if t < 4.0 else -(0.35 + 0.15 * math.sin(0.4 * (0.2 * round(5 * t))))


def stop_and_go(t: float) -> float:
    return -0.6 if 35.0 < t % 80.0 < 72.0 else 0.0


def power(t: float) -> float:
    return 60.0 if t % 80.0 < 30.0 else 0.0


class Kalman:
    """The exact filter for one uninterrupted braking of a train without traction, implemented independently."""

    def __init__(self, first: Sample, config: GsmaConfig, disturbance: float) -> None:
        self.config = config
        self.r = config.speed_std**2
        self.x = np.array([first.speed, 0.0, 0.0, 1.0])
        self.P = np.diag(np.square([config.speed_std, 0.05, disturbance, config.prior_std]))
        self.target = 0.0
        self.waited = 0.0

    def step(self, sample: Sample, delayed: float, r: float, disturbance: float) -> None:
        config, decay, v = self.config, math.exp(-DT / TAU), sample.speed
        gain_a = delayed * (1.0 - decay)
        gain_v = delayed * (DT - TAU * (1.0 - decay))
        rho = math.exp(-v * DT / config.disturbance_length)
        reach = TAU * (1.0 - decay)
        F = np.array([[1.0, reach, DT, gain_v], [0.0, decay, 0.0, gain_a], [0.0, 0.0, rho, 0.0], [0.0, 0.0, 0.0, 1.0]])
        w = STATED.a + STATED.b * v + STATED.c * v * v
        known = -(GRADIENT + w) / INERTIA
        before, self.target = self.target, decay * self.target + gain_a
        walk = config.drift**2 * DT
        observable = max(abs(before), abs(self.target)) >= config.min_braking
        # f always drifts, but without a brake it has no effect and is not observable.
        self.P[3, 3] += walk
        self.x = F @ self.x + np.array([known * DT, 0.0, 0.0, 0.0])
        Q = np.diag([config.acceleration_noise**2 * DT, 0.0, disturbance**2 * (1.0 - rho * rho), 0.0])
        self.P = F @ self.P @ F.T + Q
        K = self.P[:, 0] / (self.P[0, 0] + r)
        if not observable:
            K = K * [1.0, 1.0, 1.0, 0.0]
        A = np.eye(4)
        A[:, 0] -= K
        self.x = self.x + K * (v - self.x[0])
        self.P = A @ self.P @ A.T + r * np.outer(K, K)


def compare(train_file: TrainFile, journey: Journey, config: GsmaConfig, seed: int) -> tuple[float, float]:
    """Return rms difference of the means in KF standard deviations, and mean ratio of the standard deviations."""
    rng = np.random.default_rng([seed, 7])
    start = 0.15 * float(np.clip(rng.standard_normal(), -2.0, 2.0))
    walk = 1.0 + start + config.drift * math.sqrt(DT) * np.cumsum(rng.standard_normal(251))
    samples = journey(
        46.0,
        brake=braking,
        rate=lambda t: float(walk[round(5 * t)]),
        resistance=lambda _: STATED,
        speed=25.0,
        seed=seed,
    )
    particles = gsma(exactly_known(train_file), config, seed)
    exact = Kalman(samples[0], config, particles.state.disturbance.std)
    particles.step(samples[0])
    differences, ratios = [], []
    for k, item in enumerate(samples[1:], start=1):
        if item.speed < 1.0:
            break
        disturbance, excess = particles.state.disturbance.std, particles.state.excess
        particles.step(item)
        delayed = samples[k - 1 - LAG].brake_command if k > LAG else 0.0
        exact.step(item, delayed, particles.state.noise.variance * excess, disturbance)
        if particles.state.observable:
            e, std = particles.estimate(0.0), math.sqrt(exact.P[3, 3])
            differences.append((e.brake_rate - exact.x[3]) / std)
            ratios.append(e.brake_rate_std / std)
    assert len(differences) > 100
    return float(np.sqrt(np.mean(np.square(differences)))), float(np.mean(ratios))
