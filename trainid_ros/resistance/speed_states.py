# SPDX-License-Identifier: Apache-2.0
"""Extended Kalman filter on raw speed, with force and track errors as states.

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
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, TypeAlias

import numpy as np

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.state import State, declare, definite
from trainid_ros.interface.vectors import i64, vec
from trainid_ros.resistance.davis_posterior import MAX_DELAY, MIN_DELAY
from trainid_ros.stream.topic_track import FAST_NS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array: TypeAlias = NDArray[np.float64]

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
# Lower limit of the weight, so small that R over it exceeds any variance of a predicted speed.
_MIN_WEIGHT: Final = 1e-30
# Limit of the normalised innovation squared, beyond which the exponential is zero.
_MAX_NIS: Final = 1200.0
# Interpolation is accurate for forces reported at this interval or faster, which ramp between reports [s].
_FAST_FORCE_S: Final = FAST_NS / NS_PER_S
_ROOT_2_PI: Final = math.sqrt(2.0 * math.pi)


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
        self._spacing = interval.spacing
        before, now, next_, last = interval.traction
        # Lagrange's polynomial through (-1, before), (0, now), (1, next), (2, last)
        self._k0 = now
        self._k3 = (last - before) / 6.0 + 0.5 * (now - next_)
        self._k2 = 0.5 * (before + next_) - now
        self._k1 = next_ - now - self._k2 - self._k3
        # [3]
        change = now - before
        jitter = (noise.skew * noise.skew + _force_timing_variance(interval)) * change * change
        self.speed_noise = (noise.force_density * dt + jitter * dt / interval.spacing) / (m * m)

    def traction(self, delay: float) -> tuple[float, float]:
        """Return T(t + delta) [N/kN] and its derivative by the delay [N/kN per s], by the cubic through four values.

        Traction ramps within a few tenths of a second, so a first-order approximation of such a delay is not accurate.
        """
        u = min(max(delay / self._spacing, -1.0), 2.0)
        T = self._k0 + u * (self._k1 + u * (self._k2 + u * self._k3))
        return T, (self._k1 + u * (2.0 * self._k2 + u * 3.0 * self._k3)) / self._spacing


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

    def mean(self) -> Array:
        """Return the mean as an array, shape (9,)."""
        return np.array(list(self.x))

    def covariance(self) -> Array:
        """Return the covariance as an array, shape (9, 9)."""
        P = np.zeros((STATES, STATES))
        P[_UPPER] = list(self.P)
        return P + np.triu(P, 1).T

    def predict(self, over: SpeedTransition) -> None:
        """Predict to the end of an interval."""
        x, P, f, fP, h, decay = self.x, self.P, self._f, self._row, over.h, over.decay
        v, b, c, scale = x[V], x[B], x[C], 1.0 + x[KAPPA]
        T, slope = over.traction(x[DELTA])
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

        Returns:
            Logarithm of the density of the measurement [(m/s)^-1], and its weight [1], 1 = no outlier.
        """
        x, P, column = self.x, self.P, self._row
        # [7]
        S, nu = P[V] + R, speed - x[V]
        # [8]
        good = (1.0 - outliers) / (_ROOT_2_PI * math.sqrt(S)) * math.exp(-0.5 * min(nu * nu / S, _MAX_NIS))
        density = good + outliers / _OUTLIER_RANGE
        weight = good / density
        # [9] K = P e_v / (P_vv + R / w);  x += K nu;  P -= K e_v' P
        gain = 1.0 / (P[V] + R / max(weight, _MIN_WEIGHT))
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
