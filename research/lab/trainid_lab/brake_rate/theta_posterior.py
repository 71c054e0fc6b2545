# SPDX-License-Identifier: Apache-2.0
"""RBPF, SMA and GSMA as printed: posterior of weighted particles with one shared covariance.

In Zheng et al. 2015, section 3.3, f is static: after some resampling all particles of the RBPF have the same value.
Here f is a random walk of variance q per second, so the values stay distinct. SMA and GSMA are as printed in sections
3.4, 3.5 and 4, on the dynamics of :mod:`brake_rate_estimator`, for comparison only: f is restricted to a grid, the N
particles of highest weight survive, weights are not retained between samples, and the transition is one grid step per
sample, whatever the time between samples.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_lab.brake_rate.particles import (
    SPEED,
    Array,
    Correction,
    LinearStep,
    effective_number,
    error_covariance,
    errors_of,
    speed_correction,
    speed_step,
    started,
)
from trainid_lab.brake_rate.theta_cloud import MRule, ThetaCloud, all_values, m_algorithm, printed_groups, rbpf
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.motion_model import STATES, Errors, Start, Transition
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.errors import check_settings, setting
from trainid_ros.interface.state import decode, encode
from trainid_ros.interface.vectors import vec
from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class ThetaState:
    """State of the posterior, arrays as in :class:`ThetaCloud`; state of the random generator as JSON text."""

    f: NDArray[np.float64]
    log_weights: NDArray[np.float64]
    x: NDArray[np.float64]
    P: NDArray[np.float64]
    random: str


class ThetaPosterior:
    """Weighted particles (f, x = [v, a, b, e])."""

    def __init__(self, most: int, rng: np.random.Generator) -> None:
        self._most = most
        self.rng = rng
        self._random0 = json.dumps(rng.bit_generator.state)
        self.P: Array = np.zeros((STATES, STATES))
        self.take(ThetaCloud(np.zeros(1), np.zeros(1), np.zeros((STATES, 1))))

    def take(self, cloud: ThetaCloud) -> None:
        """Set the particles and cache their weights and moments."""
        # Sums depend on the memory layout, and restored arrays are contiguous.
        self.cloud = cloud = cloud._replace(x=np.ascontiguousarray(cloud.x))
        self._weights = cloud.weights
        self._rate = float(cloud.f @ self._weights)
        self._variance = float(np.square(cloud.f - self._rate) @ self._weights)

    @property
    def rate(self) -> float:
        """Mean of f [1]."""
        return self._rate

    @property
    def variance(self) -> float:
        """Variance of f [1]."""
        return self._variance

    def total_rate(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance of f + share e [1]."""
        along = np.array(list(share))
        total = self.cloud.f + along @ self.cloud.x[3:]
        mean = float(total @ self._weights)
        variance = float(np.square(total - mean) @ self._weights) + float(along @ self.P[3:, 3:] @ along)
        return mean, variance

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""
        return float(self.cloud.x[0] @ self._weights)

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""
        return float(self.cloud.x[1] @ self._weights)

    @property
    def effective(self) -> float:
        """Effective number of particles [1]."""
        return effective_number(self._weights)

    @property
    def errors(self) -> Errors:
        """Means of the errors of the train file."""
        return errors_of(self.cloud.x[3:] @ self._weights)

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors of the train file."""
        e = self.cloud.x[3:]
        spread = np.square(e - (e @ self._weights)[:, None]) @ self._weights
        return errors_of(np.diag(self.P)[3:] + spread)

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior."""
        f = self.first_values(rate, std)
        self.P = error_covariance(error_stds)
        self.rng.bit_generator.state = json.loads(self._random0)
        self.take(ThetaCloud(f, np.full(len(f), -math.log(len(f))), np.zeros((STATES, len(f)))))

    def first_values(self, rate: float, std: float) -> Array:
        """Return the initial values of f [1], shape (N,)."""
        raise NotImplementedError

    def reinit_motion(self, start: Start) -> None:
        """Restart v, a and b."""
        f, decay_e = self.cloud.f, np.array(list(start.decay_e))[:, None]
        x = np.vstack([np.full(len(f), start.speed), start.target * f, np.zeros(len(f)), decay_e * self.cloud.x[3:]])
        self.cloud = ThetaCloud(f, self.cloud.log_weights, x)
        self.P = started(self.P, start)

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""
        x = self.cloud.x - np.array([0.0, 0.0, 0.0, *shift])[:, None]
        self.cloud = ThetaCloud(self.cloud.f, self.cloud.log_weights, x)

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval."""
        self._step = speed_step(interval)
        self.cloud = ThetaCloud(self.cloud.f, self.cloud.log_weights, self._step.predict(self.cloud.x, self.cloud.f))
        self.P = self._step.predict_covariance(self.P)

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v."""
        mean = self.speed
        return mean, float(self.P[0, 0] + np.square(self.cloud.x[0] - mean) @ self._weights)

    def follow(self, speed: float, r: float) -> None:
        """Update without f, with a measured speed [m/s] of variance r [(m/s)^2]."""
        fix = speed_correction(self.P, r)
        x = self.cloud.x + fix.K @ (speed - SPEED @ self.cloud.x)
        self.cloud = ThetaCloud(self.cloud.f, self.cloud.log_weights, x)
        self.P = fix.P

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update with a measured speed [m/s] of variance r [(m/s)^2]; f drifted over ``elapsed`` [s]."""
        fix = speed_correction(self.P, r)
        cloud = self.learned(self._step, fix, np.array([speed]), interval.dt, elapsed)
        if not math.isfinite(cloud.x.sum() + cloud.f.sum() + fix.P.sum()):
            return False
        self.take(cloud)
        self.P = fix.P
        return True

    def learned(self, step: LinearStep, fix: Correction, y: Array, dt: float, elapsed: float) -> ThetaCloud:
        """Return the particles after a measurement ``dt`` [s] after the last; f drifted over ``elapsed`` [s]."""
        raise NotImplementedError

    def save(self) -> str:
        """Return the complete state, including the random generator, as JSON text."""
        c = self.cloud
        return encode(ThetaState(c.f, c.log_weights, c.x, self.P, json.dumps(self.rng.bit_generator.state)))

    def restore(self, text: str) -> None:
        """Restore a saved state."""
        state = decode(text, ThetaState)
        self.rng.bit_generator.state = json.loads(state.random)
        self.take(ThetaCloud(state.f, state.log_weights, state.x))
        self.P = state.P


@dataclass(frozen=True, slots=True)
class RbpfConfig(BrakeRateConfig):
    """Settings of RBPF."""

    particles: int = setting(500, 'number of particles', '1', 2, 100_000)


class RbpfPosterior(ThetaPosterior):
    """Particles that start at the quantiles of the prior and drift."""

    def __init__(self, config: RbpfConfig, rng: np.random.Generator) -> None:
        super().__init__(config.particles, rng)
        self._config = config

    def first_values(self, rate: float, std: float) -> Array:
        """Return the quantiles of the prior of f [1]."""
        prior, N = NormalDist(rate, std), self._config.particles
        return np.array([max(0.0, prior.inv_cdf((i + 0.5) / N)) for i in range(N)])

    def learned(self, step: LinearStep, fix: Correction, y: Array, dt: float, elapsed: float) -> ThetaCloud:  # noqa: ARG002
        """Return the particles after a measurement; f drifted over ``elapsed`` [s]."""
        std = self._config.drift * math.sqrt(elapsed)
        jitter = std * self.rng.standard_normal(len(self.cloud.f))
        return rbpf(self.cloud, step, fix, SPEED, y, jitter, float(self.rng.random()))


def rao_blackwellised(train_file: TrainFile, config: RbpfConfig, rng: np.random.Generator) -> BrakeRateEstimator:
    """Return the Rao-Blackwellised particle filter."""
    check_settings(config)
    return BrakeRateEstimator(train_file, config, RbpfPosterior(config, rng))


# Grid of the paper: 1.0, 0.9 ... 0.
GRID: Final = np.round(np.linspace(1.0, 0.0, 11), 12)
# The group {1.0, 0.9, 0.8} is missing in the paper.
PRINTED_FIRST: Final = 2


@dataclass(frozen=True, slots=True)
class PrintedConfig(BrakeRateConfig):
    """Settings of SMA and of GSMA as printed."""

    particles: int = setting(50, 'particles kept after pruning, N', '1', 2, 10_000)
    most_particles: int = setting(500, 'number of particles above which they are pruned, Q', '1', 2, 100_000)


class PrintedPosterior(ThetaPosterior):
    """Particles on the printed grid."""

    def __init__(self, config: PrintedConfig, rng: np.random.Generator, branch: Callable[[Array], Array]) -> None:
        super().__init__(max(config.particles, len(GRID) * config.most_particles), rng)
        self._config = config
        self._rule = MRule(config.particles, config.most_particles, carries=False, stochastic=False)
        self._branch = branch

    def first_values(self, rate: float, std: float) -> Array:  # noqa: ARG002 - as printed, without a prior
        """Return the values of the grid [1], repeated in turn."""
        return np.resize(GRID, self._config.particles)

    def learned(self, step: LinearStep, fix: Correction, y: Array, dt: float, elapsed: float) -> ThetaCloud:  # noqa: ARG002
        """Return the particles after a measurement; the estimate is the mean of the survivors."""
        children = self._branch(self.cloud.f)
        return m_algorithm(self.cloud, children, step, fix, SPEED, y, self._rule, 0.0)[1]


def sma(train_file: TrainFile, config: PrintedConfig, rng: np.random.Generator) -> BrakeRateEstimator:
    """Return the stochastic M-algorithm as printed."""
    check_settings(config)
    values = PrintedPosterior(config, rng, lambda f: all_values(GRID, f))
    return BrakeRateEstimator(train_file, config, values)


def printed_gsma(train_file: TrainFile, config: PrintedConfig, rng: np.random.Generator) -> BrakeRateEstimator:
    """Return the group stochastic M-algorithm as printed."""
    check_settings(config)
    groups = PrintedPosterior(config, rng, lambda f: printed_groups(GRID, f, PRINTED_FIRST))
    return BrakeRateEstimator(train_file, config, groups)
