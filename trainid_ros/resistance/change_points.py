# SPDX-License-Identifier: Apache-2.0
"""Estimation of n parameters theta of y = phi' theta + noise that follows steps without forgetting between them.

A normal distribution has two forms: mean and covariance P; and the information I = [P^-1 | P^-1 theta], shape
(n, n + 1), in which independent observations add. The long memory is multi-innovation least squares, [9] and [10] at
the head of :mod:`vmils`:

    I(t) = I(t-1) + sum_{i=t-p+1..t} phi(i) [phi(i)', y(i)] / (p R(i)).

A forgetting factor responds to a step faster at the price of more noise at all other times. Here a few run-length
hypotheses run beside the long memory, Bayesian change-point detection (Adams and MacKay 2007) with few run lengths.
Each assumes that the parameters stepped when it was created: it starts from the long memory with the variance of a step
added, and accumulates the log Bayes factor of its predictions against those of the long memory. The estimate is the
mixture of all, weighted by their probability. Once the long memory has negligible probability, the most likely
hypothesis replaces it.

The covariance of the mixture knows of no step that the data do not show yet. In the stated one, about the same mean,
the long memory is replaced by a walk: the parameters as if they stepped all the time, with the mean square of the
steps. Hypotheses have its covariance once theirs is smaller, since after one step there may be another, and more
weight, since both outcomes must be covered while a step is suspected.

An observation is good with probability 1 - eps; otherwise it is uniformly distributed over a width of
``OUTLIER_WIDTH`` standard deviations. Its weight is the posterior probability that it is good. A hard gate could not
recover from a wrong estimate. Each hypothesis weights outliers by its own prediction, and counts only after ``min_age``
observations, longer than a burst of them.

A step so large that no hypothesis follows it shows in weights that stay low. The long memory then restarts from a
robust fit of the latest observations: least trimmed squares finds the 55 % that agree best, by concentration steps from
many small subsets (Rousseeuw and Van Driessen 2006), and least squares is fitted to all observations near it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.state import State, declare, definite, several
from trainid_ros.interface.vectors import append, i64, vec

Array = NDArray[np.float64]

OUTLIER_WIDTH: Final = 40.0  # range of outliers [standard deviations]
_ROOT_2PI: Final = math.sqrt(2.0 * math.pi)
# Beyond 37 standard deviations the density of a good observation underflows.
_MAX_NIS: Final = 1400.0
_MIN_WEIGHT: Final = 1e-9


def weigh(nu: float, S: float, R: float, eps: float) -> tuple[float, float]:
    """Return the weight of an observation and the logarithm of its likelihood.

    Its innovation nu [N/kN] has the variance S if it is good. The variance R of its noise [(N/kN)^2] sets the width of
    the density of outliers, whose share is eps [1].
    """
    nis = nu * nu / S
    good = (1.0 - eps) / (_ROOT_2PI * math.sqrt(S)) * math.exp(-0.5 * nis) if nis < _MAX_NIS else 0.0
    likelihood = good + eps / (OUTLIER_WIDTH * math.sqrt(R)) + 1e-300
    return good / likelihood, math.log(likelihood)


def gate(eps: float) -> float:
    """Return the innovation, in standard deviations, at which an observation is good with probability 1/2."""
    return math.sqrt(2.0 * math.log((1.0 - eps) * OUTLIER_WIDTH / (eps * _ROOT_2PI))) if eps > 0.0 else math.inf


class Normal:
    """Normal distribution of n parameters.

    Attributes:
        mean: theta, n numbers.
        covariance: P, n^2 numbers, row by row.
    """

    STATE: ClassVar[State] = declare('mean', definite('covariance'))

    def __init__(self, mean: vec[float], covariance: vec[float]) -> None:
        self.mean, self.covariance = mean, covariance

    @property
    def theta(self) -> Array:
        """The mean as an array, shape (n,)."""
        return np.array(list(self.mean))

    @property
    def P(self) -> Array:
        """The covariance as an array, shape (n, n)."""
        return np.array(list(self.covariance)).reshape(len(self.mean), len(self.mean))

    def predict(self, phi: vec[float]) -> tuple[float, float]:
        """Return mean and variance of phi' theta, in the unit of y and its square, for n regressors."""
        return dot(phi, self.mean), max(dot(phi, _times(self.covariance, phi)), 0.0)


