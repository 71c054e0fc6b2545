# SPDX-License-Identifier: Apache-2.0
"""Metro coasts as in the experiment of Liu et al. 2018, and the Cramer-Rao bound on them.

24 coasts of 45 s at 5 Hz (5400 speeds, about one round trip of a metro line) on level track, speed with white
noise and the resolution of a tachometer. A gust is an AR(1) disturbance of the resistance. As in the paper
speeds are in km/h and parameters are those of ``w(v) = a + b v + c v^2`` [N/kN, v in km/h]; :func:`in_si`
converts them, and :func:`samples` makes samples for the estimators.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.samples import SAMPLE_PERIOD, Sample, coasting_sample
from trainid_ros.train.forces import specific_inertia
from trainid_ros.train.train_file import Davis, Train, TrainFile

Array = NDArray[np.float64]
GAMMA: Final = 0.06
KMH: Final = 1.0 / 3.6
INERTIA: Final = specific_inertia(KMH, GAMMA)
"""Specific force [N/kN] per acceleration [km/h per s], 1000 (1 + gamma) / (3.6 g)."""

PAPER: Final = (0.515, 8.597e-2, 7.512e-4)
"""Parameters of eq. (8) of the paper, v in km/h."""
LARGE_A: Final = (2.031, 6.22e-2, 1.807e-3)
"""A second truth, with a large resistance at standstill."""

GRID: Final = np.linspace(20.0, 80.0, 121)
"""Speeds at which the error of a curve is evaluated [km/h]."""
_GRID_PHI: Final = np.stack([np.ones_like(GRID), GRID, GRID**2], axis=1)
_START_NS: Final = 1_600_000_000 * NS_PER_S
_PAUSE_S: Final = 60


@dataclass(frozen=True, slots=True)
class CoastPlan:
    """Plan of the coasts and their measurement."""

    truth: tuple[float, float, float] = PAPER  # a, b, c with v in km/h
    coasts: int = 24  # Number of coasts
    samples: int = 225  # Speeds in each coast
    # Least speed a coast starts from [km/h]; starts are spread evenly up to ``fastest``, in random order.
    slowest: float = 25.0
    fastest: float = 80.0  # Greatest speed a coast starts from [km/h]
    noise_std: float = 0.027  # White noise of measured speed [km/h]
    quantum: float = 0.1  # Resolution of measured speed [km/h], 0 = not rounded
    gust_std: float = 0.0  # Disturbance of the resistance, an AR(1) process [N/kN]
    gust_time: float = 5.0  # Correlation time of the disturbance [s]
    grade_std: float = 0.0  # Standard deviation of the gradient error, constant in each coast [per mille]

    @property
    def speed_std(self) -> float:
        """Standard deviation of a measured speed, noise and rounding combined [km/h]."""
        return math.hypot(self.noise_std, self.quantum / math.sqrt(12.0))


@dataclass(frozen=True, slots=True)
class Coasts:
    """Coasts driven to a plan; arrays of shape (coasts, samples), one row per coast."""

    plan: CoastPlan  # The plan
    speed: Array  # Measured speed [km/h]
    true_speed: Array  # True speed [km/h]
    disturbance: Array  # Gust and error of the gradient map over the interval after each speed [N/kN]


def drive(plan: CoastPlan, generator: np.random.Generator) -> Coasts:
    """Drive all coasts of a plan."""
    shape = (plan.coasts, plan.samples)
    strata = (generator.permutation(plan.coasts) + generator.uniform(size=plan.coasts)) / plan.coasts
    starts = plan.slowest + (plan.fastest - plan.slowest) * strata
    disturbance = _gusts(plan, generator) + plan.grade_std * generator.standard_normal((plan.coasts, 1))
    true_speed = trajectories(plan.truth, starts, disturbance)
    speed = true_speed + plan.noise_std * generator.standard_normal(shape)
    if plan.quantum:
        speed = plan.quantum * np.round(speed / plan.quantum)
    return Coasts(plan, speed, true_speed, disturbance)


def resistance(theta: tuple[float, ...] | Array, v: Array) -> Array:
    """Return w(v) [N/kN] of parameters and speeds in km/h."""
    a, b, c = theta
    w: Array = a + v * (b + c * v)
    return w


def curve_error(theta: tuple[float, ...] | Array, truth: tuple[float, float, float]) -> float:
    """Return the root mean square error of w(v) over 20-80 km/h [N/kN]."""
    error = _GRID_PHI @ (np.asarray(theta) - np.asarray(truth))
    return float(np.sqrt(np.mean(error**2)))


def curve_std(covariance: Array) -> float:
    """Return the root mean variance of w(v) over 20-80 km/h [N/kN] for a covariance of (a, b, c), shape (3, 3)."""
    return float(np.sqrt(np.mean(np.sum((_GRID_PHI @ covariance) * _GRID_PHI, axis=1))))


def pooled(errors: list[float] | Array) -> float:
    """Return the root mean square of errors over seeds."""
    return float(np.sqrt(np.mean(np.square(errors))))


def cramer_rao(coasts: Coasts, theta_prior: Array | None = None) -> Array:
    """Return the Cramer-Rao bound on (a, b, c) from the measured speeds, shape (3, 3); v in km/h.

    The initial speed of each coast is unknown; statistics of noise, gusts and gradient errors are known. Rounding
    counts as white noise. A prior covariance of the parameters, shape (3, 3), adds information.
    """
    plan = coasts.plan
    information = np.zeros((3, 3)) if theta_prior is None else np.linalg.inv(theta_prior)
    lag = np.abs(np.subtract.outer(np.arange(plan.samples), np.arange(plan.samples)))
    gust = plan.gust_std**2 * np.exp(-SAMPLE_PERIOD * lag / plan.gust_time) + plan.grade_std**2
    for speed in coasts.true_speed:
        response, decay = _responses(plan.truth, speed)
        C = response @ gust @ response.T + plan.speed_std**2 * np.eye(plan.samples)
        phi = np.stack([np.ones_like(speed), speed, speed**2], axis=1)
        J = np.column_stack([response @ phi, decay])
        F = J.T @ np.linalg.solve(C, J)
        # Schur complement: information with the initial speed unknown.
        information += F[:3, :3] - np.outer(F[:3, 3], F[3, :3]) / F[3, 3]
    return np.linalg.inv(information)


def in_si(theta: tuple[float, ...] | Array) -> Davis:
    """Return parameters with v in km/h as parameters with v in m/s."""
    a, b, c = (float(value) for value in theta)
    return Davis(a, b / KMH, c / KMH**2)


def in_kmh(davis: Davis) -> tuple[float, float, float]:
    """Return parameters with v in m/s as parameters with v in km/h."""
    return davis.a, davis.b * KMH, davis.c * KMH**2


def train_file(prior: tuple[float, float, float] = PAPER) -> TrainFile:
    """Return the train of the coasts, with prior parameters (v in km/h)."""
    return TrainFile(Train(mass=200e3, rotary_mass=GAMMA), in_si(prior))


def samples(coasts: Coasts, speed: Array | None = None) -> Iterator[Sample]:
    """Yield the coasts as samples, one after another; a minute passes between two coasts.

    Args:
        coasts: The coasts.
        speed: Measured speeds [km/h] instead of those of the coasts, same shape; NaN is missing.

    """
    measured = coasts.speed if speed is None else speed
    stamp_ns = _START_NS
    for row in measured:
        gap = math.nan
        for value in row:
            stamp_ns += round(SAMPLE_PERIOD * NS_PER_S)
            if math.isnan(value):
                gap += SAMPLE_PERIOD
                continue
            yield coasting_sample(stamp_ns, gap, float(value) * KMH)
            gap = SAMPLE_PERIOD
        stamp_ns += _PAUSE_S * NS_PER_S


def white_observations(
    plan: CoastPlan, generator: np.random.Generator, std: float, count: int = 1032
) -> tuple[Array, Array]:
    """Return speeds [km/h] and observed resistances [N/kN] in white noise, shape (count,) each, coast by coast.

    The assumption of the estimators in section 3 of the paper; the coasts contain 1032 windows of 11 samples.
    """
    true_speed = drive(plan, generator).true_speed
    per_coast = -(-count // plan.coasts)
    middles = np.linspace(5, plan.samples - 6, per_coast).round().astype(int)
    v = true_speed[:, middles].ravel()[:count]
    return v, resistance(plan.truth, v) + std * generator.standard_normal(count)


def _gusts(plan: CoastPlan, generator: np.random.Generator) -> Array:
    noise = generator.standard_normal((plan.coasts, plan.samples))
    rho = math.exp(-SAMPLE_PERIOD / plan.gust_time)
    gusts = np.empty_like(noise)
    gusts[:, 0] = noise[:, 0]
    for i in range(1, plan.samples):
        gusts[:, i] = rho * gusts[:, i - 1] + math.sqrt(1.0 - rho * rho) * noise[:, i]
    return plan.gust_std * gusts


def trajectories(truth: tuple[float, float, float], starts: Array, disturbance: Array) -> Array:
    """Integrate dv/dt = -(w(v) + d) / inertia by Runge-Kutta, with d constant over each step."""
    speed = np.empty_like(disturbance)
    speed[:, 0] = starts
    h = SAMPLE_PERIOD
    for i in range(speed.shape[1] - 1):
        v, d = speed[:, i], disturbance[:, i]
        k1 = -(resistance(truth, v) + d) / INERTIA
        k2 = -(resistance(truth, v + 0.5 * h * k1) + d) / INERTIA
        k3 = -(resistance(truth, v + 0.5 * h * k2) + d) / INERTIA
        k4 = -(resistance(truth, v + h * k3) + d) / INERTIA
        speed[:, i + 1] = v + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return speed


def _responses(truth: tuple[float, float, float], speed: Array) -> tuple[Array, Array]:
    """Return the response of the speeds to a force in each interval, shape (N, N), and to the initial speed, (N,)."""
    _, b, c = truth
    rate = (b + 2.0 * c * speed) / INERTIA
    exponent = np.concatenate([[0.0], np.cumsum(0.5 * SAMPLE_PERIOD * (rate[1:] + rate[:-1]))])
    decay = np.exp(-exponent)
    # A force in interval j acts, on average, from its midpoint.
    middle = np.exp(0.5 * (exponent + np.append(exponent[1:], exponent[-1])))
    response = np.tril(np.outer(decay, middle), -1) * (-SAMPLE_PERIOD / INERTIA)
    return response, decay
