# SPDX-License-Identifier: Apache-2.0
"""Parameters that follow steps and forget nothing else.

Forgetting factors buy speed after a step with noise at all other times. Here one long memory (multi-innovation
least squares) runs beside a few hypotheses, each of which supposes that the parameters stepped when it was born: it
started from the long memory of that time, with the variance of a step added. Each keeps the score of its predictions
against those of the long memory: the logarithm of a Bayes factor. The estimate is the mixture of all by their
probability; as soon as the long memory has none left, the likeliest hypothesis takes its place.
This is Bayesian detection of change points (Adams and MacKay 2007) with few run lengths.

The long memory is that of :mod:`multi_innovation`, for n parameters: with information I = [P^-1 | P^-1 theta],

    I(t) = I(t-1) + sum_{i=t-p+1..t} phi(i) [phi(i)', y(i)] / (p R(i)).

Outliers fade for each by its own prediction, so a burst that tempts a young hypothesis does not reach the memory;
hypotheses count only after some ``patience``, longer than bursts. A step so large that none follows shows by
weights that stay low: then a robust fit of the latest observations begins a new memory.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.core.state_validation import is_covariance_matrix
from trainid_ros.resistance.normal import (
    Normal,
    information_in,
    information_of,
    mixed,
    normal_of,
    soft_update,
    widened,
)
from trainid_ros.resistance.robust import weigh
from trainid_ros.resistance.robust_fit import LEAST_ROWS, robust_fit

if TYPE_CHECKING:
    from trainid_ros.resistance.normal import Array

# Odds against the long memory at which it is given up.
_GIVEN_UP: Final = math.log(1e3)
# Mean weight of the observations below which the long memory is locked out.
_LOCKED_OUT: Final = 0.4
# Scores beyond this decide all the same.
_MOST_EVIDENCE: Final = 300.0


@dataclass(frozen=True, slots=True)
class ChangePointConfig:
    """How steps are looked for.

    Attributes:
        p: Innovation length of the long memory.
        outliers: Share of observations that may be anything.
        step_variances: Variances that a step adds to the n parameters; 0 for those that do not step.
        hazard: Probability of a step at each observation.
        spacing: Observations between the births of two hypotheses.
        hypotheses: Most hypotheses at a time.
        patience: Observations after which a hypothesis counts.
        lockout: Observations over which weights are averaged to notice a lock-out, and kept for a new beginning.

    """

    p: int
    outliers: float
    step_variances: tuple[float, ...]
    hazard: float
    spacing: int
    hypotheses: int
    patience: int
    lockout: int


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """The parameters if they stepped ``age`` observations ago, and the log Bayes factor against the long memory."""

    normal: Normal
    evidence: float = 0.0
    age: int = 0


@dataclass(frozen=True, slots=True)
class RunLengthState:
    """A hypothesis in numbers: theta, n, and P row by row, n n."""

    theta: tuple[float, ...]
    P: tuple[float, ...]
    evidence: float
    age: int

    def is_valid(self, n: int) -> bool:
        """True if its finite numbers are those of n parameters and within their bounds."""
        sized = len(self.theta) == n and len(self.P) == n * n
        return (
            sized
            and is_covariance_matrix(np.array(self.P).reshape(n, n))
            and self.evidence <= _MOST_EVIDENCE
            and self.age >= 0
        )


@dataclass(frozen=True, slots=True)
class ChangePointState:
    """All that a tracker remembers; ``memory`` and ``parts`` are information, n (n + 1) numbers row by row each.

    Attributes:
        memory: Information of the long memory.
        parts: What the last p observations add to it at a step.
        hypotheses: Oldest first.
        rows: The latest observations: phi, y, R, slow.
        mean_weight: Of the observations of late.
        count: Number of observations.
        steps_found: How often the parameters were found to have stepped.

    """

    memory: tuple[float, ...]
    parts: tuple[tuple[float, ...], ...]
    hypotheses: tuple[RunLengthState, ...]
    rows: tuple[tuple[float, ...], ...]
    mean_weight: float
    count: int
    steps_found: int

    def is_valid(self, n: int) -> bool:
        """True if all its parts, finite ones, fit n parameters and are within their bounds."""
        size = n * (n + 1)
        if not all(len(item) == size for item in (self.memory, *self.parts)):
            return False
        information = _information(self.memory, n)
        after = sum((_information(part, n) for part in self.parts), information)
        definite = is_definite(information) and is_definite(after)
        # (phi, y, R, slow)
        observed = all(len(row) == n + 3 and min(row[-2:]) > 0.0 for row in self.rows)
        counted = 0.0 <= self.mean_weight <= 1.0 and self.count >= 0
        return definite and observed and counted and all(item.is_valid(n) for item in self.hypotheses)


class Tracker:
    """Estimate of n parameters theta of y = phi' theta + noise, observation by observation.

    Attributes:
        estimate: Mixture of the long memory and the hypotheses.
        steps_found: How often the parameters were found to have stepped.
        change_probability: Probability that they stepped since the long memory began, below 0.001 when settled.

    """

    def __init__(self, prior: Normal, plan: ChangePointConfig) -> None:
        self.plan = plan
        self.prior = prior
        self._steps = np.array(plan.step_variances)
        self._log_hazard = math.log(plan.hazard * plan.spacing)
        self.reset()

    def reset(self) -> None:
        """Go back to the prior."""
        self.restore(ChangePointState(_numbers(information_of(self.prior)), (), (), (), 1.0, 0, 0))

    def state(self) -> ChangePointState:
        """Return all that is remembered."""
        return ChangePointState(
            memory=_numbers(self._memory),
            parts=tuple(map(_numbers, self._parts)),
            hypotheses=tuple(map(_hypothesis_state, self._hypotheses)),
            rows=tuple(self._rows),
            mean_weight=self._mean_weight,
            count=self._count,
            steps_found=self.steps_found,
        )

    def restore(self, state: ChangePointState) -> None:
        """Take over what was remembered."""
        n, plan = len(self.prior.theta), self.plan
        self._set_memory(_information(state.memory, n))
        self._parts = deque((_information(part, n) for part in state.parts), maxlen=plan.p)
        self._hypotheses = [_hypothesis(item) for item in state.hypotheses]
        self._rows = deque(state.rows, maxlen=plan.lockout)
        self._mean_weight = state.mean_weight
        self._count, self.steps_found = state.count, state.steps_found
        self._mix()

    def begin(self, normal: Normal) -> None:
        """Start a new long memory from a distribution; hypotheses beside the old one go."""
        self._set_memory(information_of(normal))
        self._parts.clear()
        self._hypotheses = []
        self._mean_weight = 1.0
        self._mix()

    def _set_memory(self, information: Array) -> None:
        self._memory = information
        self._long = normal_of(information)

    def update(self, phi: Array, y: float, R: float, slow: float = 1.0) -> float:
        """Take in one observation y = phi' theta + noise; return its weight in the long memory.

        Args:
            phi: Regressor, shape (n,).
            y: Observation.
            R: Variance of the noise.
            slow: How many times R an observation counts in the mean of many; 1 if the noise is white.

        """
        plan, long = self.plan, self._long
        if self._count % plan.spacing == 0 and self._count > 0:
            self._bear()
        self._count += 1
        self._rows.append((*phi.tolist(), y, R, slow))
        expected, variance = long.predict(phi)
        weight, score = weigh(y - expected, variance + R, R, plan.outliers)
        self._parts.append(information_in(phi, y, plan.p * slow * R) * weight)
        self._set_memory(sum(self._parts, self._memory))
        self._follow(phi, y, R, slow, score)
        self._mean_weight += (weight - self._mean_weight) / plan.lockout
        if self._mean_weight < _LOCKED_OUT:
            self._begin_anew()
        self._mix()
        return weight

    def widen(self, variances: Array, most: Array) -> None:
        """Let the parameters have wandered, see :func:`normal.widened`."""
        self._set_memory(information_of(widened(self._long, variances, most)))
        self._hypotheses = [replace(item, normal=widened(item.normal, variances, most)) for item in self._hypotheses]
        self._mix()

    def _bear(self) -> None:
        """Add a hypothesis; where there is no room, the one that the evidence speaks against most goes."""
        if not self.plan.hypotheses:
            return
        if len(self._hypotheses) >= self.plan.hypotheses:
            evidence = [item.evidence for item in self._hypotheses]
            del self._hypotheses[evidence.index(min(evidence))]
        self._hypotheses.append(Hypothesis(widened(self._long, self._steps)))

    def _follow(self, phi: Array, y: float, R: float, slow: float, score: float) -> None:
        """Let all hypotheses learn, and count what they predicted better; the likeliest may take over."""
        best, most = None, _GIVEN_UP - self._log_hazard
        for i, item in enumerate(self._hypotheses):
            normal, _, found = soft_update(item.normal, phi, y, R, slow, self.plan.outliers)
            # Correlated noise says the same thing several times.
            evidence = min(item.evidence + (found - score) / max(slow, 1.0), _MOST_EVIDENCE)
            self._hypotheses[i] = Hypothesis(normal, evidence, item.age + 1)
            if item.age >= self.plan.patience and evidence > most:
                best, most = self._hypotheses[i], evidence
        if best is not None:
            self._take_over(best)

    def _take_over(self, chosen: Hypothesis) -> None:
        younger = [item for item in self._hypotheses if item.age < chosen.age]
        self.begin(chosen.normal)
        self._hypotheses = [replace(item, evidence=item.evidence - chosen.evidence) for item in younger]
        self.steps_found += 1

    def _begin_anew(self) -> None:
        """Most observations contradict the memory: learn from the latest alone, if they agree among themselves."""
        if len(self._rows) < LEAST_ROWS:
            return
        fit = robust_fit(tuple(self._rows), self._restart())
        if fit is not None:
            self.begin(fit)
            self.steps_found += 1

    def _restart(self) -> Normal:
        """Return what a new beginning starts from: the prior of what steps, and what is known of the rest."""
        stepping = self._steps > 0.0
        theta = np.where(stepping, self.prior.theta, self._long.theta)
        P = np.where(np.outer(stepping, stepping), self.prior.P, 0.0)
        P += np.where(np.outer(~stepping, ~stepping), self._long.P, 0.0)
        return Normal(theta, P)

    def _mix(self) -> None:
        """Weigh all by their probability."""
        normals, odds = [self._long], [1.0]
        for item in self._hypotheses:
            if item.age > self.plan.patience and item.evidence + self._log_hazard > -_GIVEN_UP:
                normals.append(item.normal)
                odds.append(math.exp(item.evidence + self._log_hazard))
        self.change_probability = 1.0 - 1.0 / math.fsum(odds)
        self.estimate = mixed(normals, odds) if len(normals) > 1 else self._long


def is_definite(information: Array) -> bool:
    """True if P^-1, the left part of an information of shape (n, n + 1), is the inverse of a covariance."""
    inverse, variances = information[:, :-1], information.diagonal()
    if not bool((variances > 0.0).all()):
        return False
    scale = 1.0 / np.sqrt(variances)
    correlations = scale[:, None] * inverse * scale
    symmetric = np.allclose(correlations, correlations.T, rtol=0.0, atol=1e-6)
    return bool(symmetric and np.linalg.eigvalsh(correlations)[0] > 0.0)


def _numbers(item: Array) -> tuple[float, ...]:
    return tuple(item.ravel().tolist())


def _information(numbers: tuple[float, ...], n: int) -> Array:
    return np.array(numbers).reshape(n, n + 1)


def _hypothesis_state(item: Hypothesis) -> RunLengthState:
    return RunLengthState(_numbers(item.normal.theta), _numbers(item.normal.P), item.evidence, item.age)


def _hypothesis(state: RunLengthState) -> Hypothesis:
    n = len(state.theta)
    return Hypothesis(Normal(np.array(state.theta), np.array(state.P).reshape(n, n)), state.evidence, state.age)