def normal(theta: Array, P: Array) -> Normal:
    """Return the distribution with a mean of shape (n,) and a covariance of shape (n, n)."""
    return Normal(vec[float](theta.tolist()), vec[float](P.ravel().tolist()))


def independent(theta: Sequence[float], variances: Sequence[float]) -> Normal:
    """Return the distribution of independent parameters with these means and variances."""
    return normal(np.array(theta, dtype=np.float64), np.diag(np.array(variances, dtype=np.float64)))


def dot(x: vec[float], y: vec[float]) -> float:
    """Return x' y."""
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


def _times(P: vec[float], x: vec[float]) -> vec[float]:
    """Return P x."""
    n, product = len(x), vec[float]()
    k: i64 = 0
    for _ in range(n):
        total = 0.0
        for j in range(n):
            total += P[k] * x[j]
            k += 1
        product = append(product, total)
    return product


def inflated(item: Normal, variances: Array, limits: Array | None = None) -> Normal:
    """Return the distribution after random steps of these variances, up to limits, both of shape (n,).

    Limiting keeps the correlations.
    """
    P = item.P + np.diag(variances)
    if limits is not None:
        r = np.minimum(1.0, np.sqrt(limits / np.diag(P)))
        P = r[:, None] * P * r
    return normal(item.theta, P)


def soft_update(
    item: Normal, phi: vec[float], y: float, R: float, slow: float, eps: float
) -> tuple[Normal, float, float]:
    """Return the distribution after one observation, the weight of the observation and its log likelihood.

    The arguments are those of :meth:`Tracker.update`; the share of outliers ``eps`` is 0 for plain least squares.
    """
    g = _times(item.covariance, phi)
    variance = dot(phi, g)
    nu = y - dot(phi, item.mean)
    weight, log_likelihood = weigh(nu, variance + R, R, eps)
    if weight < _MIN_WEIGHT:
        return item, weight, log_likelihood
    # [11] eqs. (9)-(11): theta += K nu, P -= g g' / (phi' P phi + slow R / weight); the weight divides the variance
    gain = 1.0 / (variance + slow * R / weight)
    theta, P = item.mean[:], item.covariance[:]
    k: i64 = 0
    for i in range(len(phi)):
        theta[i] += gain * nu * g[i]
        for j in range(len(phi)):
            P[k] -= gain * (g[i] * g[j])
            k += 1
    return Normal(theta, P), weight, log_likelihood


def mixed(items: list[Normal], weights: list[float], stated: list[float] | None = None) -> Normal:
    """Return mean and covariance of a mixture; its weights need not sum to one.

    ``stated`` are other weights for the covariance, which is about the mean by the first ones.
    """
    n, total, spread = len(items[0].mean), math.fsum(weights), weights if stated is None else stated
    all_spread = math.fsum(spread)
    theta, apart, P = vec[float]([0.0] * n), vec[float]([0.0] * n), vec[float]([0.0] * (n * n))
    for item, weight in zip(items, weights, strict=True):
        for i in range(n):
            theta[i] += weight / total * item.mean[i]
    for item, weight in zip(items, spread, strict=True):
        share = weight / all_spread
        k: i64 = 0
        for i in range(n):
            apart[i] = item.mean[i] - theta[i]
        for i in range(n):
            for j in range(n):
                P[k] += share * (item.covariance[k] + apart[i] * apart[j])
                k += 1
    return Normal(theta, P)


def information_of(item: Normal) -> vec[float]:
    """Return [P^-1 | P^-1 theta], n rows of n + 1 numbers."""
    inverse, information = _inverse(item.covariance, len(item.mean)), vec[float]()
    k: i64 = 0
    vector = _times(inverse, item.mean)
    for i in range(len(vector)):
        for _ in range(len(vector)):
            information = append(information, inverse[k])
            k += 1
        information = append(information, vector[i])
    return information


