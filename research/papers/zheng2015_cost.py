# SPDX-License-Identifier: Apache-2.0
"""CPU time of a step: particles with a shared covariance or one each, in arrays and in loops."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from research.papers.brake_runs import metro_run, metro_train
from research.papers.zheng2015_metro import METRO
from research.papers.zheng2015_paper import DISTURBANCE, MODEL, H, PaperRun, paper_run
from trainid_lab.brake_rate.particles import correction
from trainid_lab.brake_rate.resampling import effective_number, normalise, systematic
from trainid_lab.brake_rate.theta_cloud import ThetaCloud, rbpf
from trainid_ros.setup.pipelines import BRAKE_RATE

if TYPE_CHECKING:
    from collections.abc import Mapping

Array = NDArray[np.float64]

N: Final = 500
_WALK: Final = 0.03
_P0: Final = 1e-3
# a_z is known; a small noise keeps S invertible.
_R_A_Z: Final = 1e-6
_H4: Final = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_COMMAND: Final = -1.0


@dataclass(frozen=True, slots=True)
class Timing:
    """CPU time of a step [us]."""

    name: str
    p50: float
    p99: float


@dataclass(frozen=True, slots=True)
class Draws:
    """Random numbers of a run of K steps: initial rates (N,), their walks (K, N), one uniform per step (K,)."""

    f: Array
    walk: Array
    uniform: Array

    @classmethod
    def of(cls, seed: int, steps: int) -> Draws:
        """Return the draws of a seed."""
        rng = np.random.default_rng([seed, 77])
        return cls(rng.uniform(0.3, 1.0, N), _WALK * rng.standard_normal((steps, N)), rng.random(steps))


def shared(run: PaperRun, draws: Draws) -> tuple[Array, Array]:
    """Run the RBPF with one covariance for all particles; return means of f and CPU times of the steps [us]."""
    cloud = ThetaCloud(draws.f, np.full(N, -math.log(N)), np.repeat([[0.0], [20.0], [-1.0]], N, axis=1))
    P, means, times = _P0 * np.eye(3), [], []
    for step, y, walk, uniform in zip(run.steps, run.y, draws.walk, draws.uniform, strict=False):
        begin = time.thread_time_ns()
        cloud = ThetaCloud(cloud.f, cloud.log_weights, step.predict(cloud.x, cloud.f))
        fix = correction(step.predict_covariance(P), H, run.R)
        cloud = rbpf(cloud, step, fix, H, y, walk, float(uniform))
        P = fix.P
        means.append(float(cloud.f @ cloud.weights))
        times.append((time.thread_time_ns() - begin) / 1e3)
    return np.array(means), np.array(times)


# Advances particles one step: f, x (N, 4), P (N, 4, 4), measurement, R -> log-likelihood, x, P.
Advance = Callable[[Array, Array, Array, Array, Array], tuple[Array, Array, Array]]


def own_covariance(run: PaperRun, draws: Draws, steps: int, advance: Advance) -> tuple[Array, Array]:
    """Run the RBPF with a covariance per particle on the paper's four states; return as :func:`shared`."""
    f, log_weights = draws.f, np.full(N, -math.log(N))
    x = np.tile([0.0, 20.0, -1.0, -2.0], (N, 1))
    P = np.tile(np.diag([_P0, _P0, _P0, 0.0]), (N, 1, 1))
    R = np.diag([*np.diag(run.R), _R_A_Z])
    means, times, a_z = [], [], -2.0
    for k in range(steps):
        begin = time.thread_time_ns()
        a_z = MODEL.next_a_z(a_z, _COMMAND)
        f = f + draws.walk[k]
        log_likelihood, x, P = advance(f, x, P, np.array([*run.y[k], a_z]), R)
        log_weights = normalise(log_weights + log_likelihood)
        weights = np.exp(log_weights)
        if effective_number(weights) < 0.5 * N:
            kept = systematic(weights, N, float(draws.uniform[k]))
            f, x, P, log_weights = f[kept], x[kept], P[kept], np.full(N, -math.log(N))
        means.append(float(f @ np.exp(log_weights)))
        times.append((time.thread_time_ns() - begin) / 1e3)
    return np.array(means), np.array(times)


