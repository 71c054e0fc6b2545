# SPDX-License-Identifier: Apache-2.0
"""Kalman filter kernels for z = [x, f], x = [v, a, b, e]: the model is linear, so no particles are needed.

f enters speed v and brake acceleration a with known coefficients (Zheng et al. 2015, eqs. (1), (2): f multiplies
the command after its dead time), so the Kalman filter is the exact posterior of a Gaussian random walk of f.
Means have the shape (n + 1,), covariances (n + 1, n + 1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from trainid_lab.brake_rate.particles import error_covariance, speed_step, started
from trainid_ros.brake_rate.motion_model import ERRORS, STATES, Errors, Start, Transition

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_lab.brake_rate.particles import Array


def prior(rate: float, std: float, error_stds: Errors) -> tuple[Array, Array]:
    """Return the prior mean and covariance; ``rate`` and ``std`` of f [1], errors as in :class:`Transition`."""
    m, P = np.zeros(STATES + 1), np.zeros((STATES + 1, STATES + 1))
    P[:STATES, :STATES] = error_covariance(error_stds)
    m[STATES], P[STATES, STATES] = rate, std * std
    return m, P


def predict(m: Array, P: Array, interval: Transition) -> tuple[Array, Array]:
    """Predict x = F x + known input, P = F P F' + Q; f is constant."""
    step = speed_step(interval)
    F = np.eye(STATES + 1)
    F[:STATES, :STATES], F[:STATES, STATES] = step.Phi, step.gamma
    mean = F.dot(m)
    mean[:STATES] += step.known
    cov = F.dot(P).dot(F.T)
    cov[:STATES, :STATES] += step.Q
    return mean, cov


def drift(P: Array, gain_v: float, gain_a: float, q: float) -> Array:
    """Add the drift of f over an interval, of variance q [1]; it acted on v and a from the start of the interval."""
    along = np.zeros(STATES + 1)
    along[0], along[1], along[STATES] = gain_v, gain_a, 1.0
    after: Array = P + np.outer(q * along, along)
    return after


def update(m: Array, P: Array, speed: float, r: float, *, learns: bool) -> tuple[Array, Array]:
    """Update with a measured speed [m/s] of variance r [(m/s)^2], K = P h / S.

    With ``learns`` False the gain of f is zero and f is unchanged (Schmidt-Kalman filter).
    """
    column = P[0].copy()
    S = float(column[0]) + r
    kept = P[STATES, STATES]
    cov = P - np.outer(column, column / S)
    if not learns:
        cov[STATES, STATES] = kept
        column[STATES] = 0.0
    return m + column * ((speed - float(m[0])) / S), cov


def anchored(m: Array, P: Array, start: Start) -> tuple[Array, Array]:
    """Restart v, a = f target and b; f is unchanged, and the errors e decay by ``decay_e`` and gain ``q_e``."""
    f, ff, decay_e = float(m[STATES]), float(P[STATES, STATES]), np.array(list(start.decay_e))
    mean, cov = np.concatenate([[start.speed, f * start.target, 0.0], decay_e * m[3:STATES], [f]]), np.zeros_like(P)
    cov[:STATES, :STATES] = started(P[:STATES, :STATES], start)
    with_f = np.concatenate([[0.0, ff * start.target, 0.0], decay_e * P[3:STATES, STATES]])
    cov[:STATES, STATES] = cov[STATES, :STATES] = with_f
    # a = f target is correlated with the errors through f.
    cov[1, 3:STATES] = cov[3:STATES, 1] = start.target * with_f[3:]
    cov[1, 1] += ff * start.target**2
    cov[STATES, STATES] = ff
    return mean, cov


def recentred(m: Array, P: Array, shift: Errors) -> tuple[Array, Array]:
    """Return the moments with the errors relative to a new origin, ``shift`` away from the old."""
    after = m.copy()
    after[3 : 3 + ERRORS] -= shift
    return after, P


def mixed(weights: tuple[float, ...], means: Sequence[Array], covs: Sequence[Array]) -> tuple[Array, Array]:
    """Return mean and covariance of a mixture; weights sum to one."""
    mean = sum((w * m for w, m in zip(weights, means, strict=True)), np.zeros_like(means[0]))
    cov = np.zeros_like(covs[0])
    for w, m, P in zip(weights, means, covs, strict=True):
        d = m - mean
        cov += w * (P + np.outer(d, d))
    return mean, cov