def normal_of(information: vec[float], n: i64) -> Normal:
    """Return the distribution of n parameters with an information [P^-1 | P^-1 theta]."""
    inverse, vector = vec[float](), vec[float]()
    k: i64 = 0
    for _ in range(n):
        for _ in range(n):
            inverse = append(inverse, information[k])
            k += 1
        vector = append(vector, information[k])
        k += 1
    P = _inverse(inverse, n)
    return Normal(_times(P, vector), P)


def information_in(phi: vec[float], y: float, variance: float, weight: float = 1.0) -> vec[float]:
    """Return the information of one observation, phi [phi', y] weight / variance, n rows of n + 1 numbers."""
    information = vec[float]()
    for i in range(len(phi)):
        for j in range(len(phi)):
            information = append(information, phi[i] * phi[j] / variance * weight)
        information = append(information, phi[i] * y / variance * weight)
    return information


def _inverse(S: vec[float], n: i64) -> vec[float]:
    """Return the inverse of a positive definite matrix of n rows by Gauss-Jordan elimination, without pivoting."""
    # Scaled to a unit diagonal, since the parameters differ by orders of magnitude.
    scale, A = vec[float](), S[:]
    for i in range(n):
        scale = append(scale, 1.0 / math.sqrt(S[i * n + i]))
    for i in range(n):
        for j in range(n):
            A[i * n + j] *= scale[i] * scale[j]
    for k in range(n):
        pivot = 1.0 / A[k * n + k]
        A[k * n + k] = 1.0
        for j in range(n):
            A[k * n + j] *= pivot
        for i in range(n):
            factor = A[i * n + k]
            if i != k:
                A[i * n + k] = 0.0
                for j in range(n):
                    A[i * n + j] -= factor * A[k * n + j]
    inverse = A[:]
    for i in range(n):
        for j in range(n):
            inverse[i * n + j] = 0.5 * scale[i] * (A[i * n + j] + A[j * n + i]) * scale[j]
    return inverse


# Share of the observations that agree, and the quantile of |z| of a unit normal at that share.
_AGREEING, _AGREEING_Z = 0.55, 0.7554
# Least trimmed squares: number and size of the subsets, and concentration steps from each.
_STARTS, _SUBSET, _CONCENTRATIONS = 60, 4, 12
# Inlier threshold [standard deviations], and the standard deviation of a unit normal truncated at +-2.5.
_INLIER_STDS, _TRUNCATED_STD = 2.5, 0.9497
# Rounds of least squares near the trimmed fit.
_ROUNDS: Final = 10


