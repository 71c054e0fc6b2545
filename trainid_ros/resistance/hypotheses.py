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
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.resistance.speed_states import (
    DELTA,
    KAPPA,
    STATES,
    A,
    Array,
    B,
    C,
    V,
    correct,
    predict,
    restart,
)

if TYPE_CHECKING:
    from trainid_ros.resistance.speed_states import Interval, ProcessNoise

PUBLISHED: Final = (A, B, C, KAPPA, DELTA)
"""The states whose mixture is published, in the order of a :class:`Mixture`."""
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
    """Settings of the bank.

    Attributes:
        mean: Prior mean of the states, shape (9,); that of v is not used.
        variance: Prior variances of the states, shape (9,); those of v, gust and map error are not used.
        gust_stds: Hypothetical gust standard deviations [N/kN], ascending.
        map_stds: Hypothetical standard deviations of the map error [N/kN], ascending.
        step_variances: Variances that a step adds to a and to c, (N/kN)^2 and (N/kN per (m/s)^2)^2.
        hazard: Probability of a step per second [1/s].
        spacing: Driving time between branchings [s].
        most: Maximum number of hypotheses.
        patience: Minimum age of a hypothesis in the mixture [s].
        youth: Up to this age the stated covariance multiplies the weight of a hypothesis by ``suspicion`` [s].
        suspicion: See ``youth`` [1].
        wrong_prior: Prior odds that the stated prior is too narrow [1].
        drift: Growth of the variances of the states [per s], shape (9,).
        noise: Process and measurement noise.

    """

    mean: Array
    variance: Array
    gust_stds: tuple[float, ...]
    map_stds: tuple[float, ...]
    step_variances: tuple[float, float]
    hazard: float
    spacing: float
    most: int
    patience: float
    youth: float
    suspicion: float
    wrong_prior: float
    drift: Array
    noise: ProcessNoise


@dataclass(slots=True)
class Hypotheses:
    """State of the bank, one row per hypothesis.

    Attributes:
        x: Means, shape (n, 9).
        P: Covariances, shape (n, 9, 9).
        log_weight: Logarithms of the weights, normalised to a maximum of 0, shape (n,).
        age: Driving time since it branched off [s], shape (n,).
        size: Index of the sizes of gusts and map errors, shape (n,).
        since_s: Driving time since the last branching [s].
        branchings: Number of branchings.

    """

    x: Array
    P: Array
    log_weight: Array
    age: Array
    size: Array
    since_s: float = 0.0
    branchings: int = 0


@dataclass(frozen=True, slots=True)
class Mixture:
    """Mean, shape (5,), and covariances, shape (5, 5), of the :data:`PUBLISHED` states.

    Attributes:
        mean: a [N/kN], b [N/kN per m/s], c [N/kN per (m/s)^2], kappa [1], delta [s].
        covariance: Their covariance with the weights of young hypotheses multiplied by ``suspicion``.
        posterior: Their covariance with all hypotheses weighted by their probability.

    """

    mean: Array
    covariance: Array
    posterior: Array

    @property
    def theta(self) -> Array:
        """a, b, c [N/kN, v in m/s], shape (3,)."""
        return self.mean[:3]

    @property
    def theta_covariance(self) -> Array:
        """Covariance of a, b, c, shape (3, 3)."""
        return self.covariance[:3, :3]

    @property
    def stds(self) -> tuple[float, ...]:
        """Standard deviations of all five, in the units of ``mean``."""
        return tuple(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist())


@dataclass(frozen=True, slots=True)
class Innovation:
    """Measured minus predicted speed [m/s], its predicted variance [(m/s)^2], and its weight in the best hypothesis."""

    value: float
    variance: float
    weight: float


def _covariance(weight: Array, P: Array, spread: Array) -> Array:
    """Return the covariance of a mixture from weights, shape (n,), covariances and deviations from the mean."""
    within: Array = np.einsum('n,nij->ij', weight, P)
    return within + (spread.T * weight) @ spread


def _grown(variance: Array, added: Array | float, most: Array | float) -> Array:
    """Return variances with an increment added up to a limit; those already above it stay unchanged."""
    grown: Array = np.maximum(variance, np.minimum(variance + added, most))
    return grown


