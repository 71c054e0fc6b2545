# SPDX-License-Identifier: Apache-2.0
"""KF and IMM: brake rate by Kalman filters on [v, a, b, e, f].

KF is exact for a brake rate that drifts. IMM mixes two filters, one for a rate that drifts and one for a rate that
jumps: the interacting multiple model of Blom and Bar-Shalom. Each step starts every model from the mixture given by the
Markov chain of the models, so a jump is detected as soon as the wide model explains the speed better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trainid_lab.brake_rate import gaussian
from trainid_lab.brake_rate.particles import Array, errors_of
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.gsma import drifts, transition
from trainid_ros.brake_rate.motion_model import NO_ERRORS, STATES, Errors, Start, Transition
from trainid_ros.estimators.settings import BrakeRateConfig, JumpConfig
from trainid_ros.interface.state import State, declare, decode, definite, encode
from trainid_ros.interface.vectors import vec

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.train.train_file import TrainFile

Moments = tuple[Array, Array]
Models = tuple[Moments, Moments]
# The probability of a jump stays below one, because the mixing divides by that of the quiet model.
_MAX_PROBABILITY: Final = 1.0 - 1e-12


@dataclass(frozen=True, slots=True)
class KalmanConfig(BrakeRateConfig):
    """Settings of KF."""


class GaussianPosterior:
    """Posterior by its first two moments; subclasses say what it is made of."""

    m: Array  # Mean of z = [v, a, b, e, f], shape (n + 1,)
    P: Array  # Its covariance, shape (n + 1, n + 1)

    def change(self, change: Callable[[Array, Array], Moments]) -> None:
        """Change mean and covariance of each part."""
        raise NotImplementedError

    @property
    def rate(self) -> float:
        """Mean of f [1]."""
        return float(self.m[STATES])

    @property
    def variance(self) -> float:
        """Variance of f [1]."""
        return float(self.P[STATES, STATES])

    def total_rate(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance of f + share e [1]."""
        along = np.array([0.0, 0.0, 0.0, *share, 1.0])
        return float(along.dot(self.m)), float(along.dot(self.P).dot(along))

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""
        return float(self.m[0])

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""
        return float(self.m[1])

    @property
    def errors(self) -> Errors:
        """Means of the errors of the train file."""
        return errors_of(self.m[3:STATES])

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors of the train file."""
        return errors_of(np.diag(self.P)[3:STATES])

    def reinit_motion(self, start: Start) -> None:
        """Restart v, a and b."""
        self.change(lambda m, P: gaussian.anchored(m, P, start))

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""
        self.change(lambda m, P: gaussian.recentred(m, P, shift))

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval."""
        self.change(lambda m, P: gaussian.predict(m, P, interval))

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v."""
        return float(self.m[0]), float(self.P[0, 0])

    def follow(self, speed: float, r: float) -> None:
        """Update without f, with a measured speed [m/s] of variance r [(m/s)^2]."""
        self.change(lambda m, P: gaussian.update(m, P, speed, r, learns=False))


class KalmanPosterior(GaussianPosterior):
    """One Gaussian."""

    STATE: ClassVar[State] = declare('m', definite('P'))
    effective = 1.0

    def __init__(self, config: KalmanConfig) -> None:
        self._q = config.drift**2
        self.m, self.P = gaussian.prior(0.0, 0.0, NO_ERRORS)

    def change(self, change: Callable[[Array, Array], Moments]) -> None:
        """Change the Gaussian."""
        self.m, self.P = change(self.m, self.P)

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior."""
        self.m, self.P = gaussian.prior(rate, std, error_stds)

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update with a measured speed [m/s] of variance r [(m/s)^2]; f drifted over ``elapsed`` [s]."""
        P = gaussian.drift(self.P, interval.gain_v, interval.gain_a, self._q * elapsed)
        m, P = gaussian.update(self.m, P, speed, r, learns=True)
        if not math.isfinite(m.sum() + P.sum()):
            return False
        self.m, self.P = m, P
        return True


def kalman(train_file: TrainFile, config: KalmanConfig, rng: np.random.Generator) -> BrakeRateEstimator:  # noqa: ARG001
    """Return the linear Kalman filter."""
    return BrakeRateEstimator(train_file, config, KalmanPosterior(config))


@dataclass(frozen=True, slots=True)
class ImmConfig(JumpConfig):
    """Settings of IMM."""


@dataclass(frozen=True, slots=True)
class ImmState:
    """Probability of the jumping model, means of z = [v, a, b, e, f], shape (2, n + 1), covariances (2, n + 1, n + 1).

    The quiet model is the first.
    """

    jumping: float
    means: NDArray[np.float64]
    covariances: NDArray[np.float64]


class ImmPosterior(GaussianPosterior):
    """Two Gaussians, the quiet one first, after mixing for the next step."""

    def __init__(self, config: ImmConfig) -> None:
        self._config = config
        self._q = drifts(config)
        empty = gaussian.prior(0.0, 0.0, NO_ERRORS)
        self._take(0.0, (empty, empty))

    def _take(self, jumping: float, models: Models) -> None:
        """Set the mixture and cache its moments."""
        self.jumping, self.models = jumping, models
        weights = (1.0 - jumping, jumping)
        self.m, self.P = gaussian.mixed(weights, (models[0][0], models[1][0]), (models[0][1], models[1][1]))

    @property
    def effective(self) -> float:
        """Effective number of models, 1 to 2."""
        return 1.0 / (self.jumping**2 + (1.0 - self.jumping) ** 2)

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior."""
        prior = gaussian.prior(rate, std, error_stds)
        self._take(0.0, (prior, prior))

    def change(self, change: Callable[[Array, Array], Moments]) -> None:
        """Change both Gaussians."""
        quiet, jump = self.models
        self._take(self.jumping, (change(*quiet), change(*jump)))

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update with a measured speed [m/s] of variance r [(m/s)^2]; then mix for the next step."""
        quiet, pause = self._q[0], elapsed - interval.dt
        likelihoods, updated = [], []
        for (m, P), q in zip(self.models, self._q, strict=True):
            walk = quiet * elapsed + interval.steadiness * (q - quiet) * interval.dt
            drifted = gaussian.drift(P, interval.gain_v, interval.gain_a, walk)
            S, nu = float(drifted[0, 0]) + r, speed - float(m[0])
            likelihoods.append(-0.5 * (nu * nu / S + math.log(S)))
            updated.append(gaussian.update(m, drifted, speed, r, learns=True))
        if not all(math.isfinite(m.sum() + P.sum()) for m, P in updated):
            return False
        jumping = _posterior(self.jumping, likelihoods[1] - likelihoods[0])
        self._mix(jumping, (updated[0], updated[1]), interval.steadiness * interval.dt, max(0.0, pause))
        return True

    def _mix(self, jumping: float, models: Models, dt: float, pause: float) -> None:
        starts, ends = transition(self._config, dt, pause)
        means, covs = (models[0][0], models[1][0]), (models[0][1], models[1][1])
        into_jump = starts * (1.0 - jumping), (1.0 - ends) * jumping
        after = min(sum(into_jump), _MAX_PROBABILITY)  # after a long pause a jump is almost certain
        quiet_share = (1.0 - starts) * (1.0 - jumping) / (1.0 - after)
        quiet = gaussian.mixed((quiet_share, 1.0 - quiet_share), means, covs)
        jump = models[1]
        if after > 0.0:
            jump_share = into_jump[1] / after
            jump = gaussian.mixed((1.0 - jump_share, jump_share), means, covs)
        self._take(after, (quiet, jump))

    def save(self) -> str:
        """Return the complete state as JSON text."""
        means, covariances = (np.array(parts) for parts in zip(*self.models, strict=True))
        return encode(ImmState(self.jumping, means, covariances))

    def restore(self, text: str) -> None:
        """Restore a saved state."""
        state = decode(text, ImmState)
        (m0, m1), (P0, P1) = state.means, state.covariances
        self._take(state.jumping, ((m0, P0), (m1, P1)))


def _posterior(prior: float, log_ratio: float) -> float:
    """Return the posterior probability of the jumping model from the log-likelihood ratio to the quiet one."""
    if prior <= 0.0:
        return 0.0
    odds = math.log(prior) - math.log1p(-prior) + log_ratio
    return min(1.0 / (1.0 + math.exp(min(-odds, 700.0))), _MAX_PROBABILITY)


def imm(train_file: TrainFile, config: ImmConfig, rng: np.random.Generator) -> BrakeRateEstimator:  # noqa: ARG001
    """Return the interacting multiple model of a drifting and a jumping brake rate."""
    return BrakeRateEstimator(train_file, config, ImmPosterior(config))