def robust_fit(rows: tuple[tuple[float, ...], ...], prior: Normal) -> Normal | None:
    """Return the posterior of the parameters from the rows that agree, or None if fewer than half of them do.

    A row has the n entries of phi, then y, R and slow, see :meth:`Tracker.update`.
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
# Mean weight of the observations below which the long memory is locked out, and the fewest from which it restarts.
_MIN_MEAN_WEIGHT: Final = 0.4
_MIN_ROWS: Final = 12
# Limit of the log Bayes factor, far beyond any decision threshold.
_MAX_EVIDENCE: Final = 300.0


@dataclass(frozen=True, slots=True)
class ChangePointConfig:
    """Settings of the change-point detection."""

    p: int  # Innovation length of the long memory
    outliers: float  # Share of outliers
    step_variances: tuple[float, ...]  # Variances that a step adds to the n parameters; 0 for those that do not step
    hazard: float  # Probability of a step at each observation
    min_age: int  # Number of observations after which a hypothesis counts
    spacing: int = 6  # Number of observations between the creation of two hypotheses
    hypotheses: int = 5  # Maximum number of hypotheses
    # Number of observations whose weights show a lock-out, and from which the long memory then restarts
    lockout: int = 30
    # Factor on the weight of the hypotheses in the stated covariance, while they weigh less than the walk
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
        stated: The same mean with the covariance to be published, of walk and hypotheses.
        walk: The parameters if they step all the time, as :meth:`inflate_variance` says.
        steps_found: Number of detected steps.
        change_probability: Probability of a step since the long memory began [1], below 0.001 when settled.
    """

    STATE: ClassVar[State] = declare(
        '_memory', 'walk', several('_parts', _no_numbers), several('_hypotheses', _blank), '_rows', '_mean_weight',
        '_count', 'steps_found',
    )  # fmt: skip

    def __init__(self, prior: Normal, plan: ChangePointConfig) -> None:
        self.plan = plan
        self.prior = prior
        self._steps = np.array(plan.step_variances)
        self._log_hazard = math.log(plan.hazard * plan.spacing)
        self.reset()

    def reset(self) -> None:
        """Return to the prior."""
        self._memory, self.walk = information_of(self.prior), self.prior
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
        self.walk = normal
        self._parts.clear()
        self._hypotheses = []
        self._mean_weight = 1.0
        self._mix()

    def _set_memory(self, information: vec[float]) -> None:
        self._memory = information
        self._long = normal_of(information, len(self.prior.mean))

    def update(self, phi: vec[float], y: float, R: float, slow: float = 1.0) -> float:
        """Process one observation y = phi' theta + noise of the variance R; return its weight in the long memory.

        ``slow`` is the factor on R in the mean of many observations with correlated noise; 1 if the noise is white.
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
        self.walk, _, _ = soft_update(self.walk, phi, y, R, slow, plan.outliers)
        # [11], [12]
        self._follow(phi, y, R, slow, score)
        self._mean_weight += (weight - self._mean_weight) / plan.lockout
        # [13]
        if self._mean_weight < _MIN_MEAN_WEIGHT:
            self._restart_from_latest()
        self._mix()
        return weight

    def inflate_variance(self, variances: Array, limits: Array, steps: float = 0.0) -> None:
        """Add the variances of random steps of the parameters, see :func:`inflated`.

        The walk also steps as configured; ``steps`` is the mean number of these steps.
        """
        self._set_memory(information_of(inflated(self._long, variances, limits)))
        self.walk = inflated(self.walk, variances + steps * self._steps, limits)
        for item in self._hypotheses:
            item.normal = inflated(item.normal, variances, limits)
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
        for item in self._hypotheses:
            item.normal, _, found = soft_update(item.normal, phi, y, R, slow, self.plan.outliers)
            # Observations with correlated noise carry repeated evidence.
            item.evidence = min(item.evidence + (found - score) / max(slow, 1.0), _MAX_EVIDENCE)
            item.age += 1
            if item.age > self.plan.min_age and item.evidence > most:
                best, most = item, item.evidence
        if best is not None:
            younger = [item for item in self._hypotheses if item.age < best.age]
            self.begin(best.normal)
            self._hypotheses = younger
            for item in younger:
                item.evidence -= best.evidence
            self.steps_found += 1

    def _restart_from_latest(self) -> None:
        """Restart from the latest observations, which contradict the long memory, if most of them agree."""
        if len(self._rows) < _MIN_ROWS:
            return
        # Parameters that step have their initial prior, the rest that of the long memory.
        stepping = self._steps > 0.0
        theta = np.where(stepping, self.prior.theta, self._long.theta)
        P = np.where(np.outer(stepping, stepping), self.prior.P, 0.0)
        P += np.where(np.outer(~stepping, ~stepping), self._long.P, 0.0)
        fit = robust_fit(tuple(self._rows), normal(theta, P))
        if fit is not None:
            self.begin(fit)
            self.steps_found += 1

    def _spread(self, item: Normal) -> float:
        """Return the sum of the variances of the parameters that step, relative to those of one step [1]."""
        steps, n = self.plan.step_variances, len(item.mean)
        return math.fsum(item.covariance[k * n + k] / steps[k] for k in range(n) if steps[k] > 0.0)

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
        suspected = math.fsum(odds[1:])
        self.estimate = mixed(normals, odds) if suspected else self._long
        weight = min(self.plan.step_weight, max(1.0, 1.0 / suspected)) if suspected else 1.0
        # Parameters that stepped once may step again, so an old hypothesis has the covariance of the walk.
        walked, W = self._spread(self.walk), self.walk.covariance
        wide = [one if self._spread(one) > walked else Normal(one.mean, W) for one in normals[1:]]
        others = [1.0, *[weight * x for x in odds[1:]]]
        self.stated = mixed([self.estimate, self.walk, *wide], [1.0, *[0.0] * len(others)], [0.0, *others])
