# SPDX-License-Identifier: Apache-2.0
"""Banks of hypotheses of equal or given weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from test.resistance.bank_rows import covariance
from trainid_ros.resistance.hypotheses import KAPPA, STATES, A, B, Bank, BankPlan, C, Interval, ProcessNoise

Array = NDArray[np.float64]
INERTIA, DT, SPEED_STD = 110.0, 0.2, 0.02
NOISE = ProcessNoise(INERTIA, gust_time=6.0, map_length=250.0, force_density=0.02, skew=0.0, outliers=0.001)
# v, a, b, c, gust, map error, kappa, delta, kappa_R
MEAN = np.array([0.0, 1.5, 0.03, 0.004, 0.0, 0.0, 0.0, 0.0, 0.0])
STD = np.array([0.0, 0.5, 0.02, 0.001, 0.0, 0.0, 0.03, 0.0, 0.0])
PLAN = BankPlan(
    mean=MEAN,
    variance=STD**2,
    gust_stds=(0.1, 0.2, 0.4),
    map_stds=(0.05, 0.25),
    step_variances=(0.25, 1e-6),
    hazard=1.0 / 3600.0,
    branch_interval=10.0,
    hypotheses=20,
    min_age=10.0,
    young_weight=20.0,
    wrong_prior=0.0,
    drift=np.zeros(STATES),
    noise=NOISE,
)
ONE = replace(PLAN, gust_stds=(0.1,), map_stds=(0.05,), branch_interval=1e9)


def still(speed: float, dt: float = DT) -> Interval:
    """Traction that holds the speed if the prior mean is correct."""
    w = MEAN[A] + speed * (MEAN[B] + speed * MEAN[C])
    return Interval(dt, (w, w, w, w), 0.0, 0.0, speed, SPEED_STD**2, dt, dt)


def held(plan: BankPlan = PLAN, speed: float = 12.0) -> Bank:
    bank = Bank(plan)
    bank.restart(speed, SPEED_STD**2)
    return bank


@dataclass
class Mixed:
    """Mean, and covariances as stated and without the weight of young hypotheses, of the published states."""

    mean: Array
    covariance: Array
    posterior: Array


def mixed(bank: Bank) -> Mixed:
    """Return the mixture as arrays."""
    now = bank.mixture()
    stated, posterior = np.zeros((5, 5)), np.zeros((5, 5))
    upper = np.triu_indices(5)
    stated[upper], posterior[upper] = list(bank.mixture(bank.plan.young_weight).covariance), list(now.covariance)
    return Mixed(np.array(list(now.mean)), stated + np.triu(stated, 1).T, posterior + np.triu(posterior, 1).T)


def drive(davis: Callable[[float], Array], seconds: float, seed: int, plan: BankPlan = ONE) -> list[Interval]:
    """A train with power switched by speed, disturbed by the plan's first gust and map error sizes and white force.

    davis returns a, b, c, kappa at a time [s].
    """
    rng = np.random.default_rng(seed)
    gust_std, map_std = plan.gust_stds[0], plan.map_stds[0]
    v, gust, error, pulls, level = 12.0, rng.normal(0.0, gust_std), rng.normal(0.0, map_std), True, 30.0
    tractions, speeds = [0.0], [v]
    for i in range(round(seconds / DT)):
        pulls = v < 16.0 if pulls else v < 9.0
        level = rng.uniform(15.0, 45.0) if not pulls else level
        T = level if pulls else -6.0
        a, b, c, kappa = davis(i * DT)
        white = rng.normal(0.0, math.sqrt(NOISE.force_density / DT))
        v += DT / INERTIA * ((1.0 + kappa) * T + white - a - b * v - c * v * v - gust - error)
        rho_g, rho_e = math.exp(-DT / NOISE.gust_time), math.exp(-v * DT / NOISE.map_length)
        gust = rho_g * gust + gust_std * math.sqrt(1.0 - rho_g**2) * rng.standard_normal()
        error = rho_e * error + map_std * math.sqrt(1.0 - rho_e**2) * rng.standard_normal()
        tractions.append(T)
        speeds.append(v)
    measured = np.array(speeds) + rng.normal(0.0, SPEED_STD, len(speeds))
    tractions += [tractions[-1]] * 2
    first = Interval(DT, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0, float(measured[0]), SPEED_STD**2, DT, DT)
    return [first] + [
        Interval(
            DT,
            (tractions[i - 1], tractions[i], tractions[i + 1], tractions[i + 2]),
            0.0,
            0.0,
            float(measured[i]),
            SPEED_STD**2,
            DT,
            DT,
        )
        for i in range(1, len(speeds))
    ]


def branched(bank: Bank) -> Bank:
    """Advance until the bank has branched once more."""
    count = bank.branchings
    while bank.branchings == count:
        bank.advance(still(12.0))
    return bank


def errors_squared(seeds: range, seconds: float) -> tuple[float, float]:
    """Return mean NEES of a, b, c, kappa and mean NIS of one filter over drives with parameters from the prior."""
    states = [A, B, C, KAPPA]
    nees, nis = [], []
    for seed in seeds:
        truth = MEAN[states] + STD[states] * np.random.default_rng((seed, 1)).standard_normal(4)
        bank = Bank(ONE)
        intervals = drive(lambda _, truth=truth: truth, seconds, seed)  # type: ignore[misc]
        bank.restart(intervals[0].speed, intervals[0].speed_variance)
        for interval in intervals[1:]:
            innovation = bank.advance(interval)
            nis.append(innovation.value**2 / innovation.variance)
        only = bank.hypotheses[0].filter
        error = np.array(list(only.x))[states] - truth
        nees.append(error @ np.linalg.solve(covariance(only)[np.ix_(states, states)], error) / 4.0)
    return float(np.mean(nees)), float(np.mean(nis))