class Bank:
    """Bank of hypotheses and its recursion."""

    def __init__(self, plan: BankPlan) -> None:
        self.plan = plan
        sizes = [(gust, error) for gust in plan.gust_stds for error in plan.map_stds]
        self._gust_var = np.square([gust for gust, _ in sizes])
        self._map_var = np.square([error for _, error in sizes])
        self.reset()

    def reset(self) -> None:
        """Return to the stated and the wide prior, each with all disturbance sizes."""
        priors, n = self._priors(), len(self._gust_var)
        count = n * len(priors)
        self.state = Hypotheses(
            x=np.tile(self.plan.mean, (count, 1)),
            P=np.repeat([np.diag(variance) for variance, _ in priors], n, axis=0),
            log_weight=np.repeat([math.log(weight) for _, weight in priors], n),
            age=np.full(count, _INITIAL_AGE_S),
            size=np.tile(np.arange(n, dtype=float), len(priors)),
        )

    def _priors(self) -> list[tuple[Array, float]]:
        """Return the variances of the stated and the wide prior, shape (9,), and their weights."""
        stated, wide = self.plan.variance, self.plan.variance.copy()
        wide[[A, B, C]] *= _WIDER**2
        wide[KAPPA] = max(_WIDE_SCALE_STD**2, _WIDER**2 * wide[KAPPA])
        return [(stated, 1.0), *([(wide, self.plan.wrong_prior)] if self.plan.wrong_prior > 0.0 else [])]

    def restart(self, speed: float, variance: float) -> None:
        """Restart all hypotheses from one measured speed [m/s] and its variance [(m/s)^2]; keep the parameters."""
        gust_var, map_var = self._sizes()
        restart(self.state.x, self.state.P, speed, variance, gust_var, map_var)

    def idle(self, seconds: float) -> None:
        """Add the variance of a possible step of a and c in an idle time [s], up to the prior; no drift at rest."""
        plan, states = self.plan, np.array([A, C])
        stepped = min(1.0, plan.hazard * seconds) * np.array(plan.step_variances)
        variance = self.state.P[:, states, states]
        self.state.P[:, states, states] = _grown(variance, stepped, plan.variance[states])

    def widen_force_scale(self, variance: float) -> None:
        """Add a variance to the force scale, as for a change of load; limited to the prior variance plus this step."""
        most = self.plan.variance[KAPPA] + variance
        self.state.P[:, KAPPA, KAPPA] = _grown(self.state.P[:, KAPPA, KAPPA], variance, most)

    def advance(self, interval: Interval) -> Innovation:
        """Predict and correct all hypotheses, update their weights, and branch when due."""
        now, plan = self.state, self.plan
        gust_var, map_var = self._sizes()
        diagonal = np.arange(STATES)
        now.P[:, diagonal, diagonal] += plan.drift * interval.dt
        predict(now.x, now.P, interval, gust_var, map_var, plan.noise)
        value, variance = self._predicted(interval)
        log_density, weight = correct(now.x, now.P, interval, plan.noise.outliers)
        now.log_weight += log_density
        best = int(np.argmax(now.log_weight))
        now.log_weight -= now.log_weight[best]
        now.age += interval.dt
        now.since_s += interval.dt
        if now.since_s >= plan.spacing:
            self._branch(best)
        return Innovation(value, variance, float(weight[best]))

    def mixture(self) -> Mixture:
        """Return the mixture of all hypotheses of the minimum age, or of all if those have no weight."""
        now, plan = self.state, self.plan
        weight = np.exp(now.log_weight) * (now.age >= plan.patience)
        if weight.sum() < _NO_WEIGHT:
            weight = np.exp(now.log_weight)
        x, P = now.x[:, PUBLISHED], now.P[:, PUBLISHED][:, :, PUBLISHED]
        # Relative to one of them, so that identical hypotheses give exactly their common value.
        mean = x[0] + weight @ (x - x[0]) / weight.sum()
        cautious = weight * np.where(now.age < plan.youth, plan.suspicion, 1.0)
        spread = x - mean
        return Mixture(mean, *(_covariance(p / p.sum(), P, spread) for p in (cautious, weight)))

    def is_finite(self) -> bool:
        """Return whether all means and covariances are finite."""
        return bool(np.isfinite(self.state.x).all() and np.isfinite(self.state.P).all())

    def _sizes(self) -> tuple[Array, Array]:
        size = self.state.size.astype(int)
        return self._gust_var[size], self._map_var[size]

    def _predicted(self, interval: Interval) -> tuple[float, float]:
        """Return the innovation of the mixture of all hypotheses and its variance."""
        weight = np.exp(self.state.log_weight)
        weight /= weight.sum()
        v = self.state.x[:, V]
        mean = float(weight @ v)
        variance = float(weight @ (self.state.P[:, V, V] + (v - mean) ** 2))
        return interval.speed - mean, variance + interval.speed_variance

    def _branch(self, best: int) -> None:
        """Branch the best hypothesis and prune the least likely ones."""
        now, plan = self.state, self.plan
        now.P[:] = 0.5 * (now.P + now.P.transpose(0, 2, 1))
        now.since_s = 0.0
        now.branchings += 1
        step = math.log(0.5 * min(1.0, plan.hazard * plan.spacing))
        self._add(best, step, 0.0, now.size[best], (A, plan.step_variances[0]))
        self._add(best, step, 0.0, now.size[best], (C, plan.step_variances[1]))
        if others := self._absent_sizes(best):
            self._add(best, math.log(_OTHER_SIZES), now.age[best], others[now.branchings % len(others)])
        score = now.log_weight + np.where(now.age < plan.patience, _YOUNG_BONUS, 0.0)
        score[best] = math.inf  # kept even if many young ones have the bonus
        kept = np.argsort(-score, kind='stable')[: plan.most]
        kept = np.sort(kept[now.log_weight[kept] > _PRUNED])
        now.x, now.P = now.x[kept], now.P[kept]
        now.log_weight, now.age, now.size = now.log_weight[kept], now.age[kept], now.size[kept]

    def _add(
        self, parent: int, log_probability: float, age: float, size: float, step: tuple[int, float] | None = None
    ) -> None:
        """Add a copy of a hypothesis with its own age and size; a step adds variance to one of its states."""
        now = self.state
        P = now.P[parent].copy()
        if step is not None:
            state, variance = step
            P[state, state] += variance
        now.x = np.concatenate((now.x, now.x[parent][None]))
        now.P = np.concatenate((now.P, P[None]))
        now.log_weight = np.append(now.log_weight, now.log_weight[parent] + log_probability)
        now.age = np.append(now.age, age)
        now.size = np.append(now.size, size)

    def _absent_sizes(self, best: int) -> list[float]:
        """Return the sizes adjacent to those of the best hypothesis that no likely hypothesis has."""
        columns = len(self.plan.map_stds)
        row, column = divmod(int(self.state.size[best]), columns)
        near = ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
        inside = [r * columns + c for r, c in near if 0 <= r < len(self.plan.gust_stds) and 0 <= c < columns]
        present = set(self.state.size[self.state.log_weight > _PRESENT].astype(int).tolist())
        return [float(size) for size in inside if size not in present]
