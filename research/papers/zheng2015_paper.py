# SPDX-License-Identifier: Apache-2.0
"""The experiment of Zheng et al. 2015: their train at 1 s steps, their ramp of f, and all filters.

Unpublished values are chosen to match the printed table as far as possible: a command of -1 m/s^2 keeps the printed
initial state in equilibrium, and the measurement noise is the one at which a filter that is given f has exactly the
printed errors of displacement and speed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_lab.brake_rate.pade_model import pade_model
from trainid_lab.brake_rate.particles import Correction, LinearStep, correction
from trainid_lab.brake_rate.theta_cloud import (
    LinearGroupCloud,
    MRule,
    ThetaCloud,
    all_values,
    m_algorithm,
    printed_groups,
    rbpf,
    rbpf_optimal,
)
from trainid_lab.brake_rate.theta_posterior import GRID, PRINTED_FIRST

Array = NDArray[np.float64]
Rng = np.random.Generator

STEPS: Final = 150
MODEL: Final = pade_model(1.0, 0.4, 1.6667)
H: Final = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
DISTURBANCE: Final = 0.05
STD_D, STD_V = 0.610, 0.373
_COMMAND: Final = -1.0
_X0: Final = np.array([0.0, 20.0, -1.0])
_A_Z0: Final = -2.0
_P0: Final = 1e-3
_SIGMA_95: Final = 1.959964
# Standard deviation of the random walk of f per step in the filters that have one.
WALK: Final = 0.03
_RAMP: Final = 0.005


@dataclass(frozen=True, slots=True)
class PaperRun:
    """Steps of the model and measurements, shape (K, 2), with the true f, shape (K,), and x, shape (K, 3)."""

    steps: tuple[LinearStep, ...]
    R: Array
    y: Array
    f: Array
    x: Array


@dataclass(frozen=True, slots=True)
class Estimates:
    """Means and standard deviations of f, shape (K,), and means of x, shape (K, 3); total CPU time [s]."""

    f: Array
    std: Array
    x: Array
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Errors:
    """Mean absolute errors of f, D, v and a, shares of f within 1 and 1.96 standard deviations, CPU time [s]."""

    f: float
    D: float
    v: float
    a: float
    inside_68: float
    inside_95: float
    cpu_s: float


def ramp() -> Array:
    """Return f_k = 1 - 0.005 k, eq. (23), shape (K,)."""
    f: Array = 1.0 - _RAMP * np.arange(1.0, STEPS + 1.0)
    return f


def paper_run(seed: int, f: Array | None = None, noise: float = 1.0) -> PaperRun:
    """Return the paper's data, or those for another path of f; all noises are scaled by ``noise``."""
    rng = np.random.default_rng([seed, 27])
    f = ramp() if f is None else f
    R = np.diag(np.square([noise * STD_D, noise * STD_V]))
    x, a_z, steps, states = _X0, _A_Z0, [], []
    for rate in f:
        step = MODEL.step(a_z, _COMMAND, noise * noise * DISTURBANCE)
        d = noise * math.sqrt(DISTURBANCE) * float(rng.standard_normal())
        x = step.Phi @ x + rate * step.gamma + step.known + d * MODEL.E[:3]
        a_z = MODEL.next_a_z(a_z, _COMMAND)
        steps.append(step)
        states.append(x)
    truth = np.array(states)
    y = truth[:, :2] + rng.standard_normal((len(f), 2)) @ np.sqrt(R)
    return PaperRun(tuple(steps), R, y, f, truth)


def walking_run(seed: int, drift: float) -> PaperRun:
    """Return data with f(0) ~ N(0.6, 0.2^2) and a random walk, the model of the linear filters."""
    rng = np.random.default_rng([seed, 31])
    return paper_run(seed, 0.6 + 0.2 * rng.standard_normal() + drift * np.cumsum(rng.standard_normal(STEPS)))


