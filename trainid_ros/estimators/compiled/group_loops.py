# SPDX-License-Identifier: Apache-2.0
"""One step of GSMA as loops over particles, to be compiled: the mathematics of :mod:`group_cloud`, in its order.

Sums over particles run one after the other, NumPy's run in pairs; apart from the rounding of sums all numbers are
those of :mod:`group_cloud`. Values stay in order within a stratum, so children are merged instead of sorted.
Arrays as in :class:`GroupCloud`; the particles of stratum m are those from ``edges[m]`` to ``edges[m + 1]``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.estimators.brake_rate.group_cloud import KAPPA, LEAST_VARIANCE, MOST_SPREAD, SHRUNK, TINY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.estimators.brake_rate.belief import Interval

    Floats = NDArray[np.float64]
    Places = NDArray[np.intp]
    Learned = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats, Floats, tuple[float, float, float]]

_LOG_EDGE: Final = math.log(1.0 / 6.0)
_LOG_MIDDLE: Final = math.log(4.0 / 6.0)


def predict(x: Floats, f: Floats, slope: Floats, P: Floats, interval: Interval) -> tuple[Floats, Floats, Floats]:
    """Return x = [v, a, b], slope and P after an interval, (14), see :func:`particles.speed_step`."""
    dt, reach, decay, gain_v, gain_a, rho, known, q_v, q_b = interval
    after, lean = np.empty_like(x), np.empty_like(slope)
    for k in range(f.size):
        v, a, b = x[0, k], x[1, k], x[2, k]
        after[0, k] = v + reach * a + dt * b + gain_v * f[k] + known
        after[1, k] = decay * a + gain_a * f[k]
        after[2, k] = rho * b
    for m in range(slope.shape[1]):
        v, a, b = slope[0, m], slope[1, m], slope[2, m]
        lean[0, m] = v + reach * a + dt * b + gain_v
        lean[1, m] = decay * a + gain_a
        lean[2, m] = rho * b
    # Row v of Phi P, then Phi P Phi'.
    ahead = np.empty_like(P)
    uv = P[0, 0] + reach * P[1, 0] + dt * P[2, 0]
    ua = P[0, 1] + reach * P[1, 1] + dt * P[2, 1]
    ub = P[0, 2] + reach * P[1, 2] + dt * P[2, 2]
    ahead[0, 0] = uv + reach * ua + dt * ub + q_v
    ahead[0, 1] = ahead[1, 0] = decay * ua
    ahead[0, 2] = ahead[2, 0] = rho * ub
    ahead[1, 1] = decay * decay * P[1, 1]
    ahead[1, 2] = ahead[2, 1] = decay * rho * P[1, 2]
    ahead[2, 2] = rho * rho * P[2, 2] + q_b
    return after, lean, ahead


def correct(P: Floats, r: float) -> tuple[Floats, Floats, float]:
    """Return gain (20), covariance (21) and whitening of a measurement of x[0], see :func:`particles.correction`."""
    n, S = P.shape[0], P[0, 0] + r
    K, after = np.empty(n), np.empty_like(P)
    for i in range(n):
        K[i] = P[i, 0] / S
        for j in range(n):
            after[i, j] = P[i, j] - P[i, 0] * (P[j, 0] / S)
    return K, after, 1.0 / math.sqrt(S)


def learn(
    f: Floats,
    x: Floats,
    weight: Floats,
    mean: Floats,
    variance: Floats,
    slope: Floats,
    edges: Places,
    interval: Interval,
    q: Floats,
    P: Floats,
    speed: float,
    r: float,
    largest: float,
    chain: Floats,
    uniforms: Floats,
) -> Learned:
    """Branch, weigh and prune, see :mod:`group_cloud`; q is the variance that f gains in 1 s, shape (M,).

    Returns:
        f, x, weight, mean, variance and slope of the cloud, P, the weight of each particle; then mean and variance of
        f, which is not finite if anything is not, and the effective number of children.

    """
    K, after, W = correct(P, r)
    gamma, walk = np.zeros(x.shape[0]), q * interval.dt
    gamma[0], gamma[1] = interval.gain_v, interval.gain_a
    base, middle, h, c = branch(f, x, mean, variance, slope, edges, gamma, walk)
    w = weigh(base, middle, h, c, weight, edges, K, W, speed, largest)
    effective = 0.0
    for g in range(3):
        for i in range(base.size):
            effective += w[g, i] * w[g, i]
    weight, mean, variance, centre, slope = moments(base, middle, h, c, w, edges, chain)
    child, parent = prune(base, h, w, edges, chain, weight, uniforms)
    f, x = survivors(base, middle, h, c, child, parent, edges, mean, variance, centre, slope)
    weight = weight / weight.sum()
    each = np.empty_like(f)
    for m in range(weight.size):
        each[edges[m] : edges[m + 1]] = weight[m] / (edges[m + 1] - edges[m])
    rate = 0.0
    for m in range(weight.size):
        rate += weight[m] * mean[m]
    # Adds nothing, unless something is not finite.
    spread = 0.0 * (f.sum() + x.sum() + after.sum())
    for m in range(weight.size):
        spread += weight[m] * (variance[m] + (mean[m] - rate) * (mean[m] - rate))
    return f, x, weight, mean, variance, slope, after, each, (rate, spread, 1.0 / effective)


def branch(
    f: Floats, x: Floats, mean: Floats, variance: Floats, slope: Floats, edges: Places, gamma: Floats, walk: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return shrunk rates, their states, and step and slope within the groups of each stratum."""
    n, M = slope.shape
    base, middle, h, c = np.empty_like(f), np.empty_like(x), np.empty(M), np.empty_like(slope)
    for m in range(M):
        kernel = KAPPA * KAPPA * variance[m]
        both = max(walk[m] + kernel, TINY)
        h[m] = math.sqrt(3.0 * both)
        for j in range(n):
            c[j, m] = gamma[j] + kernel / both * (slope[j, m] - gamma[j])
        for i in range(edges[m], edges[m + 1]):
            moved = SHRUNK * (f[i] - mean[m])
            base[i] = f[i] + moved
            for j in range(n):
                middle[j, i] = x[j, i] + slope[j, m] * moved
    return base, middle, h, c


