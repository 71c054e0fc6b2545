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

from trainid_ros.brake_rate.group_cloud import KAPPA, LEAST_VARIANCE, MOST_SPREAD, SHRUNK, TINY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.brake_rate.posterior import Transition

    Floats = NDArray[np.float64]
    Places = NDArray[np.intp]
    Learned = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats, tuple[float, float, float]]

_LOG_EDGE: Final = math.log(1.0 / 6.0)
_LOG_MIDDLE: Final = math.log(4.0 / 6.0)


def predict(z: Floats, line: Floats, P: Floats, interval: Transition) -> tuple[Floats, Floats, Floats]:
    """Return z = [1, f, v, a, b, e], line and P after an interval, (14), see :func:`particles.speed_step`."""
    dt, reach, decay, gain_v, gain_a, rho, known, q_v, q_b, lean, keep, q_e, _calm = interval
    n = P.shape[0]
    # v gains row x; the other states are left a share of.
    row, left, ahead = np.empty(n), np.empty(n), np.empty_like(P)
    row[0], row[1], row[2], left[0], left[1], left[2] = 1.0, reach, dt, 1.0, decay, rho
    for j in range(n - 3):
        row[3 + j], left[3 + j] = lean[j], keep[j]
    after, ahead_line = np.empty_like(z), np.empty_like(line)
    for before, moved in ((z, after), (line, ahead_line)):
        for k in range(before.shape[1]):
            one, f, gained = before[0, k], before[1, k], 0.0
            for j in range(n):
                gained += row[j] * before[2 + j, k]
                moved[2 + j, k] = left[j] * before[2 + j, k]
            moved[0, k], moved[1, k] = one, f
            moved[2, k] = gained + gain_v * f + known * one
            moved[3, k] += gain_a * f
    # Row v of Phi P, then Phi P Phi'.
    speed, variance = np.empty(n), 0.0
    for j in range(n):
        speed[j] = 0.0
        for i in range(n):
            speed[j] += row[i] * P[i, j]
            ahead[i, j] = left[i] * left[j] * P[i, j]
        variance += row[j] * speed[j]
    ahead[0, 0], ahead[2, 2] = variance + q_v, ahead[2, 2] + q_b
    for j in range(1, n):
        ahead[0, j] = ahead[j, 0] = left[j] * speed[j]
        ahead[j, j] += q_e[j - 3] if j > 2 else 0.0
    return after, ahead_line, ahead


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
    z: Floats,
    weight: Floats,
    mean: Floats,
    variance: Floats,
    line: Floats,
    edges: Places,
    interval: Transition,
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
        z, weight, mean, variance and line of the cloud, P, the weight of each particle; then mean and variance of
        f, which is not finite if anything is not, and the effective number of children.

    """
    K, after, W = correct(P, r)
    gamma, walk = np.zeros(z.shape[0] - 2), q * interval.dt
    gamma[0], gamma[1] = interval.gain_v, interval.gain_a
    base, middle, h, c = branch(z[1], z[2:], mean, variance, line[2:], edges, gamma, walk)
    w = weigh(base, middle, h, c, weight, edges, K, W, speed, largest)
    effective = 0.0
    for g in range(3):
        for i in range(base.size):
            effective += w[g, i] * w[g, i]
    weight, mean, variance, centre, slope = moments(base, middle, h, c, w, edges, chain)
    kept = prune(base, h, w, edges, chain, weight, uniforms)
    z, line = np.ones_like(z), line.copy()
    survivors(z[1], z[2:], base, middle, h, c, kept, edges, mean, variance, centre, slope)
    line[2:] = slope
    weight = weight / weight.sum()
    each = np.empty_like(base)
    for m in range(weight.size):
        each[edges[m] : edges[m + 1]] = weight[m] / (edges[m + 1] - edges[m])
    rate = 0.0
    for m in range(weight.size):
        rate += weight[m] * mean[m]
    # Adds nothing, unless something is not finite.
    spread = 0.0 * (z.sum() + after.sum())
    for m in range(weight.size):
        spread += weight[m] * (variance[m] + (mean[m] - rate) * (mean[m] - rate))
    return z, weight, mean, variance, line, after, each, (rate, spread, 1.0 / effective)


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


def joined(f: Floats, places: Places, others: Floats, their: Places) -> tuple[Floats, Places]:
    """Return two ordered lists of values, and of the places that these belong to, as one."""
    n, N = f.size, f.size + others.size
    both, where = np.empty(N), np.empty(N, dtype=np.intp)
    i, j = 0, 0
    while i < n and j < others.size:
        # Which is first cannot be foreseen: counted, so that the compiler need not branch on it.
        later = others[j] < f[i]
        both[i + j] = others[j] if later else f[i]
        where[i + j] = their[j] if later else places[i]
        j += later
        i += not later
    both[i + j : n + j], where[i + j : n + j] = f[i:], places[i:]
    both[n + j :], where[n + j :] = others[j:], their[j:]
    return both, where


def merged(base: Floats, h: Floats, edges: Places) -> Places:
    """Return the children in the order of f, shape (3 N,): child g of particle i is g N + i."""
    N, f, order = base.size, np.empty(0), np.empty(0, dtype=np.intp)
    for m in range(h.size):
        middle, places = base[edges[m] : edges[m + 1]].copy(), np.arange(edges[m], edges[m + 1]) + N
        # In order but for roundings: as a rule nothing moves.
        for i in range(1, middle.size):
            k, value, place = i, middle[i], places[i]
            while k > 0 and middle[k - 1] > value:
                middle[k], places[k] = middle[k - 1], places[k - 1]
                k -= 1
            middle[k], places[k] = value, place
        sides, beside = joined(middle - h[m], places - N, middle + h[m], places + N)
        group, of = joined(middle, places, sides, beside)
        f, order = joined(f, order, group, of)
    return order


def prune(base: Floats, h: Floats, w: Floats, edges: Places, chain: Floats, weight: Floats, uniforms: Floats) -> Places:
    """Return which children each stratum keeps by systematic resampling, as :func:`merged`, shape (N,)."""
    N, M = base.size, h.size
    order = merged(base, h, edges)
    kept, toward, seen = np.empty(N, dtype=np.intp), np.empty(N), np.empty(3 * N)
    for m in range(M):
        for source in range(M):
            toward[edges[source] : edges[source + 1]] = chain[source, m] / weight[m]
        for g in range(3):
            for i in range(N):
                seen[g * N + i] = w[g, i] * toward[i]
        size = edges[m + 1] - edges[m]
        at, total = 0, seen[order[0]]
        for k in range(size):
            position = (k + uniforms[m]) / size
            while total <= position and at < 3 * N - 1:
                at += 1
                total += seen[order[at]]
            kept[edges[m] + k] = order[at]
    return kept


def survivors(
    f: Floats,
    x: Floats,
    base: Floats,
    middle: Floats,
    h: Floats,
    c: Floats,
    kept: Places,
    edges: Places,
    mean: Floats,
    variance: Floats,
    centre: Floats,
    slope: Floats,
) -> None:
    """Write f and x of the children kept, moved to the moments of those that they stand for."""
    n, N = middle.shape
    for m in range(h.size):
        size, average = edges[m + 1] - edges[m], 0.0
        for i in range(edges[m], edges[m + 1]):
            child, parent, stratum = kept[i] // N, kept[i] % N, 0
            while edges[stratum + 1] <= parent:
                stratum += 1
            off = (child - 1) * h[stratum]
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
