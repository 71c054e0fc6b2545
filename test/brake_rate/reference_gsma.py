# SPDX-License-Identifier: Apache-2.0
"""GSMA in plain numpy, the steps [n] at the head of :mod:`trainid_ros.brake_rate.gsma`.

H = e_v'. Arrays over N particles or 3 N children have them in the last axis; ``of`` is the stratum of each particle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
KAPPA, MAX_SPREAD_FACTOR = 0.2, 2.0


class Model(NamedTuple):
    """x' = Phi x + gamma f + known + noise of covariance Q; n states."""

    Phi: Array
    gamma: Array
    known: Array
    Q: Array


class Cloud(NamedTuple):
    """Particles f (N,), x (n, N); of each stratum W, mean and variance of f (M,), regression of x on f (n, M)."""

    f: Array
    x: Array
    of: NDArray[np.intp]
    W: Array
    mean: Array
    variance: Array
    slope: Array


def predict(c: Cloud, P: Array, m: Model) -> tuple[Cloud, Array]:
    """Return particles and covariance after a step of the model."""
    x = m.Phi @ c.x + m.gamma[:, None] * c.f + m.known[:, None]  # [2] (14)
    return c._replace(x=x, slope=m.Phi @ c.slope + m.gamma[:, None]), m.Phi @ P @ m.Phi.T + m.Q  # [3] (14)


def correct(P: Array, r: float) -> tuple[float, Array, Array]:
    """Return S, K and P of a measured speed of variance r."""
    S = float(P[0, 0]) + r  # [4] (16)
    K = P[:, 0] / S  # [5] (20)
    return S, K, P - np.outer(K, P[0])  # [6] (21)


def follow(c: Cloud, y: float, K: Array) -> Cloud:
    """Return the particles after a speed that does not update f."""
    x = c.x + np.outer(K, y - c.x[0])  # [7] (21)
    return c._replace(x=x, slope=c.slope - np.outer(K, c.slope[0]))


def update(c: Cloud, m: Model, y: float, S: float, K: Array, q: Array, T: Array, f_max: float, draws: Array) -> Cloud:
    """Return the particles after one step of the M-algorithm; q = variance of the walk, T = Markov chain."""
    kernel, of = KAPPA**2 * c.variance, np.tile(c.of, 3)
    moved = (np.sqrt(1.0 - KAPPA**2) - 1.0) * (c.f - c.mean[c.of])  # [9]
    h = np.outer([-1.0, 0.0, 1.0], np.sqrt(3.0 * (q + kernel))[c.of]).ravel()  # [10]
    along = m.gamma[:, None] + kernel / (q + kernel) * (c.slope - m.gamma[:, None])
    f, x = np.tile(c.f + moved, 3) + h, np.tile(c.x + c.slope[:, c.of] * moved, 3) + along[:, of] * h
    nu = y - x[0]
    log_w = np.repeat(np.log([1.0, 4.0, 1.0]), len(c.f)) + np.log(c.W / np.bincount(c.of))[of] - 0.5 * nu**2 / S  # [11]
    log_w[(f < 0.0) | (f > f_max)] = -np.inf
    w = np.exp(log_w - log_w.max())
    w, x = w / w.sum(), x + np.outer(K, nu)  # [12] (18), [16] (21)
    after, order = [a.copy() for a in c], np.argsort(f, kind='stable')
    for k in range(len(c.W)):
        share, kept = w * T[of, k], np.flatnonzero(c.of == k)
        after[3][k] = share.sum()  # [13]
        share /= share.sum()
        mean, middle = f @ share, x @ share
        variance = (f - mean) ** 2 @ share
        slope = (x - middle[:, None]) @ (share * (f - mean)) / variance
        place = np.searchsorted(np.cumsum(share[order]), (np.arange(len(kept)) + draws[k]) / len(kept), side='right')
        chosen = order[place]  # [14]
        factor = min(np.sqrt(variance / np.var(f[chosen])), MAX_SPREAD_FACTOR)
        matched = mean + factor * (f[chosen] - f[chosen].mean())  # [15]
        states = x[:, chosen] + slope[:, None] * (matched - f[chosen])  # [17]
        after[0][kept], after[1][:, kept] = matched, states + (middle - states.mean(axis=1))[:, None]
        after[4][k], after[5][k], after[6][:, k] = mean, variance, slope
    return Cloud(*after)  # type: ignore[arg-type]
