# SPDX-License-Identifier: Apache-2.0
"""One step of the group stochastic M-algorithm on any linear state, in strata of a Markov chain.

Based on Zheng et al. 2015, section 3.5 and eqs. (14)-(22), with these corrections:

* The group of a particle is {f - h, f, f + h} around its own value with prior weights 1/6, 2/3, 1/6 and
  h = sqrt(3 q dt): every value has its group (the paper omits one), values are not bound to a grid, and the
  transition has the variance of a random walk per second instead of a grid step per sample.
* Weights are retained: w_k = w_{k-1} p(f_k | f_{k-1}) N(y_k); pruning is systematic resampling in the order of f.
* Particles belong to strata with different q (quiet, jumping); a Markov chain transfers weight between the strata.
  Each stratum keeps its number of particles however small its weight, so an improbable hypothesis is not pruned
  before the measurements can decide.
* Before branching, a stratum shrinks by sqrt(1 - kappa^2) towards its mean and h grows to
  sqrt(3 (q dt + kappa^2 s^2)), which preserves its mean and its variance s^2 + q dt and keeps its values distinct. x
  moves with f according to its regression on f. After pruning, the particles are shifted and scaled to the mean and
  variance before pruning. In a stratum with a Gaussian posterior no sampling noise is left in either.

A particle is a column z = [1, f, x], and its stratum has a line, the regression of x on f; so everything that happens
to the particles of a stratum between two prunings is one matrix, and a step needs few array operations.
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
# Limit of the factor that scales survivors to the variance before pruning.
MOST_SPREAD: Final = 2.0
TINY: Final = 1e-300
# Lower limit of the variance: if one child has all the weight, the spread within its group is still unknown.
LEAST_VARIANCE: Final = 1e-10


@dataclass(frozen=True, slots=True)
class Strata:
    """Division of N particles into M strata.

    Attributes:
        sizes: Number of particles of each stratum.
        of: Stratum of each particle, shape (N,).
        members: One if a particle belongs to a stratum, else zero, shape (M, N).
        children: The same for all children, shape (M, 3 N).
        shares: Share of each particle in its stratum, zero elsewhere, shape (M, N).
        average: The same transposed: averages over each stratum, shape (N, M).
        ranks: Index of its stratum plus the share of the stratum before each particle, shape (N,).
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
    """Particles in strata; the weights within a stratum are equal.

    Attributes:
        z: One, brake rate f [1] and mean of the linear state x given f of each particle, shape (2 + n, N).
        weight: Weight of each stratum, shape (M,), with the sum one.
        mean: Mean of f in each stratum [1], shape (M,).
        variance: Variance of f in each stratum [1], shape (M,).
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
        """Brake rates [1], shape (N,)."""
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
        """Mean of f [1], eq. (19)."""
        return float(self.weight.dot(self.mean))

    @property
    def total_variance(self) -> float:
        """Variance of f [1]."""
        d = self.mean - self.rate
        return float(self.weight.dot(self.variance + d * d))


def _keeping_f(known: Array, gamma: Array, Phi: Array) -> Array:
    """Return the matrix that keeps f and maps x to known + gamma f + Phi x."""
    A = np.zeros((2 + len(Phi), 2 + len(Phi)))
    A[0, 0] = A[1, 1] = 1.0
    A[2:, 0], A[2:, 1], A[2:, 2:] = known, gamma, Phi
    return A


def _moved(cloud: GroupCloud, A: Array) -> GroupCloud:
    return GroupCloud(A.dot(cloud.z), cloud.weight, cloud.mean, cloud.variance, A.dot(cloud.line))


def anchored(cloud: GroupCloud, start: Array, slope: Array, keep: Array) -> GroupCloud:
    """Map x to ``start + f slope + keep x``, each of shape (n,); f is unchanged."""
    return _moved(cloud, _keeping_f(start, slope, np.diag(keep)))


def predicted(cloud: GroupCloud, step: LinearStep) -> GroupCloud:
    """Predict over a step with constant f, eq. (14)."""
    return _moved(cloud, _keeping_f(step.known, step.gamma, step.Phi))


def followed(cloud: GroupCloud, fix: Correction, H: Array, y: Array) -> GroupCloud:
    """Update x only, with a measurement y, shape (m,), that carries no information on f."""
    return _moved(cloud, _measured(fix, H, y)[: len(cloud.z)])


def _measured(fix: Correction, H: Array, y: Array) -> Array:
    """Return the matrix that maps x to x + K (y - H x), eq. (21), and appends W (y - H x), shape (2 + n + m, 2 + n)."""
    m, n = H.shape
    innovation = np.zeros((m, 2 + n))
    innovation[:, 0], innovation[:, 2:] = y, -H
    A = np.zeros((2 + n + m, 2 + n))
    A.flat[: (2 + n) ** 2 : 3 + n] = 1.0
    A[2 : 2 + n] += fix.K.dot(innovation)
    A[2 + n :] = fix.W.dot(innovation)
    return A


def widened(cloud: GroupCloud, step: LinearStep, variance: float) -> GroupCloud:
    """Add to the variance of f [1] the drift before the predicted step, by spreading the values."""
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
    """The groups of all particles: the maps from particles to children.

    Attributes:
        z: For each stratum one and f of its particles, zero elsewhere; then x; shape (2 M + n, N).
        maps: Matrices that map it to [1, f - centre, x] of each child, shape (2 + n, 3, 2 M + n).
        centre: Origin of f of the children [1], so that their moments are not differences of large numbers.
        log_prior: Logarithm of the weight of each child, shape (3, N).

    """

    z: Array
    maps: Array
    centre: float
    log_prior: Array


class Children(NamedTuple):
    """All children, ordered by offset: those at f - h of all particles first.

    Attributes:
        z: [1, f - centre, x] of each, shape (2 + n, 3 N).
        centre: Origin of f [1].

    """

    z: Array
    centre: float


def branch(cloud: GroupCloud, strata: Strata, step: LinearStep, walk: Array) -> Branches:
    """Return the groups of predicted particles; ``walk`` is the variance q dt [1] of each stratum, shape (M,)."""
    line, centre, M = cloud.line, cloud.rate, len(walk)
    kernel = KAPPA**2 * cloud.variance
    both = np.maximum(walk + kernel, TINY)
    h = np.sqrt(3.0 * both)
    # The kernel moves f over its entire past, so x along its regression; the walk moves f in this step only.
    now = np.array([0.0, 1.0, *step.gamma.tolist()])[:, None]
    c = now + kernel / both * (line - now)
    # A particle shrinks by (f - mean) along the line; its children are h apart along c.
    shrink, apart = SHRUNK * line, h * c
    maps = _identity_maps(len(now), M).copy()
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
def _identity_maps(n: int, M: int) -> Array:
    """Return maps to children [1, f, x] of length n that equal their particles."""
    maps = np.zeros((n, 3, 2 * M + n - 2))
    maps[0, :, :M] = maps[1, :, M : 2 * M] = 1.0
    maps[2:, :, 2 * M :] = np.eye(n - 2)[:, None]
    return maps


def weigh(groups: Branches, fix: Correction, H: Array, y: Array, largest: float) -> tuple[Children, Array]:
    """Update with a measurement, shape (m,): return the children and their normalised weights, shape (3 N,).

    Children outside 0 <= f <= largest [1] get the weight zero.
    """
    n, m, N = len(groups.maps), len(y), groups.z.shape[1]
    # Below [1, f, x] after the measurement comes the whitened innovation W (y - H x).
    maps = _measured(fix, H, y).dot(groups.maps.reshape(n, -1)).reshape(3 * (n + m), -1)
    rows = maps.dot(groups.z).reshape(n + m, 3, N)
    # Eq. (17), times the weight of the particle and the prior of the child.
    log_weights = _summed(np.square(rows[n:]))
    log_weights *= -0.5
    log_weights += groups.log_prior
    f, low, high = rows[1], -groups.centre, largest - groups.centre
    if f[0].min() < low or f[2].max() > high:
        log_weights[(f < low) | (f > high)] = -np.inf
    # Eq. (18).
    return Children(rows[:n].reshape(n, 3 * N), groups.centre), normal_weights(log_weights.ravel())


def _summed(squares: Array) -> Array:
    """Return the sum over the measurements; usually there is only one."""
    total: Array = squares[0] if len(squares) == 1 else squares.sum(axis=0)
    return total


def prune(children: Children, weights: Array, strata: Strata, chain: Array, uniforms: Array) -> GroupCloud:
    """Transfer weight between the strata and resample each to its number of particles.

    Args:
        children: All children.
        weights: Their weights, shape (3 N,).
        strata: Division of the particles.
        chain: Transition probabilities from stratum (row) to stratum (column) for the next step, shape (M, M).
        uniforms: A draw in [0, 1) for each stratum, shape (M,).

    Returns:
        The particles for the next step.

    """
    z, M = children.z, len(chain)
    # Moments of each stratum from the weights of all children in it, and from these weights times f.
    weighted = np.empty((2, M, z.shape[1]))
    np.multiply(chain.T.dot(strata.children), weights, out=weighted[0])
    np.multiply(weighted[0], z[1], out=weighted[1])
    sums = weighted.reshape(2 * M, -1).dot(z.T).reshape(2, M, -1)
    weight = np.maximum(sums[0, :, 0], TINY)
    mean, product = sums / weight[:, None]
    along = product - mean * mean[:, 1:2]
    variance = np.maximum(along[:, 1], LEAST_VARIANCE)
    along[:, 0], along[:, 1] = 0.0, variance
    line = (along / variance[:, None]).T.copy()
    kept = _resample(weighted[0] / weight[:, None], z[1], strata, uniforms)
    survivors = _match_moments(z.take(kept, axis=1), mean.T, variance, line, strata)
    survivors[0] = 1.0
    survivors[1] += children.centre
    return GroupCloud(survivors, weight / np.add.reduce(weight), mean[:, 1] + children.centre, variance, line)


def _resample(weights: Array, f: Array, strata: Strata, uniforms: Array) -> NDArray[np.intp]:
    """Return the children that each stratum keeps, shape (N,): systematic resampling in the order of f."""
    order = f.argsort(kind='stable')
    # One stratum after another: the weights in the m-th are cumulated from m to m + 1.
    cumulated = weights.take(order, axis=1).ravel().cumsum()
    places = cumulated.searchsorted(strata.ranks + uniforms.dot(strata.shares), side='right')
    places -= strata.of * len(f)
    # Due to rounding the sum of a stratum may differ from m + 1.
    kept: NDArray[np.intp] = order.take(places, mode='clip')
    return kept


def _match_moments(z: Array, mean: Array, variance: Array, line: Array, strata: Strata) -> Array:
    """Shift and scale survivors to the mean and variance of f, and to the mean of x, before pruning."""
    members = strata.members
    average = z.dot(strata.average)
    off = z[1] - average[1].dot(members)
    spread = np.sqrt(variance / np.maximum((off * off).dot(strata.average), TINY))
    off *= (np.minimum(spread, MOST_SPREAD) - 1.0).dot(members)
    z += line.dot(members * off)
    z += (mean - average).dot(members)
    return z
