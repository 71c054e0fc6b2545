# SPDX-License-Identifier: Apache-2.0
"""The filter kernel against numerical integration, textbook matrix equations and random samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from test.resistance.bank_rows import covariance
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.hypotheses import (
    DELTA,
    GUST,
    KAPPA,
    KAPPA_R,
    MAP,
    STATES,
    A,
    B,
    C,
    Interval,
    ProcessNoise,
    SpeedTransition,
    V,
    entry,
    speed_filter,
)

Array = NDArray[np.float64]
Reports = tuple[float, float, float, float]
INERTIA = 110.0
NOISE = ProcessNoise(inertia=INERTIA, gust_time=6.0, map_length=250.0, force_density=0.0245, skew=0.015, outliers=0.01)
INTERVAL = Interval(0.2, (18.0, 22.0, 27.0, 29.0), 4.5, 1.6, 14.2, 4e-4, 0.2, 0.2)
# v, a, b, c, gust, map error, kappa, delta, kappa_R
MEAN = np.array([14.0, 1.5, 0.03, 0.004, 0.3, -0.2, 0.04, 0.07, 0.2])
STD = np.array([0.03, 0.4, 0.02, 0.0015, 0.15, 0.2, 0.03, 0.04, 0.1])
GUST_VAR, MAP_VAR = 0.04, 0.01


def random_covariance(seed: int) -> Array:
    """All states correlated, with the standard deviations STD."""
    root = np.random.default_rng(seed).standard_normal((STATES, 2 * STATES))
    P = root @ root.T
    size = np.sqrt(np.diag(P))
    return np.asarray(np.outer(STD / size, STD / size) * P)


def cubic(reports: Reports, u: Array) -> Array:
    """The cubic through the reports at -1, 0, 1 and 2, from the linear equations for its coefficients."""
    coefficients = np.linalg.solve(np.vander([-1.0, 0.0, 1.0, 2.0]), np.array(reports))
    return np.asarray(np.polyval(coefficients, u))


def moved(x: Array, interval: Interval, substeps: int = 50) -> Array:
    """Integrate (1) by Heun's method for many states at once, shape (n, 9); gust and map error decay meanwhile."""
    y = x.copy()
    dt = interval.dt / substeps
    T = cubic(interval.traction, x[:, DELTA] / interval.spacing)

    def derivative(z: Array) -> Array:
        v = z[:, V]
        out = np.zeros_like(z)
        known = (1.0 + z[:, KAPPA]) * T - interval.track - interval.curve * z[:, KAPPA_R]
        out[:, V] = (known - z[:, A] - z[:, B] * v - z[:, C] * v * v - z[:, GUST] - z[:, MAP]) / INERTIA
        out[:, GUST] = -z[:, GUST] / NOISE.gust_time
        out[:, MAP] = -z[:, MAP] * interval.speed / NOISE.map_length
        return out

    for _ in range(substeps):
        start = derivative(y)
        y = y + 0.5 * dt * (start + derivative(y + dt * start))
    return y


def transition(interval: Interval, noise: ProcessNoise = NOISE) -> SpeedTransition:
    """Return the transition over an interval without drift."""
    return SpeedTransition(interval, noise, vec[float]([0.0] * STATES))


def predicted(x: Array, P: Array, interval: Interval = INTERVAL) -> tuple[Array, Array]:
    """Return the mean and covariance predicted over one interval."""
    one = speed_filter(x, P, GUST_VAR, MAP_VAR)
    one.predict(transition(interval))
    return np.array(list(one.x)), covariance(one)


@dataclass(frozen=True)
class Corrected:
    """Mean and covariance after a correction, the logarithm of the density of the speed, and its weight."""

    x: Array
    P: Array
    log_density: float
    weight: float


def corrected(P: Array, speed: float, outliers: float) -> Corrected:
    """Return the correction of MEAN by a measured speed."""
    one = speed_filter(MEAN, P, GUST_VAR, MAP_VAR)
    log_density, weight = one.correct(speed, INTERVAL.speed_variance, outliers)
    return Corrected(np.array(list(one.x)), covariance(one), log_density, weight)


# Prediction


@pytest.mark.parametrize(('shift', 'nearest'), [(-30.0, 3.0), (30.0, 5.0)])
def test_outside_the_reports_the_traction_is_the_nearest_one(shift: float, nearest: float) -> None:
    x = MEAN.copy()
    x[DELTA] = shift
    found, constant = (
        predicted(x, np.diag(STD**2), replace(INTERVAL, traction=reports, spacing=1.0))[0]
        for reports in ((3.0, -7.0, 11.0, 5.0), (nearest,) * 4)
    )
    assert found == pytest.approx(constant, rel=1e-12)


@pytest.mark.parametrize('dt', [0.05, 0.2, 1.0])
@pytest.mark.parametrize('seed', range(3))
def test_the_predicted_mean_is_the_integral_of_the_equation(dt: float, seed: int) -> None:
    interval = replace(INTERVAL, dt=dt, spacing=dt)
    x = MEAN + STD * np.random.default_rng(seed).standard_normal(STATES)
    x[DELTA] *= min(1.0, dt / 0.2)
    expected = moved(x[None], interval)[0]
    found, _ = predicted(x, np.diag(STD**2), interval)
    # Gust and map error are held constant over the interval: half of their decay in it is neglected.
    decay = abs(x[GUST] - expected[GUST]) + abs(x[MAP] - expected[MAP])
    assert found[V] == pytest.approx(expected[V], abs=1e-6 + 0.6 * dt / INERTIA * decay)
    assert np.delete(found, V) == pytest.approx(np.delete(expected, V), rel=1e-4, abs=1e-12)