def weigh(
    base: Floats,
    middle: Floats,
    h: Floats,
    c: Floats,
    weight: Floats,
    edges: Places,
    K: Floats,
    W: float,
    speed: float,
    largest: float,
) -> Floats:
    """Return the weights of the children (17), (18), shape (3, N); take the measurement into their states (21)."""
    n, N = middle.shape
    w = np.empty((3, N))
    peak = -math.inf
    for m in range(h.size):
        lean = c[0, m]
        prior = math.log(max(weight[m], TINY) / (edges[m + 1] - edges[m]))
        for i in range(edges[m], edges[m + 1]):
            nu = speed - middle[0, i]
            for g in range(3):
                off = (g - 1) * h[m]
                value, z = base[i] + off, W * (nu - off * lean)
                fits = 0.0 <= value <= largest
                log_prior = (_LOG_MIDDLE if g == 1 else _LOG_EDGE) + prior
                w[g, i] = log_prior - 0.5 * (z * z) if fits else -math.inf
                peak = max(peak, w[g, i])
            for j in range(n):
                middle[j, i] += K[j] * nu
        for j in range(n):
            c[j, m] -= K[j] * lean
    total = 0.0
    for g in range(3):
        for i in range(N):
            w[g, i] = math.exp(w[g, i] - peak) if peak > -math.inf else 1.0
            total += w[g, i]
    for g in range(3):
        for i in range(N):
            w[g, i] /= total
    return w


