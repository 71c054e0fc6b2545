# SPDX-License-Identifier: Apache-2.0
"""Bank of change-point hypotheses, each with an extended Kalman filter on raw speed.

x = [v, a, b, c, g, e, kappa, delta, kappa_R]:

* v [m/s], and a, b, c of the resistance a + b v + c v^2 [N/kN];
* g: gust, first-order Gauss-Markov in time [N/kN];
* e: error of the map, first-order Gauss-Markov in distance [N/kN, equal to per mille];
* kappa: ratio of actual to reported specific force, minus one [1]. Only the ratio of force gain to mass is observable;
* delta: delay of the force stamps relative to the force [s];
* kappa_R: error of the curve resistance at a radius of 600 m [N/kN].

With the reported specific traction T, the gradient plus all known extra resistance i, and the radius R:

    (1)  m dv/dt = (1 + kappa) T(t + delta) - i - 600/R kappa_R - a - b v - c v^2 - g - e,   m = 1000 (1 + gamma)/g0

The steps [n] are those at the head of :mod:`filter_bank`. Only v depends on other states: row v of the Jacobian F is
full, the other rows have only their diagonal. And only v is measured: H = e_v'.

Hypotheses differ in when a or c last stepped, and in the sizes of gusts and map errors. They are weighted by the
likelihood of the measured speeds. At intervals the most likely one branches into one whose a has just stepped, one
whose c has, and one with other disturbance sizes. The estimate is the mixture of all hypotheses above a minimum age;
its stated covariance weights young ones more: while a step is suspected but not yet confirmed, it must cover both
outcomes. The train file may be overconfident, so half of the hypotheses start from a wide prior with a small weight: if
the data contradict the stated prior they outweigh the others within minutes, otherwise they are pruned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, definite, several
from trainid_ros.interface.vectors import i64, vec
from trainid_ros.resistance.davis_posterior import MAX_DELAY, MIN_DELAY, DavisPosterior
from trainid_ros.stream.topic_track import FAST_NS

Array = NDArray[np.float64]

STATES: Final[i64] = 9  # number of states
V: Final = 0  # place of v [m/s]
A: Final = 1  # place of a [N/kN]
B: Final = 2  # place of b [N/kN per m/s]
C: Final = 3  # place of c [N/kN per (m/s)^2]
GUST: Final = 4  # place of g [N/kN]
MAP: Final = 5  # place of e [N/kN]
KAPPA: Final = 6  # place of kappa [1]
DELTA: Final = 7  # place of delta [s]
KAPPA_R: Final = 8  # place of kappa_R [N/kN at 600 m]
# Places of the variances of gust and map error in the upper triangle, and the indices of that in a matrix.
_GUST_GUST: Final = 30
_MAP_MAP: Final = 35
_UPPER: Final = np.triu_indices(STATES)
# Outliers are uniformly distributed over this range of speed [m/s].
_OUTLIER_RANGE: Final = 2.0
_ROOT_2_PI: Final = math.sqrt(2.0 * math.pi)
# Interpolation is accurate for forces reported at this interval or faster, which ramp between reports [s].
_FAST_FORCE_S: Final = FAST_NS / NS_PER_S


def entry(i: i64, j: i64) -> i64:
    """Return the place of the entry of row i and column j in the upper triangle of a covariance."""
    return i * (2 * STATES - 1 - i) // 2 + j if i <= j else entry(j, i)


@dataclass(slots=True)
class AdmittedSample:
    """One admitted sample."""

    stamp_ns: int  # Time stamp [ns]
    dt: float  # Time since the previous sample [s]
    speed: float  # Measured speed [m/s]
    traction: float  # Mean reported specific traction [N/kN]
    track: float  # Mean gradient and known extra resistance [N/kN]
    curve: float  # 600 m over the mean radius [1], 0 on straight track
    variance: float  # Variance of the measured speed [(m/s)^2]
    weighed: bool  # Whether the load is weighed
    force_interval: float  # Time between the force reports used for interpolation [s]


@dataclass(slots=True)
class Interval:
    """Forces from one speed measurement to the next, and the measurement at the end."""

    dt: float  # Length of the interval [s]
    # Mean reported specific traction [N/kN] one ``spacing`` before, in it, and one and two after it
    traction: tuple[float, float, float, float]
    track: float  # Gradient and known extra resistance [N/kN]
    curve: float  # 600 m over the mean radius [1], 0 on straight track
    speed: float  # Speed measured at its end [m/s]
    speed_variance: float  # Variance of that measurement [(m/s)^2]
    spacing: float  # Time between the four values of the traction [s]
    force_interval: float  # Time between the two force reports from which the traction was interpolated [s]


@dataclass(frozen=True, slots=True)
class ProcessNoise:
    """Inertia and noise parameters of the filters."""

    inertia: float  # m of (1) [N/kN per m/s^2]
    gust_time: float  # Correlation time of the gusts [s]
    map_length: float  # Correlation length of the map error [m]
    force_density: float  # Spectral density of the white noise of the force [(N/kN)^2 s]
    skew: float  # Jitter between the stamps of force and speed [s], independent for each ``spacing``
    outliers: float  # Share of outliers among the speeds [1]


class SpeedTransition:
    """What predicting over one interval has in common for all filters.

    Attributes:
        h: Change of speed per specific force, dt/m [m/s per N/kN].
        track: As in the interval.
        curve: As in the interval.
        decay: Factors on the states without (1), shape (9,): 1 but for gust and map error.
        drift: Increase of the variances of the states before the motion, shape (9,).
        speed_noise: Variance that the force adds to v [(m/s)^2].
        spacing: As in the interval.
        k0: The traction T(t + u spacing) is k0 + k1 u + k2 u^2 + k3 u^3 [N/kN].
    """

    def __init__(self, interval: Interval, noise: ProcessNoise, rates: vec[float]) -> None:
        dt, m = interval.dt, noise.inertia
        self.h = dt / m
        self.track, self.curve = interval.track, interval.curve
        self.decay = vec[float]([1.0] * STATES)
        self.decay[GUST] = math.exp(-dt / noise.gust_time)
        self.decay[MAP] = math.exp(-interval.speed * dt / noise.map_length)
        self.drift = vec[float]([0.0] * STATES)
        for i in range(STATES):
            self.drift[i] = rates[i] * dt
        self.spacing = interval.spacing
        before, now, next_, last = interval.traction
        # Lagrange's polynomial through (-1, before), (0, now), (1, next), (2, last): traction ramps within a few tenths
        # of a second, so a first-order approximation is not accurate.
        self.k0 = now
        self.k3 = (last - before) / 6.0 + 0.5 * (now - next_)
        self.k2 = 0.5 * (before + next_) - now
        self.k1 = next_ - now - self.k2 - self.k3
        # [3]
        change = now - before
        jitter = (noise.skew * noise.skew + _force_timing_variance(interval)) * change * change
        self.speed_noise = (noise.force_density * dt + jitter * dt / interval.spacing) / (m * m)


def _force_timing_variance(interval: Interval) -> float:
    """Return the variance of the time at which the force changed between two slow reports, per spacing [s^2].

    A step at any time within a report interval D has the variance D^2 / 12 about its middle. Interpolation spreads it
    over D / spacing equal changes, each of which must have D / spacing times that variance.
    """
    D = interval.force_interval
    return D * D * D / (12.0 * interval.spacing) if D > _FAST_FORCE_S else 0.0


class SpeedFilter:
    """One extended Kalman filter.

    Attributes:
        x: Mean, shape (9,).
        P: Upper triangle of the covariance, row by row, 45 numbers; the first nine are the row of v.
        gust_var: Stationary variance of the gusts [(N/kN)^2].
        map_var: Stationary variance of the map error [(N/kN)^2].
    """

    STATE: ClassVar[State] = declare('x', definite('P'), 'gust_var', 'map_var')

    def __init__(self, x: vec[float], P: vec[float], gust_var: float, map_var: float) -> None:
        self.x, self.P, self.gust_var, self.map_var = x, P, gust_var, map_var
        # Row v of F, of F P and of P before the correction.
        self._f = vec[float]([0.0] * STATES)
        self._row = vec[float]([0.0] * STATES)

    def copy(self, gust_var: float, map_var: float) -> SpeedFilter:
        """Return a filter with the same mean and covariance and other stationary variances."""
        return SpeedFilter(self.x[:], self.P[:], gust_var, map_var)

    def predict(self, over: SpeedTransition) -> None:
        """Predict to the end of an interval."""
        x, P, f, fP, h, decay = self.x, self.P, self._f, self._row, over.h, over.decay
        v, b, c, scale = x[V], x[B], x[C], 1.0 + x[KAPPA]
        # [3] T(t + delta), and its derivative by the delay.
        u = min(max(x[DELTA] / over.spacing, -1.0), 2.0)
        T = over.k0 + u * (over.k1 + u * (over.k2 + u * over.k3))
        slope = (over.k1 + u * (2.0 * over.k2 + u * 3.0 * over.k3)) / over.spacing
        # [4] (1) with the speed in the middle of the interval; w at the initial speed would lag by half an interval.
        pull = scale * T - over.track - over.curve * x[KAPPA_R] - x[A] - x[GUST] - x[MAP]
        vm = v + 0.5 * h * (pull - v * (b + c * v))
        x[V] = v + h * (pull - vm * (b + c * vm))
        x[GUST] *= decay[GUST]
        x[MAP] *= decay[MAP]
        # Row v of the Jacobian F.
        f[V] = 1.0 - h * (b + 2.0 * c * vm)
        f[A] = f[GUST] = f[MAP] = -h
        f[B] = -h * vm
        f[C] = -h * vm * vm
        f[KAPPA] = h * T
        f[DELTA] = h * scale * slope
        f[KAPPA_R] = -h * over.curve
        # [5] P = F P F' + Q, where F is the decay but for its row f of v.
        for i in range(STATES):
            fP[i] = 0.0
        k: i64 = 0
        for i in range(STATES):
            p = P[k] + over.drift[i]
            f_i, decay_i, sum_i = f[i], decay[i], fP[i] + f[i] * p
            P[k] = decay_i * decay_i * p
            k += 1
            for j in range(i + 1, STATES):
                p = P[k]
                sum_i += f[j] * p
                fP[j] += f_i * p
                P[k] = decay_i * decay[j] * p
                k += 1
            fP[i] = sum_i
        variance = over.speed_noise
        for j in range(STATES):
            variance += fP[j] * f[j]
            P[j] = fP[j] * decay[j]
        P[V] = variance
        P[_GUST_GUST] += self.gust_var * (1.0 - decay[GUST] * decay[GUST])
        P[_MAP_MAP] += self.map_var * (1.0 - decay[MAP] * decay[MAP])

    def correct(self, speed: float, R: float, outliers: float) -> tuple[float, float]:
        """Correct with a measured speed [m/s] of variance R [(m/s)^2]; a likely outlier has less weight.

        Return the logarithm of the density of the measurement [(m/s)^-1], and its weight [1], 1 = no outlier.
        """
        x, P, column = self.x, self.P, self._row
        # [7]
        S, nu = P[V] + R, speed - x[V]
        # [8]
        # Beyond 1200 the exponential is zero.
        good = (1.0 - outliers) / (_ROOT_2_PI * math.sqrt(S)) * math.exp(-0.5 * min(nu * nu / S, 1200.0))
        density = good + outliers / _OUTLIER_RANGE
        weight = good / density
        # [9] K = P e_v / (P_vv + R / w);  x += K nu;  P -= K e_v' P. R / 1e-30 exceeds any variance of a speed.
        gain = 1.0 / (P[V] + R / max(weight, 1e-30))
        for j in range(STATES):
            column[j] = P[j]
        k: i64 = 0
        for i in range(STATES):
            K = gain * column[i]
            x[i] += K * nu
            for j in range(i, STATES):
                P[k] -= K * column[j]
                k += 1
        # Outside this range the force is not known and the delay would diverge.
        x[DELTA] = min(max(x[DELTA], MIN_DELAY), MAX_DELAY)
        return math.log(density), weight

    def restart(self, speed: float, variance: float) -> None:
        """Reset speed, gust and map error to one measured speed [m/s] and stationary variances."""
        x, P = self.x, self.P
        x[V], x[GUST], x[MAP] = speed, 0.0, 0.0
        for j in range(STATES):
            for i in (V, GUST, MAP):
                P[entry(i, j)] = 0.0
        P[V], P[_GUST_GUST], P[_MAP_MAP] = variance, self.gust_var, self.map_var

    def inflate_variance(self, state: i64, variance: float, limit: float) -> None:
        """Add to the variance of a state up to a limit; one already above it stays unchanged."""
        k = entry(state, state)
        self.P[k] = max(self.P[k], min(self.P[k] + variance, limit))


def speed_filter(mean: Array, covariance: Array, gust_var: float, map_var: float) -> SpeedFilter:
    """Return a filter with a mean of shape (9,) and a covariance of shape (9, 9)."""
    return SpeedFilter(vec[float](mean.tolist()), vec[float](covariance[_UPPER].tolist()), gust_var, map_var)


N_PUBLISHED: Final[i64] = 5
"""Number of states whose mixture is published: a, b, c, kappa, delta."""
# Age of the first hypotheses, as if the last step was long ago, and age up to which one is young [s].
_INITIAL_AGE_S: Final = 1e9
_YOUNG_AGE_S: Final = 120.0
# Log weight relative to the best hypothesis below which one is pruned, and the bonus of young ones there.
_PRUNED, _YOUNG_BONUS = -40.0, 8.0
# Disturbance sizes count as present while the log weight of a hypothesis with them exceeds this; absent ones start with
# this probability.
_PRESENT, _OTHER_SIZES = -6.0, 1e-3
# Factor of the wide prior on the standard deviations of a, b, c and kappa, and its minimum standard deviation of kappa.
_WIDER, _WIDE_SCALE_STD = 5.0, 0.06


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
        plan, wide = self.plan, self.plan.variance.copy()
        wide[[A, B, C]] *= _WIDER**2
        wide[KAPPA] = max(_WIDE_SCALE_STD**2, _WIDER**2 * wide[KAPPA])
        # [1]
        self.hypotheses = [
            self._new(plan.mean, np.diag(variance), math.log(weight), _INITIAL_AGE_S, size)
            for variance, weight in ((plan.variance, 1.0), (wide, plan.wrong_prior))
            if weight > 0.0
            for size in range(len(self._sizes))
        ]
        self.since_s = 0.0
        self.branchings = 0

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
        probability = min(1.0, self.plan.hazard * seconds)
        for state, variance in zip((A, C), self.plan.step_variances, strict=True):
            self.inflate_variance(state, probability * variance, float(self.plan.variance[state]))

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

        The deviation is the innovation of that hypothesis over its standard deviation [1]. Return False, without any
        change, if the train would be slower than ``slowest`` [m/s].
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

        ``young_weight`` is a factor on the weights of young ones in the covariance.
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
        if total < 1e-200:
            for n in range(len(weights)):
                weights[n] = math.exp(self.hypotheses[n].log_weight)
        return weights

    def _cautious_weights(self, plain: vec[float], young_weight: float) -> vec[float]:
        """Return the weights of the stated covariance, in which a step that may just have happened counts more.

        Of a hypothesis below the minimum age counts what it has gained over its weight when it branched off.
        """
        weights, step = plain[:], math.exp(self.plan.log_step)
        for n in range(len(weights)):
            item = self.hypotheses[n]
            if item.age < self.plan.min_age:
                weights[n] = young_weight * max(0.0, math.exp(item.log_weight) - step)
            elif item.age < _YOUNG_AGE_S:
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
