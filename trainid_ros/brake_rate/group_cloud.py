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

A particle is a column z = [1, f, x] and its stratum a line along which f and x go together, so that all that happens
to the particles of a stratum between two prunings is one matrix: a step costs few operations on arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.brake_rate.particles import Array, Correction, LinearStep
from trainid_ros.brake_rate.resampling import normal_weights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

# Prior weights of the children in a group.
_LOG_PRIOR: Final = np.log([1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0])
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
        of: Stratum of each particle, shape (N,).
        members: One where a particle belongs to a stratum, else zero, shape (M, N).
        children: The same of all children, shape (M, 3 N).
        shares: Share of each particle in its stratum, zero elsewhere, shape (M, N).
        average: The same transposed: averages over each stratum, shape (N, M).
        ranks: Number of its stratum and, as a share of it, of the particles before each, shape (N,).
        log_shares: Logarithm of a child's prior share in its stratum, shape (3, M).

    """

    sizes: tuple[int, ...]
    of: NDArray[np.intp]
    members: Array
    children: Array
    shares: Array
    average: Array
    ranks: Array
    log_shares: Array

    @classmethod
    def divide(cls, sizes: Sequence[int]) -> Strata:
        """Return strata of these sizes, one after another."""
        of = np.repeat(np.arange(len(sizes)), sizes)
        counts = np.array(sizes, dtype=float)
        members = (of == np.arange(len(sizes))[:, None]).astype(float)
        shares = members / counts[:, None]
        ranks = np.concatenate([m + np.arange(size) / size for m, size in enumerate(sizes)])
        log_shares = _LOG_PRIOR[:, None] - np.log(counts)
        return cls(tuple(sizes), of, members, np.tile(members, 3), shares, shares.T.copy(), ranks, log_shares)


class GroupCloud(NamedTuple):
    """Particles in strata; equal weights within each.

    Attributes:
        z: One, brake rate f and means of the linear state x given f of each particle, shape (2 + n, N).
        weight: Weight of each stratum, shape (M,); they sum to one.
        mean: Mean of f in each stratum, shape (M,).
        variance: Variance of f in each stratum, shape (M,).
        line: Zero, one and the regression of x on f in each stratum, shape (2 + n, M).

    """

    z: Array
    weight: Array
    mean: Array
    variance: Array
    line: Array

    @classmethod
    def of(cls, f: Array, x: Array, weight: Array, mean: Array, variance: Array, slope: Array) -> GroupCloud:
        """Return particles with rates f, shape (N,), states x, shape (n, N), and a regression, shape (n, M)."""
        M = len(weight)
        z, line = np.vstack([np.ones(len(f)), f, x]), np.vstack([np.zeros(M), np.ones(M), slope])
        return cls(z, weight, mean, variance, line)

    @property
    def f(self) -> Array:
        """Brake rates, shape (N,)."""
        f: Array = self.z[1]
        return f

    @property
    def x(self) -> Array:
        """Means of the linear state given f, shape (n, N)."""
        return self.z[2:]

    @property
    def slope(self) -> Array:
        """Regression of x on f in each stratum, shape (n, M)."""
        return self.line[2:]

    @property
    def rate(self) -> float:
        """Mean of f (19)."""
        return float(self.weight.dot(self.mean))

    @property
    def total_variance(self) -> float:
        """Variance of f."""
        d = self.mean - self.rate
        return float(self.weight.dot(self.variance + d * d))


def _keeping_f(known: Array, gamma: Array, Phi: Array) -> Array:
    """Return the matrix that leaves f and makes of x known + gamma f + Phi x."""
    A = np.zeros((2 + len(Phi), 2 + len(Phi)))
    A[0, 0] = A[1, 1] = 1.0
    A[2:, 0], A[2:, 1], A[2:, 2:] = known, gamma, Phi
    return A


def _moved(cloud: GroupCloud, A: Array) -> GroupCloud:
    return GroupCloud(A.dot(cloud.z), cloud.weight, cloud.mean, cloud.variance, A.dot(cloud.line))


def anchored(cloud: GroupCloud, start: Array, slope: Array, keep: Array) -> GroupCloud:
    """Make of x ``start + f slope + keep x``, each of shape (n,); f stands."""
    return _moved(cloud, _keeping_f(start, slope, np.diag(keep)))


def predicted(cloud: GroupCloud, step: LinearStep) -> GroupCloud:
    """Follow a step while f stands (14)."""
    return _moved(cloud, _keeping_f(step.known, step.gamma, step.Phi))


def followed(cloud: GroupCloud, fix: Correction, H: Array, y: Array) -> GroupCloud:
    """Take in a measurement y, shape (m,), that tells nothing of f."""
    return _moved(cloud, _measured(fix, H, y)[: len(cloud.z)])


def _measured(fix: Correction, H: Array, y: Array) -> Array:
    """Return the matrix that makes of x x + K (y - H x) (21) and adds W (y - H x), shape (2 + n + m, 2 + n)."""
    m, n = H.shape
    innovation = np.zeros((m, 2 + n))
    innovation[:, 0], innovation[:, 2:] = y, -H
    A = np.zeros((2 + n + m, 2 + n))
    A.flat[: (2 + n) ** 2 : 3 + n] = 1.0
    A[2 : 2 + n] += fix.K.dot(innovation)
    A[2 + n :] = fix.W.dot(innovation)
    return A


def widened(cloud: GroupCloud, step: LinearStep, variance: float) -> GroupCloud:
    """Add to the variance of f what it drifted by before the predicted step, by moving values apart."""
    total, rate = cloud.total_variance, cloud.rate
    if total <= 0.0:
        return cloud
    ratio = math.sqrt(1.0 + variance / total)
    along = (ratio - 1.0) * np.array([0.0, 1.0, *step.gamma])[:, None]
    return GroupCloud(
        z=cloud.z + along * (cloud.f - rate),
        weight=cloud.weight,
        mean=rate + ratio * (cloud.mean - rate),
        variance=ratio * ratio * cloud.variance,
        line=(cloud.line + along) / ratio,
    )


class Branches(NamedTuple):
    """The groups of all particles: what makes children of particles.

    Attributes:
        z: For each stratum one and f of its particles, zero elsewhere, then x; shape (2 M + n, N).
        maps: Matrices that make [1, f - centre, x] of each child of that, shape (2 + n, 3, 2 M + n).
        centre: What f of the children is relative to, so that their moments are not differences of large numbers.
        log_prior: Logarithm of the weight of each child, shape (3, N).

    """

    z: Array
    maps: Array
    centre: float
    log_prior: Array


class Children(NamedTuple):
    """All children, first those at f - h of all particles.

    Attributes:
        z: [1, f - centre, x] of each, shape (2 + n, 3 N).
        centre: What f is relative to.

    """

    z: Array
    centre: float


def branch(cloud: GroupCloud, strata: Strata, step: LinearStep, walk: Array) -> Branches:
    """Return the groups of predicted particles; ``walk`` is the variance q dt of each stratum, shape (M,)."""
    line, centre, M = cloud.line, cloud.rate, len(walk)
    kernel = KAPPA**2 * cloud.variance
    both = np.maximum(walk + kernel, TINY)
    h = np.sqrt(3.0 * both)
    # The kernel moves f throughout its past, so x along its regression; the walk has moved it in this step only.
    now = np.array([0.0, 1.0, *step.gamma.tolist()])[:, None]
    c = now + kernel / both * (line - now)
    # A particle shrinks by (f - mean) along the line; its children are h apart along c.
    shrink, apart = SHRUNK * line, h * c
    maps = _staying(len(now), M).copy()
    constant, of_f = maps[:, :, :M], maps[:, :, M : 2 * M]
    of_f += shrink[:, None]
    constant -= (cloud.mean * shrink)[:, None]
    constant[:, 0] -= apart
    constant[:, 2] += apart
    constant[1] -= centre
    z = np.empty((maps.shape[2], len(strata.of)))
    z[:M], z[2 * M :] = strata.members, cloud.x
    np.multiply(strata.members, cloud.f, out=z[M : 2 * M])
    log_prior = (np.log(np.maximum(cloud.weight, TINY)) + strata.log_shares).dot(strata.members)
    return Branches(z, maps, centre, log_prior)


@cache
def _staying(n: int, M: int) -> Array:
    """Return maps of children [1, f, x] of n numbers that are where their particle is."""
    maps = np.zeros((n, 3, 2 * M + n - 2))
    maps[0, :, :M] = maps[1, :, M : 2 * M] = 1.0
    maps[2:, :, 2 * M :] = np.eye(n - 2)[:, None]
    return maps


def weigh(groups: Branches, fix: Correction, H: Array, y: Array, largest: float) -> tuple[Children, Array]:
    """Take in a measurement, shape (m,): children after it, and their normalised weights (17), (18), shape (3 N,).

    No child beyond 0 <= f <= largest remains.
    """
    n, m, N = len(groups.maps), len(y), groups.z.shape[1]
    # Below [1, f, x] after the measurement comes the whitened innovation W (y - H x).
    maps = _measured(fix, H, y).dot(groups.maps.reshape(n, -1)).reshape(3 * (n + m), -1)
    rows = maps.dot(groups.z).reshape(n + m, 3, N)
    log_weights = _summed(np.square(rows[n:]))
    log_weights *= -0.5
    log_weights += groups.log_prior
    f, low, high = rows[1], -groups.centre, largest - groups.centre
    if f[0].min() < low or f[2].max() > high:
        log_weights[(f < low) | (f > high)] = -np.inf
    return Children(rows[:n].reshape(n, 3 * N), groups.centre), normal_weights(log_weights.ravel())


def _summed(squares: Array) -> Array:
    """Return the sum over measurements, as a rule one."""
    total: Array = squares[0] if len(squares) == 1 else squares.sum(axis=0)
    return total


def prune(children: Children, weights: Array, strata: Strata, chain: Array, uniforms: Array) -> GroupCloud:
    """Move weight between the strata and keep the number of particles of each.

    Args:
        children: All children.
        weights: Their weights, shape (3 N,).
        strata: How particles are divided.
        chain: Probabilities to go from one stratum (row) to another (column) for the next step, shape (M, M).
        uniforms: A draw in [0, 1) for each stratum, shape (M,).

    Returns:
        The particles that the next step begins with.

    """
    z, M = children.z, len(chain)
    # Weights of all children as each stratum sees them, and these times f, give its moments.
    seen = np.empty((2, M, z.shape[1]))
    np.multiply(chain.T.dot(strata.children), weights, out=seen[0])
    np.multiply(seen[0], z[1], out=seen[1])
    sums = seen.reshape(2 * M, -1).dot(z.T).reshape(2, M, -1)
    weight = np.maximum(sums[0, :, 0], TINY)
    mean, product = sums / weight[:, None]
    along = product - mean * mean[:, 1:2]
    variance = np.maximum(along[:, 1], LEAST_VARIANCE)
    along[:, 0], along[:, 1] = 0.0, variance
    line = (along / variance[:, None]).T.copy()
    kept = _chosen(seen[0] / weight[:, None], z[1], strata, uniforms)
    survivors = _matched(z.take(kept, axis=1), mean.T, variance, line, strata)
    survivors[0] = 1.0
    survivors[1] += children.centre
    return GroupCloud(survivors, weight / np.add.reduce(weight), mean[:, 1] + children.centre, variance, line)


def _chosen(seen: Array, f: Array, strata: Strata, uniforms: Array) -> NDArray[np.intp]:
    """Systematic resampling in the order of f: which children each stratum keeps, shape (N,)."""
    order = f.argsort(kind='stable')
    # One stratum after another: the weights that the m-th sees are cumulated from m to m + 1.
    cumulated = seen.take(order, axis=1).ravel().cumsum()
    places = cumulated.searchsorted(strata.ranks + uniforms.dot(strata.shares), side='right')
    places -= strata.of * len(f)
    # By rounding, the sum of a stratum can end beside m + 1.
    kept: NDArray[np.intp] = order.take(places, mode='clip')
    return kept


def _matched(z: Array, mean: Array, variance: Array, line: Array, strata: Strata) -> Array:
    """Move survivors to the mean and variance of f, and to the mean of x, of those that they stand for."""
    members = strata.members
    average = z.dot(strata.average)
    off = z[1] - average[1].dot(members)
    spread = np.sqrt(variance / np.maximum((off * off).dot(strata.average), TINY))
    off *= (np.minimum(spread, MOST_SPREAD) - 1.0).dot(members)
    z += line.dot(members * off)
    z += (mean - average).dot(members)
    return z