def moments(
    base: Floats, middle: Floats, h: Floats, c: Floats, w: Floats, edges: Places, chain: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return weight, mean, variance, mean of x and regression of all children as each stratum will see them."""
    n, M = c.shape
    centre = 0.0
    for i in range(base.size):
        centre += (w[0, i] + w[1, i] + w[2, i]) * base[i]
    # Sums over the children of each stratum: of 1, f, f^2, and for each part of x of x and x f.
    s, w0, w1 = np.empty((3 + 2 * n, M)), np.empty(base.size), np.empty(base.size)
    first, lean = np.empty(base.size), np.empty(base.size)
    for m in range(M):
        ones, values, squares = 0.0, 0.0, 0.0
        for i in range(edges[m], edges[m + 1]):
            b, w0[i], w1[i] = base[i] - centre, w[0, i] + w[1, i] + w[2, i], (w[2, i] - w[0, i]) * h[m]
            first[i], lean[i] = b * w0[i] + w1[i], b * w1[i] + (w[0, i] + w[2, i]) * h[m] * h[m]
            ones += w0[i]
            values += first[i]
            squares += b * first[i] + lean[i]
        s[0, m], s[1, m], s[2, m] = ones, values, squares
        for j in range(n):
            states, products = 0.0, 0.0
            for i in range(edges[m], edges[m + 1]):
                states += middle[j, i] * w0[i] + c[j, m] * w1[i]
                products += middle[j, i] * first[i] + c[j, m] * lean[i]
            s[3 + j, m], s[3 + n + j, m] = states, products
    weight, mean, variance = np.empty(M), np.empty(M), np.empty(M)
    x, slope, t = np.empty((n, M)), np.empty((n, M)), np.empty(3 + 2 * n)
    for m in range(M):
        for k in range(t.size):
            t[k] = 0.0
            for source in range(M):
                t[k] += s[k, source] * chain[source, m]
        weight[m] = max(t[0], TINY)
        mean[m] = t[1] / weight[m]
        variance[m] = max(t[2] / weight[m] - mean[m] * mean[m], LEAST_VARIANCE)
        for j in range(n):
            x[j, m] = t[3 + j] / weight[m]
            slope[j, m] = (t[3 + n + j] / weight[m] - x[j, m] * mean[m]) / variance[m]
        mean[m] += centre
    return weight, mean, variance, x, slope


def merged(base: Floats, h: Floats, edges: Places) -> tuple[Places, Places]:
    """Return the children in the order of f: their place in the group (0, 1, 2) and their particle, shape (3 N,)."""
    N, M = base.size, h.size
    perm = np.arange(N)
    for m in range(M):
        # In order but for roundings: as a rule nothing moves.
        for i in range(edges[m] + 1, edges[m + 1]):
            k, one = i, perm[i]
            while k > edges[m] and base[perm[k - 1]] > base[one]:
                perm[k] = perm[k - 1]
                k -= 1
            perm[k] = one
    # One queue for each place in the groups of each stratum.
    child, parent = np.empty(3 * N, dtype=np.intp), np.empty(3 * N, dtype=np.intp)
    at, end, place = np.empty(3 * M, dtype=np.intp), np.empty(3 * M, dtype=np.intp), np.empty(3 * M, dtype=np.intp)
    head, off = np.empty(3 * M), np.empty(3 * M)
    for q in range(3 * M):
        place[q], m = q // M, q % M
        at[q], end[q] = edges[m], edges[m + 1]
        off[q] = (place[q] - 1) * h[m]
        head[q] = base[perm[at[q]]] + off[q]
    for k in range(3 * N):
        best, least = 0, head[0]
        for q in range(1, 3 * M):
            if head[q] < least:
                best, least = q, head[q]
        child[k], parent[k] = place[best], perm[at[best]]
        at[best] += 1
        head[best] = base[perm[at[best]]] + off[best] if at[best] < end[best] else math.inf
    return child, parent


def prune(
    base: Floats, h: Floats, w: Floats, edges: Places, chain: Floats, weight: Floats, uniforms: Floats
) -> tuple[Places, Places]:
    """Return which children each stratum keeps by systematic resampling, as :func:`merged`, shape (N,)."""
    N, M = base.size, h.size
    child, parent = merged(base, h, edges)
    kept_child, kept_parent = np.empty(N, dtype=np.intp), np.empty(N, dtype=np.intp)
    toward, seen = np.empty(N), np.empty(3 * N)
    for m in range(M):
        for source in range(M):
            toward[edges[source] : edges[source + 1]] = chain[source, m] / weight[m]
        for k in range(3 * N):
            seen[k] = w[child[k], parent[k]] * toward[parent[k]]
        size = edges[m + 1] - edges[m]
        at, total = 0, seen[0]
        for k in range(size):
            position = (k + uniforms[m]) / size
            while total <= position and at < 3 * N - 1:
                at += 1
                total += seen[at]
            kept_child[edges[m] + k], kept_parent[edges[m] + k] = child[at], parent[at]
    return kept_child, kept_parent


def survivors(
    base: Floats,
    middle: Floats,
    h: Floats,
    c: Floats,
    child: Places,
    parents: Places,
    edges: Places,
    mean: Floats,
    variance: Floats,
    centre: Floats,
    slope: Floats,
) -> tuple[Floats, Floats]:
    """Return f and x of the children kept, moved to the moments of those that they stand for."""
    n, N = middle.shape
    M = h.size
    f, x = np.empty(N), np.empty((n, N))
    for m in range(M):
        size, average = edges[m + 1] - edges[m], 0.0
        for i in range(edges[m], edges[m + 1]):
            parent, stratum = parents[i], 0
            while edges[stratum + 1] <= parent:
                stratum += 1
            off = (child[i] - 1) * h[stratum]
            f[i] = base[parent] + off
            average += f[i]
            for j in range(n):
                x[j, i] = middle[j, parent] + off * c[j, stratum]
        average /= size
        spread = 0.0
        for i in range(edges[m], edges[m + 1]):
            spread += (f[i] - average) * (f[i] - average)
        factor = min(math.sqrt(variance[m] / max(spread / size, TINY)), MOST_SPREAD)
        for j in range(n):
            total = 0.0
            for i in range(edges[m], edges[m + 1]):
                x[j, i] += slope[j, m] * (mean[m] + factor * (f[i] - average) - f[i])
                total += x[j, i]
            for i in range(edges[m], edges[m + 1]):
                x[j, i] += centre[j, m] - total / size
        for i in range(edges[m], edges[m + 1]):
            f[i] = mean[m] + factor * (f[i] - average)
    return f, x