def batched(f: Array, x: Array, P: Array, y: Array, R: Array) -> tuple[Array, Array, Array]:
    """Advance all particles at once in arrays of matrices."""
    Phi = MODEL.Phi0 + f[:, None, None] * MODEL.Phi1
    x = (Phi @ x[:, :, None])[:, :, 0] + _COMMAND * (MODEL.Gamma0 + f[:, None] * MODEL.Gamma1)
    P = Phi @ P @ Phi.transpose(0, 2, 1) + DISTURBANCE * np.outer(MODEL.E, MODEL.E)
    S = _H4 @ P @ _H4.T + R
    inverse = np.linalg.inv(S)
    nu = y - x @ _H4.T
    K = P @ _H4.T @ inverse
    whitened = (inverse @ nu[:, :, None])[:, :, 0]
    x = x + (K @ nu[:, :, None])[:, :, 0]
    P = P - K @ S @ K.transpose(0, 2, 1)
    return -0.5 * ((nu * whitened).sum(axis=1) + np.log(np.linalg.det(S))), x, P


def looped(f: Array, x: Array, P: Array, y: Array, R: Array) -> tuple[Array, Array, Array]:
    """Advance one particle after another."""
    log_likelihood, x_after, P_after = np.empty(N), np.empty_like(x), np.empty_like(P)
    for i in range(N):
        Phi = MODEL.Phi0 + f[i] * MODEL.Phi1
        m = Phi @ x[i] + _COMMAND * (MODEL.Gamma0 + f[i] * MODEL.Gamma1)
        C = Phi @ P[i] @ Phi.T + DISTURBANCE * np.outer(MODEL.E, MODEL.E)
        S = _H4 @ C @ _H4.T + R
        inverse = np.linalg.inv(S)
        nu = y - _H4 @ m
        K = C @ _H4.T @ inverse
        log_likelihood[i] = -0.5 * (nu @ inverse @ nu + math.log(np.linalg.det(S)))
        x_after[i], P_after[i] = m + K @ nu, C - K @ S @ K.T
    return log_likelihood, x_after, P_after


def compare_covariances(seed: int) -> tuple[tuple[Timing, ...], float]:
    """Time the three forms; return the times and the largest difference of a mean of f."""
    run = paper_run(seed)
    draws = Draws.of(seed, len(run.steps))
    shared(run, draws)  # first calls are slow
    together, quick = shared(run, draws)
    arrays, slow = own_covariance(run, draws, len(run.steps), batched)
    loops, slowest = own_covariance(run, draws, 20, looped)
    difference = max(float(np.abs(arrays - together).max()), float(np.abs(loops - together[:20]).max()))
    named = ((f'RBPF, {N}: shared covariance', quick), (f'RBPF, {N}: own, in arrays', slow))
    timings = [_timing(name, times) for name, times in (*named, (f'RBPF, {N}: own, in loops', slowest))]
    return tuple(timings), difference


def time_estimators(seed: int) -> tuple[Timing, ...]:
    """Time the estimators of the nodes at updates; p50 and p99 over the samples of one run."""
    subjects: tuple[tuple[str, str, Mapping[str, float]], ...] = (
        ('KF', 'KF', METRO),
        ('IMM', 'IMM', METRO),
        ('GSMA, 100 (default)', 'GSMA', METRO),
        ('GSMA, 500', 'GSMA', METRO | {'particles': 500}),
        ('RBPF, 500', 'RBPF', METRO),
        ('SMA as printed', 'SMA', METRO),
        ('GSMA as printed', 'GSMA-printed', METRO),
    )
    return tuple(_timing(label, _step_times(seed, name, settings)) for label, name, settings in subjects)


def _step_times(seed: int, name: str, settings: Mapping[str, float]) -> Array:
    run = metro_run(seed, stops=3)
    estimator = BRAKE_RATE.make(BRAKE_RATE.choose(name, **settings), metro_train(), np.random.default_rng(seed))
    times = []
    for sample in run.samples:
        begin = time.thread_time_ns()
        estimator.step(sample)
        took = (time.thread_time_ns() - begin) / 1e3
        if estimator.estimate(sample.speed).observable:
            times.append(took)
    return np.array(times)


def _timing(name: str, times: Array) -> Timing:
    return Timing(name, float(np.median(times)), float(np.quantile(times, 0.99)))
