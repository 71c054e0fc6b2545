# SPDX-License-Identifier: Apache-2.0
"""Bank of change-point hypotheses, each with its own extended Kalman filter.

Hypotheses differ in when a or c last stepped, and in the sizes of gusts and map errors. They are weighted by the
likelihood of the measured speeds. At intervals the most likely one branches into one whose a has just stepped, one
whose c has, and one with other disturbance sizes. The estimate is the mixture of all hypotheses above a minimum age.
This is Bayesian change-point detection (Adams and MacKay 2007) with a bounded number of hypotheses, combined with a
multiple-model estimator of the noise sizes (Blom and Bar-Shalom 1988).

The train file may be overconfident. Therefore half of the hypotheses start from a wide prior with a small weight:
if the data contradict the stated prior they outweigh the others within minutes, otherwise they are pruned.

The stated covariance weights young hypotheses more than the estimate does: while a step is suspected but not yet
confirmed, it must cover both outcomes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, several
from trainid_ros.interface.vectors import i64, vec
from trainid_ros.resistance.davis_posterior import DavisPosterior
from trainid_ros.resistance.speed_states import (
    DELTA,
    KAPPA,
    STATES,
    A,
    B,
    C,
    Interval,
    ProcessNoise,
    SpeedFilter,
    SpeedTransition,
    V,
    entry,
    speed_filter,
)

Array = NDArray[np.float64]

N_PUBLISHED: Final[i64] = 5
"""Number of states whose mixture is published: a, b, c, kappa, delta."""
_INITIAL_AGE_S: Final = 1e9
# Log weight relative to the best hypothesis below which one is pruned.
_PRUNED: Final = -40.0
# Bonus on the log weight of young hypotheses in pruning.
_YOUNG_BONUS: Final = 8.0
# Disturbance sizes count as present while the log weight of a hypothesis with them exceeds this ...
_PRESENT: Final = -6.0
# ... and absent sizes start with this probability.
_OTHER_SIZES: Final = 1e-3
# Factor of the wide prior on the standard deviations of a, b, c and kappa, and its minimum standard deviation of kappa.
_WIDER: Final = 5.0
_WIDE_SCALE_STD: Final = 0.06
_NO_WEIGHT: Final = 1e-200


@dataclass(frozen=True, slots=True)
class BankPlan:
    """Settings of the bank."""

    mean: Array  # Prior mean of the states, shape (9,); that of v is not used
    variance: Array  # Prior variances of the states, shape (9,); those of v, gust and map error are not used
    gust_stds: tuple[float, ...]  # Hypothetical gust standard deviations [N/kN], ascending
    map_stds: tuple[float, ...]  # Hypothetical standard deviations of the map error [N/kN], ascending
    step_variances: tuple[float, float]  # Variances that a step adds to a and to c, (N/kN)^2 and (N/kN per (m/s)^2)^2
    hazard: float  # Probability of a step per second [1/s]
    branch_interval: float  # Driving time between branchings [s]
    hypotheses: int  # Maximum number of hypotheses
    min_age: float  # Minimum age of a hypothesis in the mixture [s]
    young_age: float  # Age up to which a hypothesis is young [s]
    young_weight: float  # Factor on the weight of young hypotheses in the stated covariance [1]
    wrong_prior: float  # Prior odds that the stated prior is too narrow [1]
    drift: Array  # Growth of the variances of the states [per s], shape (9,)
    noise: ProcessNoise  # Process and measurement noise

    @property
    def log_step(self) -> float:
        """Logarithm of the probability of a step of a (or of c) between two branchings."""
        return math.log(0.5 * min(1.0, self.hazard * self.branch_interval))


class Hypothesis:
    """A filter with the logarithm of its weight, its age [s], and the index of its sizes of gusts and map errors."""

    STATE: ClassVar[State] = declare('filter', 'log_weight', 'age', 'size')

    def __init__(self, estimate: SpeedFilter, log_weight: float, age: float, size: int) -> None:
        self.filter = estimate
        self.log_weight, self.age, self.size = log_weight, age, size


def _blank() -> Hypothesis:
    """Return a hypothesis to be restored."""
    return Hypothesis(speed_filter(np.zeros(STATES), np.zeros((STATES, STATES)), 0.0, 0.0), 0.0, 0.0, 0)


class Mixture:
    """Mixture of the published states.

    Attributes:
        mean: a [N/kN], b [N/kN per m/s], c [N/kN per (m/s)^2], kappa [1], delta [s].
        covariance: Upper triangle of their covariance, row by row, 15 numbers.
    """

    def __init__(self, mean: vec[float], covariance: vec[float]) -> None:
        self.mean, self.covariance = mean, covariance

    @property
    def davis(self) -> DavisPosterior:
        """Mean and covariance of a, b, c."""
        x, P = self.mean, self.covariance
        return x[0], x[1], x[2], P[0], P[1], P[2], P[5], P[6], P[9]


class Innovation:
    """Measured minus predicted speed [m/s], its predicted variance [(m/s)^2], and its weight in the best hypothesis."""

    def __init__(self, value: float, variance: float, weight: float) -> None:
        self.value, self.variance, self.weight = value, variance, weight


class Bank:
    """Bank of hypotheses and its recursion.

    Attributes:
        plan: Its settings.
        hypotheses: The hypotheses, in the order of their creation.
        since_s: Driving time since the last branching [s].
        branchings: Number of branchings.
    """

    STATE: ClassVar[State] = declare(several('hypotheses', _blank), 'since_s', 'branchings')

    def __init__(self, plan: BankPlan) -> None:
        self.plan = plan
        # Variances of gust and map error by the index of their sizes.
        self._sizes = [(gust * gust, error * error) for gust in plan.gust_stds for error in plan.map_stds]
        self._drift = vec[float](plan.drift.tolist())
        published = (A, B, C, KAPPA, DELTA)
        self._states = vec[i64](published)
        self._entries = vec[i64]([entry(i, j) for k, i in enumerate(published) for j in published[k:]])
        self.reset()

    def reset(self) -> None:
        """Return to the stated and the wide prior, each with all disturbance sizes."""
        plan = self.plan
        # [1]
        self.hypotheses = [
            self._new(plan.mean, np.diag(variance), math.log(weight), _INITIAL_AGE_S, size)
            for variance, weight in self._priors()
            for size in range(len(self._sizes))
        ]
        self.since_s = 0.0
        self.branchings = 0

    def _priors(self) -> list[tuple[Array, float]]:
        """Return the variances of the stated and the wide prior, shape (9,), and their weights."""
        stated, wide = self.plan.variance, self.plan.variance.copy()
        wide[[A, B, C]] *= _WIDER**2
        wide[KAPPA] = max(_WIDE_SCALE_STD**2, _WIDER**2 * wide[KAPPA])
        return [(stated, 1.0), *([(wide, self.plan.wrong_prior)] if self.plan.wrong_prior > 0.0 else [])]

    def _new(self, mean: Array, covariance: Array, log_weight: float, age: float, size: int) -> Hypothesis:
        gust_var, map_var = self._sizes[size]
        return Hypothesis(speed_filter(mean, covariance, gust_var, map_var), log_weight, age, size)

    def restart(self, speed: float, variance: float) -> None:
        """Restart all hypotheses from one measured speed [m/s] and its variance [(m/s)^2]; keep the parameters."""
        for item in self.hypotheses:
            # [2]
            item.filter.restart(speed, variance)

    def idle(self, seconds: float) -> None:
        """Add the variance of a possible step of a and c in an idle time [s], up to the prior; no drift at rest."""
        plan = self.plan
        probability = min(1.0, plan.hazard * seconds)
        for state, variance in zip((A, C), plan.step_variances, strict=True):
            self.inflate_variance(state, probability * variance, float(plan.variance[state]))

    def inflate_force_scale_variance(self, variance: float) -> None:
        """Add a variance to the force scale, as for a change of load; limited to the prior variance plus this step."""
        self.inflate_variance(KAPPA, variance, float(self.plan.variance[KAPPA]) + variance)

    def inflate_variance(self, state: int, variance: float, limit: float) -> None:
        """Add to the variance of a state in all hypotheses, up to a limit."""
        for item in self.hypotheses:
            item.filter.inflate_variance(state, variance, limit)

    def advance(self, interval: Interval) -> Innovation:
        """Predict and correct all hypotheses, update their weights, and branch when due.

        Where a number is no longer finite the innovation is not either, and nothing is corrected.
        """
        plan = self.plan
        # [3]-[5]
        over = SpeedTransition(interval, plan.noise, self._drift)
        for item in self.hypotheses:
            item.filter.predict(over)
        # [6]
        innovation = self._innovation(interval)
        if not is_finite(innovation.variance):
            return innovation
        best, most = self.hypotheses[0], -math.inf
        for item in self.hypotheses:
            # [7]-[10]
            log_density, weight = item.filter.correct(interval.speed, interval.speed_variance, plan.noise.outliers)
            item.log_weight += log_density
            item.age += interval.dt
            if item.log_weight > most:
                best, most, innovation.weight = item, item.log_weight, weight
        for item in self.hypotheses:
            item.log_weight -= most
        self.since_s += interval.dt
        # [11], [12]
        if self.since_s >= plan.branch_interval:
            self._branch(best)
        return innovation

    def simulate_step(self, interval: Interval, deviation: float, slowest: float) -> bool:
        """Advance as if the speed of an interval was what the likeliest hypothesis predicts, plus a deviation.

        Args:
            interval: The interval; its speed is that planned [m/s].
            deviation: Innovation of that hypothesis over its standard deviation [1].
            slowest: Speed at which the drive ends [m/s].

        Returns:
            False, without any change, if the train would be slower.
        """
        best = self.hypotheses[0]
        for item in self.hypotheses:
            if item.log_weight > best.log_weight:
                best = item
        ahead = best.filter.copy(best.filter.gust_var, best.filter.map_var)
        ahead.predict(SpeedTransition(interval, self.plan.noise, self._drift))
        S = ahead.P[V] + interval.speed_variance
        if not (S > 0.0 and ahead.x[V] > slowest):
            return False
        interval.speed = ahead.x[V] + deviation * math.sqrt(S)
        self.advance(interval)
        return True

    def _innovation(self, interval: Interval) -> Innovation:
        """Return the innovation of the mixture of all predictions."""
        first = self.hypotheses[0].filter.x[V]
        total = mean = square = 0.0
        for item in self.hypotheses:
            weight, apart, S = math.exp(item.log_weight), item.filter.x[V] - first, item.filter.P[V]
            total += weight
            mean += weight * apart
            square += weight * (S + apart * apart)
            if S + interval.speed_variance <= 0.0:  # by rounding, after impossible input
                return Innovation(math.nan, math.nan, 0.0)
        mean /= total
        variance = square / total - mean * mean + interval.speed_variance
        return Innovation(interval.speed - (first + mean), variance, 0.0)

    def mixture(self, young_weight: float = 1.0) -> Mixture:
        """Return the mixture of all hypotheses of the minimum age, or of all if those have no weight.

        Args:
            young_weight: Factor on the weights of young hypotheses in the covariance.
        """
        plain = self._mature_weights()
        # [13]
        mean, weights = vec[float]([0.0] * N_PUBLISHED), _normalised(plain)
        first = self.hypotheses[0].filter.x
        for k in range(N_PUBLISHED):
            # Relative to one of them, so that identical hypotheses give exactly their common value.
            i, apart = self._states[k], 0.0
            for n in range(len(weights)):
                apart += weights[n] * (self.hypotheses[n].filter.x[i] - first[i])
            mean[k] = first[i] + apart
        if young_weight == 1.0:
            # [14]
            return Mixture(mean, self._covariance(mean, weights))
        return Mixture(mean, self._covariance(mean, self._cautious_weights(plain, young_weight)))

    def _mature_weights(self) -> vec[float]:
        """Return the weights of all hypotheses of the minimum age, 0 of others; of all if those have no weight."""
        weights, total = vec[float]([0.0] * len(self.hypotheses)), 0.0
        for n in range(len(weights)):
            item = self.hypotheses[n]
            if item.age >= self.plan.min_age:
                weights[n] = math.exp(item.log_weight)
                total += weights[n]
        if total < _NO_WEIGHT:
            for n in range(len(weights)):
                weights[n] = math.exp(self.hypotheses[n].log_weight)
        return weights

    def _cautious_weights(self, plain: vec[float], young_weight: float) -> vec[float]:
        """Return the weights of the stated covariance: a step that may just have happened counts more than it should.

        Of a hypothesis below the minimum age counts what it has gained over its weight when it branched off.
        """
        weights, step = plain[:], math.exp(self.plan.log_step)
        for n in range(len(weights)):
            item = self.hypotheses[n]
            if item.age < self.plan.min_age:
                weights[n] = young_weight * max(0.0, math.exp(item.log_weight) - step)
            elif item.age < self.plan.young_age:
                weights[n] *= young_weight
        return _normalised(weights)

    def _covariance(self, mean: vec[float], weights: vec[float]) -> vec[float]:
        """Return the upper triangle of the covariance of a mixture about its mean, 15 numbers."""
        covariance, entries, apart = vec[float]([0.0] * len(self._entries)), self._entries, vec[float](mean)
        for n in range(len(weights)):
            weight, x, P = weights[n], self.hypotheses[n].filter.x, self.hypotheses[n].filter.P
            for i in range(N_PUBLISHED):
                apart[i] = x[self._states[i]] - mean[i]
            k: i64 = 0
            for i in range(N_PUBLISHED):
                for j in range(i, N_PUBLISHED):
                    covariance[k] += weight * (P[entries[k]] + apart[i] * apart[j])
                    k += 1
        return covariance

    def _branch(self, best: Hypothesis) -> None:
        """Branch the best hypothesis and prune the least likely ones."""
        plan, now = self.plan, self.hypotheses
        self.since_s = 0.0
        self.branchings += 1
        # [11]
        for state, variance in zip((A, C), plan.step_variances, strict=True):
            now.append(self._child(best, plan.log_step, 0.0, best.size))
            now[-1].filter.inflate_variance(state, variance, math.inf)
        if others := self._absent_sizes(best):
            now.append(self._child(best, math.log(_OTHER_SIZES), best.age, others[self.branchings % len(others)]))
        # [12]
        score = [item.log_weight + (_YOUNG_BONUS if item.age < plan.min_age else 0.0) for item in now]
        score[now.index(best)] = math.inf  # kept even if many young ones have the bonus
        order = sorted(range(len(now)), key=score.__getitem__, reverse=True)
        self.hypotheses = [now[k] for k in sorted(order[: plan.hypotheses]) if now[k].log_weight > _PRUNED]

    def _child(self, parent: Hypothesis, log_probability: float, age: float, size: int) -> Hypothesis:
        """Return a copy of a hypothesis with its own age and size."""
        gust_var, map_var = self._sizes[size]
        return Hypothesis(parent.filter.copy(gust_var, map_var), parent.log_weight + log_probability, age, size)

    def _absent_sizes(self, best: Hypothesis) -> list[int]:
        """Return the sizes adjacent to those of the best hypothesis that no likely hypothesis has."""
        rows, columns = len(self.plan.gust_stds), len(self.plan.map_stds)
        row, column = divmod(best.size, columns)
        near = ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
        inside = [r * columns + c for r, c in near if 0 <= r < rows and 0 <= c < columns]
        present = {item.size for item in self.hypotheses if item.log_weight > _PRESENT}
        return [size for size in inside if size not in present]


def _normalised(weights: vec[float]) -> vec[float]:
    """Return weights divided by their sum."""
    total, shares = 0.0, weights[:]
    for weight in weights:
        total += weight
    for n in range(len(shares)):
        shares[n] /= total
    return shares
