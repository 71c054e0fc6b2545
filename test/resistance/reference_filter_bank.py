# SPDX-License-Identifier: Apache-2.0
"""The filter bank in plain numpy, the steps [n] at the head of :mod:`trainid_ros.resistance.filter_bank`.

All hypotheses have the same sizes of gusts and map errors. x = [v, a, b, c, g, e, kappa, delta, kappa_R].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trainid_ros.resistance.davis_posterior import MAX_DELAY, MIN_DELAY
from trainid_ros.resistance.hypotheses import BankPlan, Interval

Array = NDArray[np.float64]
V, A, C, G, E, KAPPA, DELTA = 0, 1, 3, 4, 5, 6, 7
SHOWN = [1, 2, 3, KAPPA, DELTA]
YOUNG_BONUS, PRUNED, OUTLIER_RANGE = 8.0, -40.0, 2.0


@dataclass
class Hypothesis:
    """A filter with the logarithm of its weight and its age [s]."""

    x: Array
    P: Array
    log_weight: float
    age: float


def predict(h: Hypothesis, item: Interval, plan: BankPlan) -> Hypothesis:
    """Return the hypothesis at the end of an interval."""
    n, dt, (v, a, b, c, g, e, kappa, delta, kappa_R) = plan.noise, item.dt, h.x
    cubic = np.polynomial.Polynomial.fit([-1.0, 0.0, 1.0, 2.0], item.traction, 3)
    u, change = min(max(delta / item.spacing, -1.0), 2.0), item.traction[1] - item.traction[0]
    T, dT = float(cubic(u)), float(cubic.deriv()(u)) / item.spacing  # [3]
    pull = (1.0 + kappa) * T - item.track - item.curve * kappa_R - a - g - e
    middle = v + 0.5 * dt / n.inertia * (pull - b * v - c * v * v)
    decay = np.ones(9)
    decay[[G, E]] = math.exp(-dt / n.gust_time), math.exp(-item.speed * dt / n.map_length)
    x = decay * h.x
    x[V] = v + dt / n.inertia * (pull - b * middle - c * middle**2)  # [4] (1)
    F, Q = np.diag(decay), np.zeros(9)
    row = [-b - 2.0 * c * middle, -1.0, -middle, -(middle**2), -1.0, -1.0, T, (1.0 + kappa) * dT, -item.curve]
    F[V] = np.eye(9)[V] + dt / n.inertia * np.array(row)
    Q[V] = (n.force_density * dt + n.skew**2 * change**2 * dt / item.spacing) / n.inertia**2
    Q[[G, E]] = (1.0 - decay[[G, E]] ** 2) * (plan.gust_stds[0] ** 2, plan.map_stds[0] ** 2)
    return replace(h, x=x, P=F @ (h.P + np.diag(plan.drift * dt)) @ F.T + np.diag(Q))  # [5]


def correct(h: Hypothesis, y: float, R: float, eps: float, dt: float) -> Hypothesis:
    """Return the hypothesis after a speed y of variance R, with a share eps of outliers."""
    S, nu = h.P[V, V] + R, y - h.x[V]  # [7]
    good = (1.0 - eps) * math.exp(-0.5 * nu * nu / S) / math.sqrt(2.0 * math.pi * S)
    L = good + eps / OUTLIER_RANGE  # [8]
    K = h.P[:, V] / (h.P[V, V] + R / max(good / L, 1e-30))  # [9]
    x = h.x + K * nu
    x[DELTA] = np.clip(x[DELTA], MIN_DELAY, MAX_DELAY)
    return Hypothesis(x, h.P - np.outer(K, h.P[V]), h.log_weight + math.log(L), h.age + dt)  # [10]


def branch(bank: list[Hypothesis], plan: BankPlan) -> list[Hypothesis]:
    """Return the bank with two more hypotheses: a or c of the best has just stepped."""
    best = max(bank, key=lambda h: h.log_weight)
    for state, variance in zip((A, C), plan.step_variances, strict=True):  # [11]
        step = np.diag(np.eye(9)[state] * variance)
        bank = [*bank, Hypothesis(best.x, best.P + step, best.log_weight + plan.log_step, 0.0)]
    score = [math.inf if h is best else h.log_weight + YOUNG_BONUS * (h.age < plan.min_age) for h in bank]
    kept = sorted(np.argsort(-np.array(score), kind='stable')[: plan.hypotheses])  # [12]
    return [bank[k] for k in kept if bank[k].log_weight > best.log_weight + PRUNED]


def mixture(bank: list[Hypothesis], plan: BankPlan) -> tuple[Array, Array]:
    """Return mean and covariance of a, b, c, kappa, delta over the hypotheses of the minimum age."""
    W = np.array([math.exp(h.log_weight - max(i.log_weight for i in bank)) * (h.age >= plan.min_age) for h in bank])
    W, x = W / W.sum(), np.array([h.x[SHOWN] for h in bank])
    mean = W @ x  # [13]
    P = np.array([h.P[np.ix_(SHOWN, SHOWN)] + np.outer(d, d) for h, d in zip(bank, x - mean, strict=True)])
    return mean, np.tensordot(W, P, axes=1)  # [14], without more weight of young ones