def errors(run: PaperRun, got: Estimates) -> Errors:
    """Score a filter against the truth of a run."""
    e = np.abs(got.f - run.f)
    z = e / np.maximum(got.std, 1e-12)
    D, v, a = np.abs(got.x - run.x).mean(axis=0)
    return Errors(float(e.mean()), D, v, a, float((z <= 1.0).mean()), float((z <= _SIGMA_95).mean()), got.cpu_s)


# One step of particles: cloud, step, correction, measurement, generator -> particles to estimate from, particles kept.
Learn = Callable[[ThetaCloud, LinearStep, Correction, Array, Rng], tuple[ThetaCloud, ThetaCloud]]


def particles(run: PaperRun, seed: int, count: int, learn: Learn) -> Estimates:
    """Run particles that start on the printed grid, with initial states drawn as printed."""
    rng = np.random.default_rng([seed, 250])
    f = rng.choice(GRID, count)
    x0 = _X0[:, None] + math.sqrt(_P0) * rng.standard_normal((3, count))
    cloud = ThetaCloud(f, np.full(count, -math.log(count)), x0)
    P = _P0 * np.eye(3)
    rows = []
    begin = time.thread_time()
    for step, y in zip(run.steps, run.y, strict=True):
        cloud = ThetaCloud(cloud.f, cloud.log_weights, step.predict(cloud.x, cloud.f))
        fix = correction(step.predict_covariance(P), H, run.R)
        everything, cloud = learn(cloud, step, fix, y, rng)
        P = fix.P
        w = everything.weights
        mean = float(w @ everything.f)
        rows.append((mean, math.sqrt(max(0.0, float(w @ np.square(everything.f - mean)))), *(everything.x @ w)))
    table = np.array(rows)
    return Estimates(table[:, 0], table[:, 1], table[:, 2:], time.thread_time() - begin)


def rbpf_static(run: PaperRun, seed: int) -> Estimates:
    """Run the RBPF with 250 static values."""

    def learn(c: ThetaCloud, s: LinearStep, k: Correction, y: Array, rng: Rng) -> tuple[ThetaCloud, ThetaCloud]:
        after = rbpf(c, s, k, H, y, np.zeros(len(c.f)), float(rng.random()))
        return after, after

    return particles(run, seed, 250, learn)


def rbpf_walking(run: PaperRun, seed: int, walk: float = WALK, count: int = 500) -> Estimates:
    """Run the RBPF with drifting values."""

    def learn(c: ThetaCloud, s: LinearStep, k: Correction, y: Array, rng: Rng) -> tuple[ThetaCloud, ThetaCloud]:
        after = rbpf(c, s, k, H, y, walk * rng.standard_normal(len(c.f)), float(rng.random()))
        return after, after

    return particles(run, seed, count, learn)


def rbpf_drawing(run: PaperRun, seed: int, *, likeliest: bool = False) -> Estimates:
    """Run the RBPF with the optimal proposal (9)-(13), or with the most likely value as in section 3.4."""

    def learn(c: ThetaCloud, s: LinearStep, k: Correction, y: Array, rng: Rng) -> tuple[ThetaCloud, ThetaCloud]:
        after = rbpf_optimal(c, GRID, s, k, H, y, None if likeliest else rng.random(len(c.f)))
        return after, after

    return particles(run, seed, 250, learn)


def sma(run: PaperRun, seed: int, *, stochastic: bool = False) -> Estimates:
    """Run SMA as printed, or with carried weights and stochastic pruning."""
    rule = MRule(50, 500, carries=stochastic, stochastic=stochastic)

    def learn(c: ThetaCloud, s: LinearStep, k: Correction, y: Array, rng: Rng) -> tuple[ThetaCloud, ThetaCloud]:
        return m_algorithm(c, all_values(GRID, c.f), s, k, H, y, rule, float(rng.random()))

    return particles(run, seed, 50, learn)


