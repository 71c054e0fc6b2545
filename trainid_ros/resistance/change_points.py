# SPDX-License-Identifier: Apache-2.0
"""Parameter estimation that follows steps without forgetting between them.

A forgetting factor responds to a step faster at the price of more noise at all other times. Here one long-memory
estimate (multi-innovation least squares) runs beside a few run-length hypotheses. Each assumes that the parameters
stepped when it was created: it starts from the long-memory estimate of that time with the variance of a step added,
and accumulates the log Bayes factor of its predictions against those of the long memory. The estimate is the
mixture of all, weighted by their probability; the stated covariance weights the hypotheses more, since it must cover
both outcomes while a step is suspected. Once the long memory has negligible probability, the most likely
hypothesis replaces it. This is Bayesian change-point detection (Adams and MacKay 2007) with few run lengths.

The long memory is multi-innovation least squares, [9] and [10] at the head of :mod:`vmils`, for n parameters: with
information I = [P^-1 | P^-1 theta],

    I(t) = I(t-1) + sum_{i=t-p+1..t} phi(i) [phi(i)', y(i)] / (p R(i)).

Each hypothesis weights outliers by its own prediction, so a burst that a young hypothesis follows does not affect the
long memory. Hypotheses count only after ``min_age`` observations, longer than a burst. A step so large that no
hypothesis follows it shows in weights that stay low; the long memory then restarts from a robust fit of the latest
observations.

A robust batch fit of y = phi' theta, insensitive to up to 45 % outliers, starts an estimate from bad data and restarts
one that has diverged. Least trimmed squares finds the 55 % of
the observations that agree best, by concentration steps from many small subsets (Rousseeuw and Van Driessen 2006);
least squares over all observations near that fit gives the estimate.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from trainid_ros.interface.state import State, declare, several
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.normal import (
    Array,
    Normal,
    inflated,
    information_in,
    information_of,
    mixed,
    normal,
    normal_of,
    soft_update,
    weigh,
)

MIN_ROWS: Final = 12
"""Smallest number of rows to fit."""
_AGREEING: Final = 0.55
_STARTS, _SUBSET = 60, 4
_CONCENTRATIONS: Final = 12
# Inlier threshold [standard deviations], and the standard deviation of a unit normal truncated at +-2.5.
_INLIER_STDS, _TRUNCATED_STD = 2.5, 0.9497
# Quantile of |z| of a unit normal at the agreeing share of 55 %.
_AGREEING_Z: Final = 0.7554
_ROUNDS: Final = 10


def robust_fit(rows: tuple[tuple[float, ...], ...], prior: Normal) -> Normal | None:
    """Return the posterior of the parameters from the rows that agree, or None if fewer than half of them do.

    Args:
        rows: Rows of the n entries of the regressor phi, the observation y, its noise variance R, and the factor on
            R in the mean of many observations.
        prior: Prior distribution of the n parameters.
    """
    table = np.array(rows)
    root = np.sqrt(table[:, -2])
    Phi, y = table[:, :-3] / root[:, None], table[:, -3] / root
    before = np.array(list(information_of(prior))).reshape(-1, len(prior.mean) + 1)
    information, vector = before[:, :-1], before[:, -1]
    theta, scale = _trimmed(Phi, y, information, vector)
    for _ in range(_ROUNDS):
        near = np.abs(y - Phi @ theta) < _INLIER_STDS * scale
        if np.mean(near) < 0.5:
            return None
        theta = _ridge(Phi[near], y[near], information * scale**2, vector * scale**2)
        scale = max(1.0, float(np.std(y[near] - Phi[near] @ theta)) / _TRUNCATED_STD)
    weights = near / (table[:, -1] * scale**2)
    P = np.linalg.inv(information + Phi.T @ (weights[:, None] * Phi))
    if not (np.isfinite(theta).all() and np.isfinite(P).all()):
        return None
    return normal(theta, P)


def _trimmed(Phi: Array, y: Array, information: Array, vector: Array) -> tuple[Array, float]:
    """Return the parameters of least trimmed squares and the scale of the agreeing residuals, at least 1."""
    generator = np.random.default_rng(0)
    count = round(_AGREEING * len(y))
    best, least = np.zeros(Phi.shape[1]), np.inf
    for _ in range(_STARTS):
        kept = generator.choice(len(y), _SUBSET, replace=False)
        for _ in range(_CONCENTRATIONS):
            theta = _ridge(Phi[kept], y[kept], information, vector)
            residuals = np.abs(y - Phi @ theta)
            kept = np.argpartition(residuals, count - 1)[:count]
        cost = float(np.sum(residuals[kept] ** 2))
        if cost < least:
            best, least = theta, cost
    residuals = np.sort(np.abs(y - Phi @ best))
    return best, max(1.0, float(residuals[count - 1]) / _AGREEING_Z)


def _ridge(Phi: Array, y: Array, information: Array, vector: Array) -> Array:
    return np.asarray(np.linalg.solve(information + Phi.T @ Phi, vector + Phi.T @ y), dtype=np.float64)


# Log odds of a hypothesis against the long memory from which it replaces the long memory [1].
_TAKEOVER_LOG_ODDS: Final = math.log(1e3)
# Mean weight of the observations below which the long memory is locked out.
_MIN_MEAN_WEIGHT: Final = 0.4
# Limit of the log Bayes factor, far beyond any decision threshold.
_MAX_EVIDENCE: Final = 300.0


@dataclass(frozen=True, slots=True)
class ChangePointConfig:
    """Settings of the change-point detection."""

    p: int  # Innovation length of the long memory
    outliers: float  # Share of outliers
    step_variances: tuple[float, ...]  # Variances that a step adds to the n parameters; 0 for those that do not step
    hazard: float  # Probability of a step at each observation
    spacing: int  # Number of observations between the creation of two hypotheses
    hypotheses: int  # Maximum number of hypotheses
    min_age: int  # Number of observations after which a hypothesis counts
    # Number of observations over which weights are averaged to detect a lock-out, and from which the long memory then
    # restarts
    lockout: int
    # Factor on the weight of the hypotheses in the stated covariance, while they weigh less than the long memory
    step_weight: float = 1.0


class RunLengthHypothesis:
    """The parameters if they stepped ``age`` observations ago, and the log Bayes factor against the long memory."""

    STATE: ClassVar[State] = declare('normal', 'evidence', 'age')

    def __init__(self, normal: Normal, evidence: float = 0.0, age: int = 0) -> None:
        self.normal, self.evidence, self.age = normal, evidence, age


def _blank() -> RunLengthHypothesis:
    """Return a hypothesis to be restored."""
    return RunLengthHypothesis(Normal(vec[float](), vec[float]()))


def _no_numbers() -> vec[float]:
    return vec[float]()


class Tracker:
    """Recursive estimate of the n parameters theta of y = phi' theta + noise.

    Attributes:
        estimate: Mixture of the long memory and the hypotheses.
        stated: The same mean with the covariance to be published, in which hypotheses have more weight.
        steps_found: Number of detected steps.
        change_probability: Probability of a step since the long memory began [1], below 0.001 when settled.
    """

    STATE: ClassVar[State] = declare(
        '_memory', several('_parts', _no_numbers), several('_hypotheses', _blank), '_rows', '_mean_weight', '_count',
        'steps_found',
    )  # fmt: skip

    def __init__(self, prior: Normal, plan: ChangePointConfig) -> None:
        self.plan = plan
        self.prior = prior
        self._steps = np.array(plan.step_variances)
        self._log_hazard = math.log(plan.hazard * plan.spacing)
        self.reset()

    def reset(self) -> None:
        """Return to the prior."""
        self._memory = information_of(self.prior)
        self._parts: list[vec[float]] = []
        self._hypotheses: list[RunLengthHypothesis] = []
        self._rows: deque[tuple[float, ...]] = deque(maxlen=self.plan.lockout)
        self._mean_weight, self._count, self.steps_found = 1.0, 0, 0
        self.refresh()

    def refresh(self) -> None:
        """Calculate what follows from the state."""
        self._set_memory(self._memory)
        self._mix()

    def begin(self, normal: Normal) -> None:
        """Start a new long memory from a distribution and remove all hypotheses."""
        self._set_memory(information_of(normal))
        self._parts.clear()
        self._hypotheses = []
        self._mean_weight = 1.0
        self._mix()

    def _set_memory(self, information: vec[float]) -> None:
        self._memory = information
        self._long = normal_of(information, len(self.prior.mean))

    def update(self, phi: vec[float], y: float, R: float, slow: float = 1.0) -> float:
        """Process one observation y = phi' theta + noise; return its weight in the long memory.

        Args:
            phi: Regressor, n numbers.
            y: Observation.
            R: Variance of the noise.
            slow: Factor on R in the mean of many observations with correlated noise; 1 if the noise is white.
        """
        plan, long = self.plan, self._long
        if self._count % plan.spacing == 0 and self._count > 0:
            self._add_hypothesis()
        self._count += 1
        self._rows.append((*phi, y, R, slow))
        expected, variance = long.predict(phi)
        # [7], [8] V-MILS: a bad observation is weighted down instead of left out of t_s.
        weight, score = weigh(y - expected, variance + R, R, plan.outliers)
        # [9] MILS: the latest p of phi and y, that is Phi(p, t) and Y(p, t).
        self._parts.append(information_in(phi, y, plan.p * slow * R, weight))
        if len(self._parts) > plan.p:
            del self._parts[0]
        # [10] MILS: theta(t), L(t), P(t), in information form.
        information = self._memory[:]
        for part in self._parts:
            for k in range(len(part)):
                information[k] += part[k]
        self._set_memory(information)
        # [11], [12]
        self._follow(phi, y, R, slow, score)
        self._mean_weight += (weight - self._mean_weight) / plan.lockout
        # [13]
        if self._mean_weight < _MIN_MEAN_WEIGHT:
            self._restart_from_latest()
        self._mix()
        return weight

    def inflate_variance(self, variances: Array, limits: Array) -> None:
        """Add the variances of random steps of the parameters, see :func:`normal.inflated`."""
        self._set_memory(information_of(inflated(self._long, variances, limits)))
        self._hypotheses = [
            RunLengthHypothesis(inflated(item.normal, variances, limits), item.evidence, item.age)
            for item in self._hypotheses
        ]
        self._mix()

    def _add_hypothesis(self) -> None:
        """Add a hypothesis; at the maximum number, remove the least likely one first."""
        if not self.plan.hypotheses:
            return
        if len(self._hypotheses) >= self.plan.hypotheses:
            evidence = [item.evidence for item in self._hypotheses]
            del self._hypotheses[evidence.index(min(evidence))]
        self._hypotheses.append(RunLengthHypothesis(inflated(self._long, self._steps)))

    def _follow(self, phi: vec[float], y: float, R: float, slow: float, score: float) -> None:
        """Update all hypotheses and their Bayes factors; the most likely one may replace the long memory."""
        best, most = None, _TAKEOVER_LOG_ODDS - self._log_hazard
        for i, item in enumerate(self._hypotheses):
            normal, _, found = soft_update(item.normal, phi, y, R, slow, self.plan.outliers)
            # Observations with correlated noise carry repeated evidence.
            evidence = min(item.evidence + (found - score) / max(slow, 1.0), _MAX_EVIDENCE)
            self._hypotheses[i] = RunLengthHypothesis(normal, evidence, item.age + 1)
            if item.age >= self.plan.min_age and evidence > most:
                best, most = self._hypotheses[i], evidence
        if best is not None:
            self._take_over(best)

    def _take_over(self, chosen: RunLengthHypothesis) -> None:
        younger = [item for item in self._hypotheses if item.age < chosen.age]
        self.begin(chosen.normal)
        self._hypotheses = [
            RunLengthHypothesis(item.normal, item.evidence - chosen.evidence, item.age) for item in younger
        ]
        self.steps_found += 1

    def _restart_from_latest(self) -> None:
        """Restart from the latest observations, which contradict the long memory, if most of them agree."""
        if len(self._rows) < MIN_ROWS:
            return
        fit = robust_fit(tuple(self._rows), self._restart_prior())
        if fit is not None:
            self.begin(fit)
            self.steps_found += 1

    def _restart_prior(self) -> Normal:
        """Return the prior of a restart: the initial prior for parameters that step, the long memory for the rest."""
        stepping = self._steps > 0.0
        theta = np.where(stepping, self.prior.theta, self._long.theta)
        P = np.where(np.outer(stepping, stepping), self.prior.P, 0.0)
        P += np.where(np.outer(~stepping, ~stepping), self._long.P, 0.0)
        return normal(theta, P)

    def _mix(self) -> None:
        """Update the mixture, weighted by probability."""
        # [14]
        normals, odds = [self._long], [1.0]
        least = -_TAKEOVER_LOG_ODDS - math.log(self.plan.step_weight)
        for item in self._hypotheses:
            if item.age > self.plan.min_age and item.evidence + self._log_hazard > least:
                normals.append(item.normal)
                odds.append(math.exp(item.evidence + self._log_hazard))
        self.change_probability = 1.0 - 1.0 / math.fsum(odds)
        self.estimate = self.stated = self._long
        if len(normals) > 1:
            self.estimate = mixed(normals, odds)
            weight = min(self.plan.step_weight, max(1.0, 1.0 / math.fsum(odds[1:])))
            self.stated = mixed(normals, odds, [1.0, *[weight * x for x in odds[1:]]])
