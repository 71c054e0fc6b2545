# SPDX-License-Identifier: Apache-2.0
"""Particles of a parameter with the filters of Zheng et al. 2015: RBPF, SMA and GSMA, as printed and corrected.

They run on any linear step, so on the paper's data as well as in the nodes. States have been predicted with the
particles' own values of f before, see :class:`LinearStep`; a value that changes moves x by gamma.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.brake_rate.particles import Array, Correction, LinearStep, distance
from trainid_ros.brake_rate.resampling import effective_number, normalise, systematic

if TYPE_CHECKING:
    from numpy.typing import NDArray

# A particle in the middle of a printed group takes the values of this group.
_GROUP: Final = np.array([[1], [0], [-1]])


class ThetaCloud(NamedTuple):
    """Rates f, shape (N,), normalised log-weights, shape (N,), and means of x given f, shape (n, N)."""

    f: Array
    log_weights: Array
    x: Array

    @property
    def weights(self) -> Array:
        """Normalised weights, shape (N,)."""
        return np.exp(self.log_weights)


@dataclass(frozen=True, slots=True)
class MRule:
    """How an M-algorithm prunes.

    Attributes:
        keep: Particles kept, N.
        most: Particles at which it prunes, Q.
        carries: Weights carry over, w_k = w_{k-1} p(y_k); printed (17): they do not.
        stochastic: Systematic resampling; printed: the N of highest weight, which is biased.

    """

    keep: int
    most: int
    carries: bool
    stochastic: bool


def rbpf(
    cloud: ThetaCloud, step: LinearStep, fix: Correction, H: Array, y: Array, jitter: Array, uniform: float
) -> ThetaCloud:
    """Rao-Blackwellised particle filter; values move by ``jitter``, shape (N,), zero for a static parameter."""
    f, x = cloud.f + jitter, cloud.x + step.gamma[:, None] * jitter
    nu = y[:, None] - H @ x
    # Paper, step 3: divided by the sum of squares; and N_eff from weights that were not normalised.
    log_weights = normalise(cloud.log_weights - 0.5 * distance(fix.W, nu))
    x = x + fix.K @ nu
    N = len(f)
    weights = np.exp(log_weights)
    if effective_number(weights) >= 0.5 * N:
        return ThetaCloud(f, log_weights, x)
    kept = systematic(weights, N, uniform)
    return ThetaCloud(f[kept], np.full(N, -math.log(N)), x[:, kept])


def rbpf_optimal(
    cloud: ThetaCloud,
    grid: Array,
    step: LinearStep,
    fix: Correction,
    H: Array,
    y: Array,
    uniforms: Array | None,
) -> ThetaCloud:
    """RBPF that draws each value from p(theta_k | y_k), eqs. (9)-(13); as the text says the likeliest, if no uniforms.

    The printed (13) lacks w_{k-1} and the prior, which is uniform over the grid here.
    """
    nu = y[:, None, None] - _child_measurements(cloud, np.repeat(grid[:, None], len(cloud.f), axis=1), step, H)
    log_likelihood = -0.5 * distance(fix.W, nu)  # (M, N)
    peak = log_likelihood.max(axis=0)
    cumulated = np.exp(log_likelihood - peak).cumsum(axis=0)
    total = cumulated[-1]
    chosen = log_likelihood.argmax(axis=0) if uniforms is None else (cumulated < uniforms * total).sum(axis=0)
    f = grid[np.minimum(chosen, len(grid) - 1)]
    x = cloud.x + step.gamma[:, None] * (f - cloud.f)
    x = x + fix.K @ (y[:, None] - H @ x)
    log_weights = normalise(cloud.log_weights + peak + np.log(total))
    N, weights = len(f), np.exp(log_weights)
    if effective_number(weights) >= 0.5 * N:
        return ThetaCloud(f, log_weights, x)
    kept = systematic(weights, N, float(uniforms[0]) if uniforms is not None else 0.5)
    return ThetaCloud(f[kept], np.full(N, -math.log(N)), x[:, kept])


def _child_measurements(cloud: ThetaCloud, children: Array, step: LinearStep, H: Array) -> Array:
    """Expected measurements of children, shape (m, M, N)."""
    at_own = H @ cloud.x
    lean = H @ step.gamma
    expected: Array = at_own[:, None, :] + lean[:, None, None] * (children - cloud.f)
    return expected


def all_values(grid: Array, f: Array) -> Array:
    """SMA: from anywhere to any value, shape (M, N)."""
    return np.repeat(grid[:, None], len(f), axis=1)


def printed_groups(grid: Array, f: Array, first: int) -> Array:
    """GSMA: the three neighbours of the group whose mean is nearest, shape (3, N).

    Args:
        grid: Values in falling order, equally spaced, shape (M,).
        f: Values of the particles, shape (N,).
        first: Index in the grid of the middle of the first group. Printed is 2: the group of the second value is
            missing, against the paper's own rule; corrected is 1.

    """
    spacing = grid[0] - grid[1]
    middle: NDArray[np.intp] = np.clip(np.rint((grid[0] - f) / spacing).astype(np.intp), first, len(grid) - 2)
    values: Array = grid[middle - _GROUP]
    return values


def m_algorithm(
    cloud: ThetaCloud,
    children: Array,
    step: LinearStep,
    fix: Correction,
    H: Array,
    y: Array,
    rule: MRule,
    uniform: float,
) -> tuple[ThetaCloud, ThetaCloud]:
    """Branch to children, shape (M, N), weigh them, and prune: all particles, and those that the next step gets."""
    M = len(children)
    f = children.ravel()
    x = np.tile(cloud.x, M) + step.gamma[:, None] * (f - np.tile(cloud.f, M))
    nu = y[:, None] - H @ x
    before = np.tile(cloud.log_weights, M) if rule.carries else 0.0
    log_weights = normalise(before - 0.5 * distance(fix.W, nu))
    everything = ThetaCloud(f, log_weights, x + fix.K @ nu)
    if len(f) <= rule.most:
        return everything, everything
    return everything, _prune(everything, rule, uniform)


def _prune(cloud: ThetaCloud, rule: MRule, uniform: float) -> ThetaCloud:
    if rule.stochastic:
        kept = systematic(cloud.weights, rule.keep, uniform)
        return ThetaCloud(cloud.f[kept], np.full(rule.keep, -math.log(rule.keep)), cloud.x[:, kept])
    kept = np.argsort(-cloud.log_weights, kind='stable')[: rule.keep]
    return ThetaCloud(cloud.f[kept], normalise(cloud.log_weights[kept]), cloud.x[:, kept])