def test_a_force_change_between_two_slow_reports_is_uniform_in_time() -> None:
    """20 N/kN within one second, interpolated in five equal parts: a step at a time of variance 1 s^2 / 12."""
    part = replace(INTERVAL, traction=(18.0, 22.0, 26.0, 30.0), force_interval=1.0)
    fast = replace(part, force_interval=0.2)
    added = 5 * (predicted(MEAN, np.diag(STD**2), part)[1] - predicted(MEAN, np.diag(STD**2), fast)[1])[V, V]
    assert added == pytest.approx((20.0 / INERTIA) ** 2 / 12.0)


def test_each_derivative_of_the_speed_is_the_numerical_one() -> None:
    quiet = replace(NOISE, force_density=0.0, skew=0.0)
    slow = replace(INTERVAL, dt=1.0)
    for i in range(STATES):
        # A variance of one state alone: P_vi is then its derivative, or P_vv the square of that of v.
        one = speed_filter(MEAN, np.diag(np.eye(STATES)[i]), 0.0, 0.0)
        one.predict(transition(slow, quiet))
        P = covariance(one)
        found = math.sqrt(P[V, V]) - 1.0 if i == V else P[V, i] / math.sqrt(P[i, i])
        e = np.eye(STATES)[i] * 1e-2 * STD[i]
        step = moved((MEAN + e)[None], slow)[0, V] - moved((MEAN - e)[None], slow)[0, V]
        expected = step / (2.0 * e[i]) - (i == V)
        if i in (GUST, MAP):  # they act with their initial values
            expected = -slow.dt / INERTIA
        assert found == pytest.approx(expected, rel=2e-3)


def test_an_exact_state_gains_the_process_noise() -> None:
    _, found = predicted(MEAN, np.zeros((STATES, STATES)))
    # White force noise for 0.2 s, and a jitter of 15 ms of the rise by 4 N/kN.
    assert found[V, V] == pytest.approx((0.0245 * 0.2 + (0.015 * 4.0) ** 2) / INERTIA**2, rel=1e-9)
    assert found[GUST, GUST] == pytest.approx(GUST_VAR * (1.0 - math.exp(-0.4 / 6.0)), rel=1e-9)
    assert found[MAP, MAP] == pytest.approx(MAP_VAR * (1.0 - math.exp(-0.4 * 14.2 / 250.0)), rel=1e-9)
    assert np.count_nonzero(found) == 3


# Correction


def test_a_speed_error_of_two_metres_per_second_has_negligible_weight() -> None:
    P = random_covariance(4)
    found = corrected(P, MEAN[V] + 2.0, 0.01)
    assert np.max(np.abs(found.x - MEAN) / STD) < 1e-3
    assert np.max(np.abs(found.P - P) / np.outer(STD, STD)) < 1e-3
    assert found.weight < 1e-9
    # The remaining density is that of an outlier: 1 % of them, uniform over 2 m/s.
    assert found.log_density == pytest.approx(math.log(0.01 / 2.0), rel=1e-9)


def test_an_outlier_has_negligible_weight_even_with_an_uncertain_prediction() -> None:
    """As after an impossible force: a standard deviation of 10 m/s and an error of 500 m/s."""
    P = np.diag(STD**2)
    P[V, V], P[V, KAPPA] = 100.0, 0.9 * 10.0 * STD[KAPPA]
    P[KAPPA, V] = P[V, KAPPA]
    found = corrected(P, MEAN[V] + 500.0, 0.01)
    assert np.max(np.abs(found.x - MEAN) / STD) < 1e-3
    assert pytest.approx(P, rel=1e-9) == found.P


def test_zero_variance_stays_zero() -> None:
    exact = [C, MAP, DELTA]
    P = random_covariance(6)
    P[exact, :] = P[:, exact] = 0.0
    one = speed_filter(MEAN, P, GUST_VAR, 0.0)
    for _ in range(20):
        one.predict(transition(INTERVAL))
        one.correct(np.array(list(one.x))[V] + 0.02, INTERVAL.speed_variance, 0.01)
    assert not covariance(one)[exact].any()
    assert np.array(list(one.x))[C] == MEAN[C]
    assert np.array(list(one.x))[DELTA] == MEAN[DELTA]


def test_a_restart_resets_the_motion_and_keeps_the_parameters() -> None:
    P = random_covariance(7)
    one = speed_filter(MEAN, P, GUST_VAR, MAP_VAR)
    one.restart(9.0, 1e-3)
    x, Q = np.array(list(one.x)), covariance(one)
    kept = [A, B, C, KAPPA, DELTA, KAPPA_R]
    assert (x[kept] == MEAN[kept]).all()
    assert (Q[np.ix_(kept, kept)] == P[np.ix_(kept, kept)]).all()
    assert x[[V, GUST, MAP]].tolist() == [9.0, 0.0, 0.0]
    reset = [V, GUST, MAP]
    assert not Q[np.ix_(reset, kept)].any()
    assert (Q[np.ix_(reset, reset)] == np.diag([1e-3, GUST_VAR, MAP_VAR])).all()


def test_an_entry_is_found_in_the_upper_triangle_from_either_side() -> None:
    P = random_covariance(9)
    upper = P[np.triu_indices(STATES)]
    for i in range(STATES):
        for j in range(STATES):
            assert upper[entry(i, j)] == P[i, j] or upper[entry(i, j)] == P[j, i]