def gsma(
    run: PaperRun, seed: int, *, stochastic: bool = False, first: int = PRINTED_FIRST, most: int = 500
) -> Estimates:
    """Run GSMA on the printed grid: as printed, or with carried weights, stochastic pruning and all groups."""
    rule = MRule(50, most, carries=stochastic, stochastic=stochastic)

    def learn(c: ThetaCloud, s: LinearStep, k: Correction, y: Array, rng: Rng) -> tuple[ThetaCloud, ThetaCloud]:
        return m_algorithm(c, printed_groups(GRID, c.f, first), s, k, H, y, rule, float(rng.random()))

    return particles(run, seed, 50, learn)


def gsma_free(run: PaperRun, seed: int, walk: float = WALK, count: int = 100) -> Estimates:
    """Run GSMA without a grid, as in the node but without jumps; f(0) ~ N(0.6, 0.2^2)."""
    rng = np.random.default_rng([seed, 251])
    f = 0.6 + 0.2 * rng.standard_normal(count)
    cloud = LinearGroupCloud(f, np.repeat(_X0[:, None], count, axis=1), float(f.mean()), float(f.var()), np.zeros(3))
    P, rows = _P0 * np.eye(3), []
    begin = time.thread_time()
    for step, y in zip(run.steps, run.y, strict=True):
        fix = correction(step.predict_covariance(P), H, run.R)
        cloud = cloud.predicted(step).learned(step, fix, H, y, walk * walk, 3.0, float(rng.random()))
        P = fix.P
        rows.append((cloud.mean, math.sqrt(cloud.variance), *cloud.x.mean(axis=1)))
    table = np.array(rows)
    return Estimates(table[:, 0], table[:, 1], table[:, 2:], time.thread_time() - begin)


def kalman(run: PaperRun, walk: float, trend: float = 0.0, slope: tuple[float, float] = (0.0, 0.0)) -> Estimates:
    """Run the linear Kalman filter on [D, v, a, f, df], the exact posterior for Gaussian dynamics of f.

    Args:
        run: The data.
        walk: Standard deviation of the random walk of f per step.
        trend: Standard deviation of the random walk of its slope per step.
        slope: Prior mean and standard deviation of the slope per step; both 0 = no trend.

    """
    m = np.array([*_X0, 0.6, slope[0]])
    P = np.diag([_P0, _P0, _P0, 0.2**2, slope[1] ** 2])
    Hx = np.hstack([H, np.zeros((2, 2))])
    rows = []
    begin = time.thread_time()
    for step, y in zip(run.steps, run.y, strict=True):
        # f changes before it acts.
        move = np.eye(5)
        move[3, 4] = 1.0
        act = np.eye(5)
        act[:3, :3], act[:3, 3] = step.Phi, step.gamma
        Q = np.zeros((5, 5))
        Q[:3, :3] = step.Q
        P = act @ (move @ P @ move.T + np.diag([0.0, 0.0, 0.0, walk**2, trend**2])) @ act.T + Q
        m = act @ move @ m
        m[:3] += step.known
        fix = correction(P, Hx, run.R)
        m = m + fix.K @ (y - Hx @ m)
        P = fix.P
        rows.append((m[3], math.sqrt(P[3, 3]), *m[:3]))
    table = np.array(rows)
    return Estimates(table[:, 0], table[:, 1], table[:, 2:], time.thread_time() - begin)


def known_rate(run: PaperRun) -> Estimates:
    """Run the Kalman filter with the true f: the lower bound of the errors of D, v and a."""
    m, P, rows = _X0, _P0 * np.eye(3), []
    begin = time.thread_time()
    for step, y, f in zip(run.steps, run.y, run.f, strict=True):
        m = step.Phi @ m + f * step.gamma + step.known
        fix = correction(step.predict_covariance(P), H, run.R)
        m, P = m + fix.K @ (y - H @ m), fix.P
        rows.append(m)
    return Estimates(run.f, np.zeros(len(run.f)), np.array(rows), time.thread_time() - begin)
