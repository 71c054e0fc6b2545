# SPDX-License-Identifier: Apache-2.0
"""Brake rate estimators of the nodes on a metro train at 5 Hz: accuracy, coverage, jumps, long runs, CPU time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from research.papers.brake_runs import (
    JUMP_AFTER_S,
    MAP_ERROR,
    BrakeRun,
    hard_run,
    jump_run,
    metro_run,
    metro_train,
    unbraked_run,
    walk_run,
)
from research.papers.zheng2015_paper import DISTURBANCE, MODEL, H, PaperRun, paper_run
from trainid_lab.brake_rate.particles import correction, effective_number, normalise, systematic
from trainid_lab.brake_rate.theta_cloud import ThetaCloud, rbpf
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator, DisturbanceNoise
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.setup.pipelines import BRAKE_RATE

Array = NDArray[np.float64]

FIRST_SEED: Final = 5000
# True settings of the train: the map error, and on the random walk the exact noise.
METRO: Final[dict[str, float]] = {'disturbance_std': MAP_ERROR, 'acceleration_noise': 0.002}
WALK: Final = METRO | {'speed_std': 0.02, 'force_error': 0.0}
SHIPPED: Final[dict[str, float]] = {}
DRIFTS: Final[dict[str, float]] = {'drift': 0.01}
_SIGMA_95: Final = 1.959964
_SETTLED_S: Final = 3.0
_MOVING: Final = 1.0
_GOOD: Final = 0.05
# Printed filters may collapse to one value.
_MIN_STD: Final = 1e-12
_FOUND: Final = 0.07
_AFTER_JUMP_S: Final = 10.0
# The growth law of the standard deviation is checked from this time after brake release on [s].
_RELEASED_S: Final = 3.0
LATER_S: Final = (0.0, 2.0, 4.0, 10.0)

# Name of the row, algorithm, changed settings, given size of the disturbance [m/s^2] (NaN: estimated).
Rows = tuple[tuple[str, str, dict[str, float], float], ...]

ON_HARD: Final[Rows] = (
    ('GSMA as shipped', 'GSMA', SHIPPED, math.nan),
    ('GSMA, 500 particles', 'GSMA', {'particles': 500}, math.nan),
    ('KF as shipped', 'KF', SHIPPED, math.nan),
    ('IMM as shipped', 'IMM', SHIPPED, math.nan),
    ('RBPF as shipped', 'RBPF', SHIPPED, math.nan),
    ('GSMA, disturbance size given', 'GSMA', METRO, MAP_ERROR),
    ('KF, disturbance size given', 'KF', METRO, MAP_ERROR),
    ('GSMA, wrong size 0.006 m/s^2 given', 'GSMA', SHIPPED, 0.006),
    ('KF without disturbance state', 'KF', METRO, 0.0),
    ('SMA as printed', 'SMA', METRO, MAP_ERROR),
    ('GSMA as printed', 'GSMA-printed', METRO, MAP_ERROR),
)
ON_METRO: Final[Rows] = (
    ('GSMA as shipped', 'GSMA', SHIPPED, math.nan),
    ('KF, disturbance size given', 'KF', METRO, MAP_ERROR),
)
ON_WALK: Final[Rows] = (
    ('GSMA as shipped', 'GSMA', SHIPPED, math.nan),
    ('GSMA without jumps', 'GSMA', {'jump_rate': 0.0}, math.nan),
    ('IMM as shipped', 'IMM', SHIPPED, math.nan),
    ('RBPF as shipped', 'RBPF', SHIPPED, math.nan),
    ('KF, all noises given: exact', 'KF', WALK, MAP_ERROR),
)
ON_JUMP: Final[Rows] = (
    ('GSMA as shipped', 'GSMA', SHIPPED, math.nan),
    ('IMM as shipped', 'IMM', SHIPPED, math.nan),
    ('KF as shipped', 'KF', SHIPPED, math.nan),
    ('KF, drift 0.02', 'KF', {'drift': 0.02}, math.nan),
)
ON_UNBRAKED: Final[Rows] = (
    ('GSMA as shipped', 'GSMA', SHIPPED, math.nan),
    ('GSMA, drift 0.01', 'GSMA', DRIFTS, math.nan),
    ('KF as shipped', 'KF', SHIPPED, math.nan),
    ('IMM as shipped', 'IMM', SHIPPED, math.nan),
)


@dataclass(frozen=True, slots=True)
class Score:
    """Score of an estimator on one run, while braking, from 3 s after the command on and above 1 m/s."""

    mae: float  # Mean absolute error of the brake rate [1]
    bias: float  # Mean error of the brake rate [1]
    inside_68: float  # Share of errors within one standard deviation
    inside_95: float  # The same within 1.96
    good_s: float  # Time after the first command from which on the error stays within 0.05 in the first braking [s]
    found_s: float = math.nan  # Time from the jump to an error below 0.07 [s], inf if never; NaN without a jump
    # Largest relative deviation of std from sqrt(s^2 + drift^2 t) without braking; NaN if not evaluated.
    law: float = math.nan
    later: tuple[float, ...] = ()  # Absolute error 0, 2, 4 and 10 s after the brake command of the last phase [1]


@dataclass(frozen=True, slots=True)
class MetroScores:
    """All estimators on one seed, in the order of the lists above."""

    hard: tuple[Score, ...]
    metro: tuple[Score, ...]
    walk: tuple[Score, ...]
    jump: tuple[Score, ...]
    unbraked: tuple[Score, ...]


def score_seed(seed: int) -> MetroScores:
    """Run all estimators on all data of a seed."""

    def scored(run: BrakeRun, rows: Rows, judge: Callable[..., Score] = score) -> tuple[Score, ...]:
        return tuple(judge(run, trace(run, name, seed, changed, std)) for _, name, changed, std in rows)

    unbraked = unbraked_run(seed)
    return MetroScores(
        scored(hard_run(seed), ON_HARD),
        scored(metro_run(seed), ON_METRO),
        scored(walk_run(seed), ON_WALK),
        scored(jump_run(seed), ON_JUMP, _score_jump),
        tuple(
            _score_unbraked(unbraked, trace(unbraked, name, seed, changed, std), changed)
            for _, name, changed, std in ON_UNBRAKED
        ),
    )


def trace(run: BrakeRun, name: str, seed: int, settings: Mapping[str, float], known_std: float = math.nan) -> Array:
    """Return mean and standard deviation of f, and 1 if f was observable, after every sample, shape (n, 3).

    The size of the disturbance is estimated, or given as ``known_std`` [m/s^2].
    """
    choice = BRAKE_RATE.choose(name, **settings)
    estimator = BRAKE_RATE.make(choice, metro_train(), np.random.default_rng(seed))
    if math.isfinite(known_std) and isinstance(estimator, BrakeRateEstimator):
        estimator.state.disturbance = DisturbanceNoise(0.0, known_std * known_std)
    rows = []
    for sample in run.samples:
        estimator.step(sample)
        e = estimator.estimate(sample.speed)
        rows.append((e.brake_rate, e.brake_rate_std, float(e.observable)))
    return np.array(rows)


def score(run: BrakeRun, got: Array, without: NDArray[np.bool_] | None = None) -> Score:
    """Score all braking samples except those in ``without``."""
    counted = (run.braked_s > _SETTLED_S) & (run.speed > _MOVING)
    if without is not None:
        counted &= ~without
    error = got[:, 0] - run.rate
    z = np.abs(error / np.maximum(got[:, 1], _MIN_STD))[counted]
    first = run.phase == run.phase[int(np.argmax(run.braked_s >= 0.0))]
    wrong = np.flatnonzero(np.abs(error[first]) >= _GOOD)
    return Score(
        mae=float(np.abs(error[counted]).mean()),
        bias=float(error[counted].mean()),
        inside_68=float((z <= 1.0).mean()),
        inside_95=float((z <= _SIGMA_95).mean()),
        good_s=float(run.braked_s[first][wrong[-1]]) if len(wrong) else 0.0,
    )


def _score_jump(run: BrakeRun, got: Array) -> Score:
    """Score the time to detect the jump, and all samples except the ten seconds after it."""
    since = np.where(run.phase == run.phase[-1], run.braked_s - JUMP_AFTER_S, math.nan)
    after = since > 0.0
    found = after & (np.abs(got[:, 0] - run.rate) < _FOUND)
    found_s = float(since[int(np.argmax(found))]) if found.any() else math.inf
    return replace(score(run, got, after & (since <= _AFTER_JUMP_S)), found_s=found_s)


def _score_unbraked(run: BrakeRun, got: Array, settings: Mapping[str, float]) -> Score:
    """Score the growth of the standard deviation between the brakings, and the errors at the next braking."""
    drift = settings.get('drift', BrakeRateConfig().drift)
    times = np.array([(s.stamp_ns - run.samples[0].stamp_ns) / NS_PER_S for s in run.samples])
    last_learned = int(np.flatnonzero((got[:, 2] > 0.5) & (run.phase < run.phase[-1]))[-1])
    start = last_learned + round(_RELEASED_S / 0.2)
    rest = slice(start, int(np.flatnonzero(run.phase == run.phase[-1])[0]))
    law = np.sqrt(got[start, 1] ** 2 + drift**2 * (times[rest] - times[start]))
    begin = rest.stop
    later = tuple(float(abs(got[begin + round(t / 0.2), 0] - run.rate[begin + round(t / 0.2)])) for t in LATER_S)
    return replace(score(run, got), law=float(np.max(np.abs(got[rest, 1] / law - 1.0))), later=later)


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
