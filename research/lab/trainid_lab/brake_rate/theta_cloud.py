# SPDX-License-Identifier: Apache-2.0
"""Particle filters of Zheng et al. 2015 for a parameter f: RBPF, SMA and GSMA, as printed and corrected.

They run on any linear step, on the data of the paper as well as in the nodes. The states have already been predicted
with each particle's own f, see :class:`LinearStep`; a change of f then moves x by gamma times the change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_lab.brake_rate.particles import (
    Array,
    Correction,
    LinearStep,
    distance,
    effective_number,
    normal_weights,
    normalise,
    systematic,
)

# Index offsets of the values in a printed group from its middle.
_GROUP: Final = np.array([[1], [0], [-1]])


class ThetaCloud(NamedTuple):
    """Rates f [1], shape (N,), normalised log-weights, shape (N,), and means of x given f, shape (n, N)."""

    f: Array
    log_weights: Array
    x: Array

    @property
    def weights(self) -> Array:
        """Normalised weights, shape (N,)."""
        return np.exp(self.log_weights)


@dataclass(frozen=True, slots=True)
class MRule:
    """Pruning rule of an M-algorithm."""

    keep: int  # Number of particles kept, N
    most: int  # Number of particles above which they are pruned, Q
    carries: bool  # Whether weights are retained, w_k = w_{k-1} p(y_k); as printed in (17) they are not
    stochastic: bool  # Whether pruning is systematic resampling; printed: the N of highest weight, which is biased


def rbpf(
    cloud: ThetaCloud, step: LinearStep, fix: Correction, H: Array, y: Array, jitter: Array, uniform: float
) -> ThetaCloud:
    """Return one step of the RBPF; values move by ``jitter`` [1], shape (N,), zero for a static parameter."""
    f, x = cloud.f + jitter, cloud.x + step.gamma[:, None] * jitter
    nu = y[:, None] - H @ x
    # Normalised by the sum; the paper, step 3, divides by the sum of squares and uses unnormalised weights in N_eff.
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
    """Return one step of the RBPF that draws each value from p(theta_k | y_k), eqs. (9)-(13).

    Without ``uniforms`` it takes the value of largest probability, as in the text of the paper. The printed (13) lacks
    w_{k-1} and the prior, which is uniform over the grid here.
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
    # Eq. (13), with w_{k-1}.
    log_weights = normalise(cloud.log_weights + peak + np.log(total))
    N, weights = len(f), np.exp(log_weights)
    if effective_number(weights) >= 0.5 * N:
        return ThetaCloud(f, log_weights, x)
    kept = systematic(weights, N, float(uniforms[0]) if uniforms is not None else 0.5)
    return ThetaCloud(f[kept], np.full(N, -math.log(N)), x[:, kept])


def _child_measurements(cloud: ThetaCloud, children: Array, step: LinearStep, H: Array) -> Array:
    """Return the predicted measurements of children, shape (m, M, N)."""
    own = H @ cloud.x
    gain = H @ step.gamma
    expected: Array = own[:, None, :] + gain[:, None, None] * (children - cloud.f)
    return expected


def all_values(grid: Array, f: Array) -> Array:
    """Return the children of SMA: all values of the grid for each particle, shape (M, N)."""
    return np.repeat(grid[:, None], len(f), axis=1)


def printed_groups(grid: Array, f: Array, first: int) -> Array:
    """Return the children of GSMA: the three values of the group with the nearest mean, shape (3, N).

    Args:
        grid: Values in descending order, equally spaced, shape (M,).
        f: Values of the particles, shape (N,).
        first: Index in the grid of the middle of the first group. Printed is 2: the group of the second value is
            missing, contrary to the rule in the paper; 1 is the corrected value.

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
    """Branch to children, shape (M, N), weigh and prune; return all particles, and those for the next step."""
    M = len(children)
    f = children.ravel()
    x = np.tile(cloud.x, M) + step.gamma[:, None] * (f - np.tile(cloud.f, M))
    nu = y[:, None] - H @ x
    # Eq. (17); as printed without the previous weight.
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


_LOG_PRIOR: Final = np.log([[1.0 / 6.0], [4.0 / 6.0], [1.0 / 6.0]])
_OFFSETS: Final = np.array([[-1.0], [0.0], [1.0]])
_KAPPA: Final = 0.2
_SHRUNK: Final = math.sqrt(1.0 - _KAPPA**2)
_MAX_SPREAD: Final = 2.0


class LinearGroupCloud(NamedTuple):
    """Rates f [1], shape (N,), their mean and variance; means of x given f, shape (n, N), their regression on f.

    Its steps are those of :mod:`trainid_ros.brake_rate.m_algorithm` for one stratum of any linear state.
    """

    f: Array
    x: Array
    mean: float
    variance: float
    slope: Array

    def predicted(self, step: LinearStep) -> LinearGroupCloud:
        """Predict over a step with constant f, eq. (14)."""
        return self._replace(x=step.predict(self.x, self.f), slope=step.Phi @ self.slope + step.gamma)

    def learned(
        self, step: LinearStep, fix: Correction, H: Array, y: Array, walk: float, largest: float, uniform: float
    ) -> LinearGroupCloud:
        """Branch, weigh and prune predicted particles; ``walk`` is the variance q dt [1]."""
        kernel = _KAPPA**2 * self.variance
        c = step.gamma + kernel / (walk + kernel) * (self.slope - step.gamma)
        moved = (_SHRUNK - 1.0) * (self.f - self.mean)
        off = _OFFSETS * math.sqrt(3.0 * (walk + kernel)) * np.ones(len(moved))
        f = (self.f + moved + off).ravel()
        x = np.tile(self.x + self.slope[:, None] * moved, 3) + c[:, None] * off.ravel()
        nu = y[:, None] - H @ x
        logs = (_LOG_PRIOR - 0.5 * distance(fix.W, nu).reshape(3, -1)).ravel()
        w = normal_weights(np.where((f < 0.0) | (f > largest), -np.inf, logs))
        x = x + fix.K @ nu
        # The moments before pruning are those of the survivors.
        mean, middle = float(f @ w), x @ w
        variance = float(np.square(f - mean) @ w)
        slope = (x - middle[:, None]) @ (w * (f - mean)) / variance
        order = f.argsort(kind='stable')
        kept = order[systematic(w[order], len(self.f), uniform)]
        around = f[kept] - f[kept].mean()
        matched = mean + min(math.sqrt(variance / float(np.square(around).mean())), _MAX_SPREAD) * around
        states = x[:, kept] + slope[:, None] * (matched - f[kept])
        states += (middle - states.mean(axis=1))[:, None]
        return LinearGroupCloud(matched, states, mean, variance, slope)
