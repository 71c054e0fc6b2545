# SPDX-License-Identifier: Apache-2.0
"""Extended Kalman filters on raw speed for several hypotheses at once, with force and track errors as states.

x = [v, a, b, c, g, e, kappa, delta, kappa_R]:

* v [m/s], and a, b, c of the resistance a + b v + c v^2 [N/kN];
* g: gust, first-order Gauss-Markov in time [N/kN];
* e: error of the map, first-order Gauss-Markov in distance [N/kN, equal to per mille];
* kappa: ratio of actual to reported specific force, minus one [1]. Only the ratio of force gain to mass is observable;
* delta: delay of the force stamps relative to the force [s];
* kappa_R: error of the curve resistance at a radius of 600 m [N/kN].

With the reported specific traction T, the gradient plus all known extra resistance i, and the radius R:

    (1)  m dv/dt = (1 + kappa) T(t + delta) - i - 600/R kappa_R - a - b v - c v^2 - g - e,   m = 1000 (1 + gamma)/g0

The first axis of arrays is the hypothesis: x of shape (n, 9), P of shape (n, 9, 9).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from trainid_ros.records import NS_PER_S
from trainid_ros.resistance.force_errors import DELAY_RANGE
from trainid_ros.stream.intervals import FAST_NS

Array: TypeAlias = NDArray[np.float64]

STATES: Final = 9
V, A, B, C, GUST, MAP, KAPPA, DELTA, KAPPA_R = range(STATES)
# Outliers are uniformly distributed over this range of speed [m/s].
_OUTLIER_RANGE: Final = 2.0
# Lower limit of the weight, so small that R over it exceeds any variance of a predicted speed.
_MIN_WEIGHT: Final = 1e-30
# Limit of the normalised innovation squared, beyond which the exponential is zero.
_MAX_NIS: Final = 1200.0
# Interpolation is accurate for forces reported at this interval or faster, which ramp between reports [s].
_FAST_FORCE_S: Final = FAST_NS / NS_PER_S
_ROOT_2_PI: Final = math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True)
class Interval:
    """Forces from one speed measurement to the next, and the measurement at the end.

    Attributes:
        dt: Length of the interval [s].
        traction: Mean reported specific traction [N/kN] one ``spacing`` before, in it, and one and two after it.
        track: Gradient and known extra resistance [N/kN].
        curve: 600 m over the mean radius [1], 0 on straight track.
        speed: Speed measured at its end [m/s].
        speed_variance: Variance of that measurement [(m/s)^2].
        spacing: Time between the four values of the traction [s].
        force_interval: Time between the two force reports from which the traction was interpolated [s].

    """

    dt: float
    traction: tuple[float, float, float, float]
    track: float
    curve: float
    speed: float
    speed_variance: float
    spacing: float
    force_interval: float


@dataclass(frozen=True, slots=True)
class ProcessNoise:
    """Inertia and noise parameters of the filters.

    Attributes:
        inertia: m of (1) [N/kN per m/s^2].
        gust_time: Correlation time of the gusts [s].
        map_length: Correlation length of the map error [m].
        force_density: Spectral density of the white noise of the force [(N/kN)^2 s].
        skew: Jitter between the stamps of force and speed [s], independent for each ``spacing``.
        outliers: Share of outliers among the speeds [1].

    """

    inertia: float
    gust_time: float
    map_length: float
    force_density: float
    skew: float
    outliers: float


def shifted_traction(traction: tuple[float, float, float, float], shift: Array) -> tuple[Array, Array]:
    """Return T [N/kN] at a shift in spacings, shape (n,), and its derivative, by the cubic through four values.

    Traction ramps within a few tenths of a second, so a first-order approximation of such a delay is not accurate.
    """
    before, now, next_, last = traction
    u = np.minimum(np.maximum(shift, -1.0), 2.0)
    # Lagrange's polynomial through (-1, before), (0, now), (1, next), (2, last)
    k3 = (last - before) / 6.0 + 0.5 * (now - next_)
    k2 = 0.5 * (before + next_) - now
    k1 = next_ - now - k2 - k3
    return now + u * (k1 + u * (k2 + u * k3)), k1 + u * (2.0 * k2 + u * 3.0 * k3)


def predict(x: Array, P: Array, interval: Interval, gust_var: Array, map_var: Array, noise: ProcessNoise) -> None:
    """Predict all hypotheses to the end of an interval, in place.

    Args:
        x: Means, shape (n, 9).
        P: Covariances, shape (n, 9, 9).
        interval: Forces over the interval.
        gust_var: Stationary variance of the gusts [(N/kN)^2], shape (n,).
        map_var: Stationary variance of the map error [(N/kN)^2], shape (n,).
        noise: Inertia and other noise parameters.

    """
    dt, m = interval.dt, noise.inertia
    rho_g, rho_e = math.exp(-dt / noise.gust_time), math.exp(-interval.speed * dt / noise.map_length)
    v, F = _transition(x, interval, dt / m)
    F[:, GUST, GUST], F[:, MAP, MAP] = rho_g, rho_e
    x[:, V] = v
    x[:, GUST] *= rho_g
    x[:, MAP] *= rho_e
    # P = F P F' + Q
    P[:] = F @ P @ F.transpose(0, 2, 1)
    change = interval.traction[1] - interval.traction[0]
    jitter = (noise.skew**2 + _unseen_change(interval)) * change * change
    P[:, V, V] += (noise.force_density * dt + jitter * dt / interval.spacing) / (m * m)
    P[:, GUST, GUST] += gust_var * (1.0 - rho_g * rho_g)
    P[:, MAP, MAP] += map_var * (1.0 - rho_e * rho_e)


def _unseen_change(interval: Interval) -> float:
    """Return the variance of the time at which the force changed between two slow reports, per spacing [s^2].

    A step at any time within a report interval D has the variance D^2 / 12 about its middle. Interpolation spreads it
    over D / spacing equal changes, each of which must have D / spacing times that variance.
    """
    D = interval.force_interval
    return D**3 / (12.0 * interval.spacing) if D > _FAST_FORCE_S else 0.0


def _transition(x: Array, interval: Interval, h: float) -> tuple[Array, Array]:
    """Return the speed at the end of an interval by (1), shape (n,), and the Jacobian F, (n, 9, 9); h = dt / m."""
    T, slope = shifted_traction(interval.traction, x[:, DELTA] / interval.spacing)
    v, a, b, c, kappa = x[:, V], x[:, A], x[:, B], x[:, C], x[:, KAPPA]
    # (1) with the speed in the middle of the interval; w at the initial speed would lag by half an interval.
    pull = (1.0 + kappa) * T - interval.track - interval.curve * x[:, KAPPA_R] - a - x[:, GUST] - x[:, MAP]
    vm = v + 0.5 * h * (pull - v * (b + c * v))
    F = np.tile(np.eye(STATES), (len(x), 1, 1))
    F[:, V, V] = 1.0 - h * (b + 2.0 * c * vm)
    F[:, V, A] = F[:, V, GUST] = F[:, V, MAP] = -h
    F[:, V, B] = -h * vm
    F[:, V, C] = -h * vm * vm
    F[:, V, KAPPA] = h * T
    F[:, V, DELTA] = h * (1.0 + kappa) * slope / interval.spacing
    F[:, V, KAPPA_R] = -h * interval.curve
    return v + h * (pull - vm * (b + c * vm)), F


def correct(x: Array, P: Array, interval: Interval, outliers: float) -> tuple[Array, Array]:
    """Correct all hypotheses with the measured speed, in place; a likely outlier has less weight.

    Returns:
        Logarithm of the density of the measurement [(m/s)^-1], and its weight [1], 1 = no outlier, shape (n,) each.

    """
    R = interval.speed_variance
    S = P[:, V, V] + R
    nu = interval.speed - x[:, V]
    good = (1.0 - outliers) / (_ROOT_2_PI * np.sqrt(S)) * np.exp(-0.5 * np.minimum(nu * nu / S, _MAX_NIS))
    density = good + outliers / _OUTLIER_RANGE
    weight = good / density
    # K = P e_v / (P_vv + R / w);  x += K nu;  P -= K e_v' P
    column = P[:, :, V].copy()
    K = column / (P[:, V, V] + R / np.maximum(weight, _MIN_WEIGHT))[:, None]
    x += K * nu[:, None]
    P -= K[:, :, None] * column[:, None, :]
    # Outside this range the force is not known and the delay would diverge.
    np.clip(x[:, DELTA], *DELAY_RANGE, out=x[:, DELTA])
    return np.log(density), weight


def restart(x: Array, P: Array, speed: float, variance: float, gust_var: Array, map_var: Array) -> None:
    """Reset speed, gust and map error to one measured speed [m/s] and stationary variances, in place."""
    x[:, V], x[:, GUST], x[:, MAP] = speed, 0.0, 0.0
    for state, start in ((V, variance), (GUST, gust_var), (MAP, map_var)):
        P[:, state, :] = P[:, :, state] = 0.0
        P[:, state, state] = start
