# SPDX-License-Identifier: Apache-2.0
"""One step of the group stochastic M-algorithm on any linear state, in strata of a Markov chain.

After Zheng et al. 2015, section 3.5 and eqs. (14)-(22), with these corrections:

* A particle's group is {f - h, f, f + h} around its own value with prior weights 1/6, 2/3, 1/6 and
  h = sqrt(3 q dt): every value has its group (the paper leaves one out), none is bound to a grid, and the
  transition has the variance of a random walk per second instead of a grid step per sample.
* Weights carry over: w_k = w_{k-1} p(f_k | f_{k-1}) N(y_k); pruning is systematic resampling in the order of f.
* Particles belong to strata, each with a q of its own (quiet, jumping), between which a Markov chain moves
  their weight. Each stratum keeps its number of particles however small its weight, so a hypothesis that is
  rarely true is not pruned before the measurements can tell.
* Before it branches a stratum shrinks by sqrt(1 - kappa^2) towards its mean and h grows to
  sqrt(3 (q dt + kappa^2 s^2)), which leaves its mean and variance s^2 + q dt and keeps its values apart. x moves
  along by its regression on f. Pruned particles are moved to the mean and variance of those that they stand
  for. In a stratum whose posterior is Gaussian no sampling noise is left in either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.estimators.brake_rate.particles import Array, Correction, LinearStep
from trainid_ros.estimators.brake_rate.resampling import normal_weights, systematic

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_GROUP: Final = np.array([[-1.0], [0.0], [1.0]])
# Prior weight of the child in the middle, and of the others beside it.
_LOG_MIDDLE: Final = math.log(4.0 / 6.0)
_LOG_SIDE: Final = math.log(1.0 / 4.0)
KAPPA: Final = 0.2
SHRUNK: Final = math.sqrt(1.0 - KAPPA**2) - 1.0
# Survivors are not spread by more than this to match those that they stand for.
MOST_SPREAD: Final = 2.0
TINY: Final = 1e-300
# Where one child outweighs all others, the spread of its group is still unknown.
LEAST_VARIANCE: Final = 1e-10


@dataclass(frozen=True, slots=True)
class Strata:
    """How N particles are divided among M strata.

    Attributes:
        sizes: Particles of each stratum.
        parts: Their places.
        of: Stratum of each particle, shape (N,).
        parent: Particle of each child, shape (3 N,).
        child_of: Stratum of each child, shape (3 N,).
        ranks: Where in [0, 1) the particles of each stratum are, M arrays.
        average: Averages over each stratum, shape (N, M).
        log_shares: Logarithm of a particle's share in its stratum, shape (M,).

    """

    sizes: tuple[int, ...]
    parts: tuple[slice, ...]
    of: NDArray[np.intp]
    parent: NDArray[np.intp]
    child_of: NDArray[np.intp]
    ranks: tuple[Array, ...]
    average: Array
    log_shares: Array

    @classmethod
    def divide(cls, sizes: Sequence[int]) -> Strata:
        """Return strata of these sizes, one after another."""
        of = np.repeat(np.arange(len(sizes)), sizes)
        counts = np.array(sizes, dtype=float)
        ends = np.cumsum(sizes).tolist()
        parts = tuple(slice(end - size, end) for end, size in zip(ends, sizes, strict=True))
        average = (of[:, None] == np.arange(len(sizes))) / counts
        ranks = tuple(np.arange(size) / size for size in sizes)
        parent, child_of = np.tile(np.arange(len(of)), 3), np.tile(of, 3)
        return cls(tuple(sizes), parts, of, parent, child_of, ranks, average, -np.log(counts))


class GroupCloud(NamedTuple):
    """Particles in strata; equal weights within each.

    Attributes:
        f: Brake rates, shape (N,).
        x: Means of the linear state given f, shape (n, N).
        weight: Weight of each stratum, shape (M,); they sum to one.
        mean: Mean of f in each stratum, shape (M,).
        variance: Variance of f in each stratum, shape (M,).
        slope: Regression of x on f in each stratum, shape (n, M).

    """

    f: Array
    x: Array
    weight: Array
    mean: Array
    variance: Array
    slope: Array

    @property
    def rate(self) -> float:
        """Mean of f (19)."""
        return float(self.weight @ self.mean)

    @property
    def total_variance(self) -> float:
        """Variance of f."""
        d = self.mean - self.rate
        return float(self.weight @ (self.variance + d * d))


def anchored(cloud: GroupCloud, start: Array, slope: Array) -> GroupCloud:
    """Start x anew at ``start + f slope``, both of shape (n,); f stands."""
    x = start[:, None] + slope[:, None] * cloud.f
    return _with_x(cloud, x, np.repeat(slope[:, None], len(cloud.weight), axis=1))


def predicted(cloud: GroupCloud, step: LinearStep) -> GroupCloud:
    """Follow a step while f stands."""
    slope = step.Phi @ cloud.slope + step.gamma[:, None]
    return _with_x(cloud, step.predict(cloud.x, cloud.f), slope)


def followed(cloud: GroupCloud, fix: Correction, H: Array, y: Array) -> GroupCloud:
    """Take in a measurement y, shape (m,), that tells nothing of f."""
    x = cloud.x + fix.K @ (y[:, None] - H @ cloud.x)
    return _with_x(cloud, x, cloud.slope - fix.K @ (H @ cloud.slope))


def widened(cloud: GroupCloud, step: LinearStep, variance: float) -> GroupCloud:
    """Add to the variance of f what it drifted by before the predicted step, by moving values apart."""
    total, rate = cloud.total_variance, cloud.rate
    if total <= 0.0:
        return cloud
    ratio = float(np.sqrt(1.0 + variance / total))
    moved = (ratio - 1.0) * (cloud.f - rate)
    slope = (cloud.slope + (ratio - 1.0) * step.gamma[:, None]) / ratio
    return GroupCloud(
        f=cloud.f + moved,
        x=cloud.x + step.gamma[:, None] * moved,
        weight=cloud.weight,
        mean=rate + ratio * (cloud.mean - rate),
        variance=ratio * ratio * cloud.variance,
        slope=slope,
    )


def _with_x(cloud: GroupCloud, x: Array, slope: Array) -> GroupCloud:
    return GroupCloud(cloud.f, x, cloud.weight, cloud.mean, cloud.variance, slope)


class Branches(NamedTuple):
    """The groups of all particles: child k of particle i has f = base_i + k h and x = x_i + k h c, k = -1, 0, 1.

    Attributes:
        base: Shrunk rates, shape (N,).
        h: Step within the groups of each stratum, shape (M,).
        x: States of the children in the middle, shape (n, N).
        c: Their slope within a group of each stratum, shape (n, M).
        log_prior: Logarithm of the weight of a particle in each stratum, shape (M,).
        of: Stratum of each particle, shape (N,).

    """

    base: Array
    h: Array
    x: Array
    c: Array
    log_prior: Array
    of: NDArray[np.intp]

    @property
    def f(self) -> Array:
        """Rates of the children, shape (3, N)."""
        rates: Array = self.base + _GROUP * self.h.take(self.of)
        return rates


def branch(cloud: GroupCloud, strata: Strata, step: LinearStep, walk: Array) -> Branches:
    """Return the groups of predicted particles; ``walk`` is the variance q dt of each stratum, shape (M,)."""
    of = strata.of
    kernel = KAPPA**2 * cloud.variance
    both = np.maximum(walk + kernel, TINY)
    # The kernel moves f throughout its past, so x along its regression; the walk has moved it in this step only.
    gamma = step.gamma[:, None]
    c = gamma + kernel / both * (cloud.slope - gamma)
    moved = SHRUNK * (cloud.f - cloud.mean.take(of))
    log_prior = np.log(np.maximum(cloud.weight, TINY)) + strata.log_shares
    x = cloud.x + cloud.slope.take(of, axis=1) * moved
    return Branches(cloud.f + moved, np.sqrt(3.0 * both), x, c, log_prior, of)


def weigh(groups: Branches, fix: Correction, H: Array, y: Array, largest: float) -> tuple[Branches, Array]:
    """Take in a measurement, shape (m,): children after it, and their normalised weights (17), (18), shape (3, N).

    No child beyond 0 <= f <= largest remains.
    """
    base, h, of = groups.base, groups.h, groups.of
    nu = y[:, None] - H @ groups.x
    lean = H @ groups.c
    # |W (nu - k h lean)|^2 = |z|^2 - 2 k z d + |d|^2, with d the same throughout a stratum.
    z, d = fix.W @ nu, h * (fix.W @ lean)
    log_weights = np.empty((3, len(base)))
    before, middle, after = log_weights
    np.multiply(_summed(z * z), -0.5, out=middle)
    middle += (_LOG_MIDDLE + groups.log_prior).take(of)
    side = middle + (_LOG_SIDE - 0.5 * _summed(d * d)).take(of)
    toward = _summed(z * d.take(of, axis=1))
    np.subtract(side, toward, out=before)
    np.add(side, toward, out=after)
    widest = h.max()
    if base.min() < widest or base.max() + widest > largest:
        f = groups.f
        log_weights[(f < 0.0) | (f > largest)] = -np.inf
    moved = Branches(base, h, groups.x + fix.K @ nu, groups.c - fix.K @ lean, groups.log_prior, of)  # (21)
    return moved, normal_weights(log_weights)


def _summed(squares: Array) -> Array:
    """Return the sum over measurements, as a rule one."""
    total: Array = squares[0] if len(squares) == 1 else squares.sum(axis=0)
    return total


def prune(groups: Branches, weights: Array, strata: Strata, chain: Array, uniforms: Array) -> GroupCloud:
    """Move weight between the strata and keep the number of particles of each.

    Args:
        groups: All children.
        weights: Their weights, shape (3, N).
        strata: How particles are divided.
        chain: Probabilities to go from one stratum (row) to another (column) for the next step, shape (M, M).
        uniforms: A draw in [0, 1) for each stratum, shape (M,).

    Returns:
        The particles that the next step begins with.

    """
    cloud = _moments(groups, weights, strata, chain)
    f = groups.f.ravel()
    order = f.argsort(kind='stable')
    kept = order.take(_chosen(weights.take(order), strata.child_of.take(order), cloud.weight, strata, chain, uniforms))
    parent = strata.parent.take(kept)
    f = f.take(kept)
    x = groups.x.take(parent, axis=1)
    x += groups.c.take(strata.of.take(parent), axis=1) * (f - groups.base.take(parent))
    return _matched(f, x, cloud, strata)


def _chosen(
    ordered: Array, of: NDArray[np.intp], weight: Array, strata: Strata, chain: Array, uniforms: Array
) -> NDArray[np.intp]:
    """Systematic resampling for each stratum: places among the ordered children, shape (N,)."""
    if len(strata.sizes) == 1:
        return systematic(ordered, strata.sizes[0], float(uniforms[0]))
    # Share of a child's weight that each stratum sees, of its own weight.
    seen = (chain / np.maximum(weight, TINY)).T
    chosen = np.empty(len(strata.of), dtype=np.intp)
    for part, rank, size, share, uniform in zip(
        strata.parts, strata.ranks, strata.sizes, seen, uniforms.tolist(), strict=True
    ):
        cumulated = (ordered * share.take(of)).cumsum()
        chosen[part] = cumulated.searchsorted(rank + uniform / size, side='right')
    # The cumulated weights can end below one by rounding.
    return np.minimum(chosen, len(ordered) - 1, out=chosen)


def _moments(groups: Branches, weights: Array, strata: Strata, chain: Array) -> GroupCloud:
    """Weight, mean, variance and regression of all children as seen by each stratum; no particles yet."""
    n, N = groups.x.shape
    w0 = weights[0] + weights[1] + weights[2]
    centre = float(w0 @ groups.base)
    # Sums over the particles of each stratum of products of a weight and a value.
    values, by = np.empty((2 + n, N)), np.empty((4, N))
    values[0], values[2:] = 1.0, groups.x
    base = np.subtract(groups.base, centre, out=values[1])
    by[0], by[1], by[3] = w0, w0 * base, weights[1]
    np.subtract(weights[2], weights[0], out=by[2])
    columns = [
        _column((by[:, part] @ values[:, part].T).tolist(), step, slope)
        for part, step, slope in zip(strata.parts, groups.h.tolist(), groups.c.T.tolist(), strict=True)
    ]
    rows = np.array(columns).T @ chain
    weight = np.maximum(rows[0], TINY)
    means = rows[1:] / weight
    mean, x = means[0], means[2 : 2 + n]
    variance = np.maximum(means[1] - mean * mean, LEAST_VARIANCE)
    slope = (means[2 + n :] - x * mean) / variance
    return GroupCloud(base, x, weight / weight.sum(), mean + centre, variance, slope)


def _column(sums: list[list[float]], h: float, c: list[float]) -> list[float]:
    """Sums over all children of a stratum of 1, f, f^2, x and x f; plain floats are faster for so few."""
    (one, base, *x), (_, bases, *leans), (step, stepped, *steps), (middle, *_) = sums
    mixed = h * stepped + h * h * (one - middle)
    first = [a + slope * h * step for a, slope in zip(x, c, strict=True)]
    last = [a + h * b + slope * mixed for a, b, slope in zip(leans, steps, c, strict=True)]
    return [one, base + h * step, bases + h * stepped + mixed, *first, *last]


def _matched(f: Array, x: Array, target: GroupCloud, strata: Strata) -> GroupCloud:
    """Move survivors to the mean and variance of f, and to the mean of x, of those that they stand for."""
    of = strata.of
    off = f - (f @ strata.average).take(of)
    variance = (off * off) @ strata.average
    spread = np.minimum(np.sqrt(target.variance / np.maximum(variance, TINY)), MOST_SPREAD)
    off *= spread.take(of)
    off += target.mean.take(of)
    x += target.slope.take(of, axis=1) * (off - f)
    x += (target.x - x @ strata.average).take(of, axis=1)
    return GroupCloud(off, x, target.weight, target.mean, target.variance, target.slope)
