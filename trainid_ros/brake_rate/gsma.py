# SPDX-License-Identifier: Apache-2.0
"""GSMA: brake rate by the group stochastic M-algorithm, a Rao-Blackwellised particle filter.

The algorithm and its differences from Zheng et al. 2015 are in :mod:`group_cloud`, the motion model and the selection
of samples in :mod:`brake_rate_estimator`. With two strata, one for a drifting and one for a jumping brake rate, it
detects a jump within seconds; without jumps it is the exact filter except for sampling noise.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.brake_rate import group_cloud
from trainid_ros.brake_rate.brake_rate_estimator import LARGEST_RATE, BrakeRateEstimator
from trainid_ros.brake_rate.group_cloud import GroupCloud, Strata
from trainid_ros.brake_rate.jumps import JumpConfig, drifts, transition
from trainid_ros.brake_rate.motion_model import true_brake
from trainid_ros.brake_rate.particles import (
    SPEED,
    error_covariance,
    speed_correction,
    speed_step,
    started,
)
from trainid_ros.brake_rate.posterior import NO_ERRORS, STATES, Errors, Start, Transition, errors_of
from trainid_ros.brake_rate.resampling import effective_number, restore_generator
from trainid_ros.errors import InputError
from trainid_ros.estimators.compiled.jit import require_compiler
from trainid_ros.settings import check_settings, setting
from trainid_ros.state import check_not_negative, check_numbers, check_restored, decode, encode, is_covariance_matrix

if TYPE_CHECKING:
    from trainid_ros.brake_rate.particles import Array
    from trainid_ros.train.train_file import TrainFile

_JUMPING_SHARE: Final = 1.0 / 3.0
_LEAST_PARTICLES: Final = 3
_ROUNDING: Final = 1e-6
LEAST_PAUSE: Final = 1e-6
"""Shorter times without braking are rounding [s]."""


@dataclass(frozen=True, slots=True)
class GsmaConfig(JumpConfig):
    """Settings of GSMA."""

    particles: int = setting(100, 'particles kept after pruning, a third of them for jumps', '1', 6, 100_000)
    compiled: int = setting(0, '1: faster compiled loop, needs trainid_ros[fast]; starts seconds later', '1', 0, 1)


@dataclass(frozen=True, slots=True)
class GsmaState:
    """Posterior of GSMA; arrays as in :class:`GroupCloud`.

    Attributes:
        P: Covariance of x = [v, a, b, e], shared by all particles, shape (n, n).
        effective: Effective number of children in the last step that updated f [1].
        random: State of the generator as JSON text.

    """

    f: NDArray[np.float64]
    x: NDArray[np.float64]
    weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    slope: NDArray[np.float64]
    P: NDArray[np.float64]
    effective: float
    random: str


class GsmaPosterior:
    """Particles in a quiet and a jumping stratum."""

    def __init__(self, config: GsmaConfig, expected: float, rng: np.random.Generator) -> None:
        self._config = config
        self._largest = LARGEST_RATE * expected
        self._rng = rng
        self._random0 = json.dumps(rng.bit_generator.state)
        jumping = max(_LEAST_PARTICLES, round(_JUMPING_SHARE * config.particles)) if config.jump_rate > 0.0 else 0
        self.strata = Strata.divide([config.particles - jumping, jumping][: 2 if jumping else 1])
        self._q = np.array(drifts(config)[: len(self.strata.sizes)])
        self._counts = np.array(self.strata.sizes, dtype=float)
        self.reset(expected, config.prior_std, NO_ERRORS)

    @property
    def rate(self) -> float:
        """Mean of f [1]."""
        return self._rate

    @property
    def variance(self) -> float:
        """Variance of f [1]."""
        return self._variance

    def total_rate(self, share: Array) -> tuple[float, float]:
        """Return mean and variance of f + share e [1]: from the particles, plus the variance of e given f from P."""
        off, e = self.cloud.f - self._rate, self.cloud.x[3:]
        extra = share.dot(e)
        mean = float(extra.dot(self._weights))
        extra -= mean
        cross = float((off * extra).dot(self._weights))
        square = float((extra * extra).dot(self._weights)) + float(share.dot(self.P[3:, 3:]).dot(share))
        return self._rate + mean, self._variance + 2.0 * cross + square

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""
        return float(self.cloud.x[0].dot(self._weights))

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""
        return float(self.cloud.x[1] @ self._weights)

    @property
    def effective(self) -> float:
        """Effective number of children in the last step that updated f [1]."""
        return self._effective

    @property
    def errors(self) -> Errors:
        """Means of the errors of the train file."""
        return errors_of(self.cloud.x[3:].dot(self._weights))

    def _take(self, cloud: GroupCloud) -> None:
        """Set the particles and cache their weights and moments."""
        self.cloud = cloud
        self._weights = (cloud.weight / self._counts).take(self.strata.of)
        self._rate, self._variance = cloud.rate, cloud.total_variance

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors of the train file."""
        within, e = np.diag(self.P)[3:], self.cloud.x[3:]
        spread = np.square(e - e.dot(self._weights)[:, None]).dot(self._weights)
        return errors_of(within + spread)

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior: particles at its quantiles, strata at the stationary weights of the Markov chain."""
        # The normal distribution of the standard library, because importing that of SciPy is slow.
        prior = NormalDist(rate, std)
        f = np.concatenate([[max(0.0, prior.inv_cdf((i + 0.5) / n)) for i in range(n)] for n in self.strata.sizes])
        starts, ends = transition(self._config, 1.0)
        weight = np.array([ends, starts][: len(self.strata.sizes)])
        mean = f @ self.strata.average
        variance = np.square(f - mean[self.strata.of]) @ self.strata.average
        x, slope = np.zeros((STATES, len(f))), np.zeros((STATES, len(self.strata.sizes)))
        self._take(GroupCloud.of(f, x, weight / weight.sum(), mean, variance, slope))
        self.P = error_covariance(error_stds)
        self._effective = float(len(f))
        self._rng.bit_generator.state = json.loads(self._random0)

    def anchor(self, start: Start) -> None:
        """Restart v, a and b."""
        first, slope = np.zeros(STATES), np.zeros(STATES)
        first[0], slope[1] = start.speed, start.target
        self.cloud = group_cloud.anchored(self.cloud, first, slope, np.array([0.0, 0.0, 0.0, *start.keep]))
        self.P = started(self.P, start)

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""
        known = np.array([0.0, 0.0, 0.0, *shift])
        self.cloud = group_cloud.anchored(self.cloud, -known, np.zeros(STATES), np.ones(STATES))

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval."""
        self._step = speed_step(interval)
        self.cloud = group_cloud.predicted(self.cloud, self._step)
        self.P = self._step.predict_covariance(self.P)

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v."""
        v, mean = self.cloud.x[0], self.speed
        return mean, float(self.P[0, 0] + np.square(v - mean) @ self._weights)

    def follow(self, speed: float, r: float) -> None:
        """Update without f, with a measured speed [m/s] of variance r [(m/s)^2]."""
        fix = speed_correction(self.P, r)
        self.cloud = group_cloud.followed(self.cloud, fix, SPEED, np.array([speed]))
        self.P = fix.P

    def learn(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update with a measured speed [m/s] of variance r [(m/s)^2]: one step of GSMA, eqs. (14)-(22)."""
        step, config, dt = self._step, self._config, interval.dt
        fix = speed_correction(self.P, r)
        cloud, pause = self.cloud, elapsed - dt
        if pause > LEAST_PAUSE:
            cloud = group_cloud.widened(cloud, step, config.drift**2 * pause)
        groups = group_cloud.branch(cloud, self.strata, step, self._walk(interval.calm) * dt)
        children, weights = group_cloud.weigh(groups, fix, SPEED, np.array([speed]), self._largest)
        chain, uniforms = self._chain(interval.calm * dt, pause), self._rng.random(len(self._q))
        cloud = group_cloud.prune(children, weights, self.strata, chain, uniforms)
        if not math.isfinite(cloud.z.sum() + fix.P.sum()):
            return False
        self._take(cloud)
        self.P = fix.P
        self._effective = effective_number(weights)
        return True

    def _walk(self, calm: float) -> Array:
        """Return the variance of f in each stratum [1/s]; a jump is possible only as far as the response is steady."""
        walk: Array = self._q[0] + calm * (self._q - self._q[0])
        return walk

    def _chain(self, dt: float, pause: float) -> Array:
        """Return the transition probabilities between the strata; times in [s]."""
        if len(self._q) == 1:
            return np.ones((1, 1))
        starts, ends = transition(self._config, dt, max(0.0, pause))
        return np.array([[1.0 - starts, starts], [ends, 1.0 - ends]])

    def save(self) -> str:
        """Return the complete state, including the random generator, as JSON text."""
        c, random = self.cloud, json.dumps(self._rng.bit_generator.state)
        return encode(GsmaState(c.f, c.x, c.weight, c.mean, c.variance, c.slope, self.P, self._effective, random))

    def restore(self, text: str) -> None:
        """Restore a saved state."""
        state = decode(text, GsmaState)
        N, M = len(self.strata.of), len(self.strata.sizes)
        if len(state.f) != N:
            msg = f'saved GsmaState has {len(state.f)} particles, not {N}'
            raise InputError(msg)
        arrays = (state.f, state.x, state.weight, state.mean, state.variance, state.slope, state.P)
        shapes = ((N,), (STATES, N), (M,), (M,), (M,), (STATES, M), (STATES, STATES))
        sized = tuple(item.shape for item in arrays) == shapes
        check_numbers(state)
        check_restored(sized and is_covariance_matrix(state.P), 'GsmaState', 'an array')
        check_restored(abs(float(state.weight.sum()) - 1.0) < _ROUNDING, 'GsmaState', 'weight')
        least = min(float(state.weight.min()), float(state.variance.min()), state.effective)
        check_not_negative('GsmaState', least_weight_or_variance=least)
        restore_generator(self._rng, state.random, 'GsmaState')
        self._take(GroupCloud.of(*arrays[:6]))
        self.P, self._effective = state.P, state.effective


class Gsma(BrakeRateEstimator):
    """Group stochastic M-algorithm."""

    def __init__(self, train_file: TrainFile, config: GsmaConfig, rng: np.random.Generator) -> None:
        check_settings(config)
        kind: type[GsmaPosterior] = GsmaPosterior
        if config.compiled:
            require_compiler()
            from trainid_ros.estimators.compiled.compiled_gsma import CompiledGsmaPosterior  # noqa: PLC0415

            kind = CompiledGsmaPosterior
        super().__init__(train_file, config, kind(config, true_brake(train_file).rate, rng))
