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

from trainid_ros.estimators.brake_rate.particles import Array, Correction, LinearStep, distance
from trainid_ros.estimators.brake_rate.resampling import normal_weights, systematic

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_GROUP: Final = np.array([[-1.0], [0.0], [1.0]])
_LOG_PRIOR: Final = np.log(np.array([[1.0], [4.0], [1.0]]) / 6.0)
_KAPPA: Final = 0.2
_SHRUNK: Final = math.sqrt(1.0 - _KAPPA**2) - 1.0
# Survivors are not spread by more than this to match those that they stand for.
_MOST_SPREAD: Final = 2.0
_TINY: Final = 1e-300
# Where one child outweighs all others, the spread of its group is still unknown.
_LEAST_VARIANCE: Final = 1e-10


@dataclass(frozen=True, slots=True)
class Strata:
    """How N particles are divided among M strata.

    Attributes:
        sizes: Particles of each stratum.
        of: Stratum of each particle, shape (N,).
        member: 1 in the column of a particle's stratum, shape (N, M).
        average: Averages over each stratum, shape (N, M).
        log_shares: Logarithm of a particle's share in its stratum, shape (M,).

    """

    sizes: tuple[int, ...]
    of: NDArray[np.intp]
    member: Array
    average: Array
    log_shares: Array

    @classmethod
    def divide(cls, sizes: Sequence[int]) -> Strata:
        """Return strata of these sizes, one after another."""
        of = np.repeat(np.arange(len(sizes)), sizes)
        counts = np.array(sizes, dtype=float)
        member = (of[:, None] == np.arange(len(sizes))).astype(float)
        return cls(tuple(sizes), of, member, member / counts, -np.log(counts))


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
    """The groups of all particles: child k of particle i has f = base_i + offset_ki and x = x_i + offset_ki c_i.

    Attributes:
        base: Shrunk rates, shape (N,).
        offset: Steps within the groups, shape (3, N).
        x: States of the children in the middle, shape (n, N).
        c: Their slope within a group, shape (n, N).
        log_prior: Logarithms of the weights, shape (3, N).

    """

    base: Array
    offset: Array
    x: Array
    c: Array
    log_prior: Array


def branch(cloud: GroupCloud, strata: Strata, step: LinearStep, walk: Array) -> Branches:
    """Return the groups of predicted particles; ``walk`` is the variance q dt of each stratum, shape (M,)."""
    of = strata.of
    kernel = _KAPPA**2 * cloud.variance
    both = np.maximum(walk + kernel, _TINY)
    # The kernel moves f throughout its past, so x along its regression; the walk has moved it in this step only.
    gamma = step.gamma[:, None]
    c = gamma + kernel / both * (cloud.slope - gamma)
    moved = _SHRUNK * (cloud.f - cloud.mean.take(of))
    log_weight = np.log(np.maximum(cloud.weight, _TINY)) + strata.log_shares
    return Branches(
        base=cloud.f + moved,
        offset=_GROUP * np.sqrt(3.0 * both).take(of),
        x=cloud.x + cloud.slope.take(of, axis=1) * moved,
        c=c.take(of, axis=1),
        log_prior=_LOG_PRIOR + log_weight.take(of),
    )


def weigh(groups: Branches, fix: Correction, H: Array, y: Array, largest: float) -> tuple[Branches, Array]:
    """Take in a measurement, shape (m,): children after it, and their normalised weights (17), (18), shape (3, N).

    No child beyond 0 <= f <= largest remains.
    """
    nu = y[:, None] - H @ groups.x
    lean = H @ groups.c
    log_weights = groups.log_prior - 0.5 * distance(fix.W, nu[:, None, :] - groups.offset * lean[:, None, :])
    f = groups.base + groups.offset
    if f.min() < 0.0 or f.max() > largest:
        log_weights = np.where((f >= 0.0) & (f <= largest), log_weights, -np.inf)
    weights = normal_weights(log_weights)
    after = Branches(
        groups.base, groups.offset, groups.x + fix.K @ nu, groups.c - fix.K @ lean, groups.log_prior
    )  # (21)
    return after, weights


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
    f = (groups.base + groups.offset).ravel()
    order = np.argsort(f, kind='stable')
    # Share of a child's weight that each stratum sees, of its own weight.
    seen = (chain / np.maximum(cloud.weight, _TINY)).T
    ranks = [
        systematic((weights * share.take(strata.of)).ravel().take(order), size, uniform)
        for share, size, uniform in zip(seen, strata.sizes, uniforms.tolist(), strict=True)
    ]
    kept = order.take(ranks[0] if len(ranks) == 1 else np.concatenate(ranks))
    parent = kept % len(groups.base)
    x = groups.x.take(parent, axis=1) + groups.offset.ravel().take(kept) * groups.c.take(parent, axis=1)
    return _matched(f.take(kept), x, cloud, strata)


def _moments(groups: Branches, weights: Array, strata: Strata, chain: Array) -> GroupCloud:
    """Weight, mean, variance and regression of all children as seen by each stratum; no particles yet."""
    n = len(groups.x)
    w0 = weights.sum(axis=0)
    weighted = weights * groups.offset
    w1 = weighted.sum(axis=0)
    w2 = (weighted * groups.offset).sum(axis=0)
    centre = float(w0 @ groups.base)
    base = groups.base - centre
    first = base * w0 + w1
    lean = base * w1 + w2
    # Sums over the children of each particle of 1, f, f^2, x and x f; then over the strata, and along the chain.
    rows = np.empty((3 + 2 * n, len(base)))
    rows[0], rows[1], rows[2] = w0, first, base * first + lean
    rows[3 : 3 + n] = groups.x * w0 + groups.c * w1
    rows[3 + n :] = groups.x * first + groups.c * lean
    sums = rows @ strata.member @ chain
    weight = np.maximum(sums[0], _TINY)
    means = sums[1:] / weight
    mean, x = means[0], means[2 : 2 + n]
    variance = np.maximum(means[1] - mean * mean, _LEAST_VARIANCE)
    slope = (means[2 + n :] - x * mean) / variance
    return GroupCloud(base, x, weight / weight.sum(), mean + centre, variance, slope)


def _matched(f: Array, x: Array, target: GroupCloud, strata: Strata) -> GroupCloud:
    """Move survivors to the mean and variance of f, and to the mean of x, of those that they stand for."""
    of = strata.of
    off = f - (f @ strata.average).take(of)
    variance = (off * off) @ strata.average
    spread = np.minimum(np.sqrt(target.variance / np.maximum(variance, _TINY)), _MOST_SPREAD)
    matched = target.mean.take(of) + spread.take(of) * off
    x = x + target.slope.take(of, axis=1) * (matched - f)
    x = x + (target.x - x @ strata.average).take(of, axis=1)
    return GroupCloud(matched, x, target.weight, target.mean, target.variance, target.slope)
