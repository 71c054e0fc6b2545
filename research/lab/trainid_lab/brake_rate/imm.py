# SPDX-License-Identifier: Apache-2.0
"""IMM: two mixing Kalman filters, one for a brake rate that drifts and one for a brake rate that jumps.

The interacting multiple model of Blom and Bar-Shalom: each step starts every model from the mixture given by the
Markov chain of the models, so a jump is detected as soon as the wide model explains the speed better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from trainid_lab.brake_rate import gaussian
from trainid_lab.brake_rate.particles import Array, errors_of
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.gsma import drifts, transition
from trainid_ros.brake_rate.motion_model import NO_ERRORS, STATES, Errors, Start, Transition
from trainid_ros.estimators.settings import JumpConfig
from trainid_ros.interface.state import decode, encode
from trainid_ros.interface.vectors import vec

if TYPE_CHECKING:
    from trainid_ros.train.train_file import TrainFile

    Models = tuple[tuple[Array, Array], tuple[Array, Array]]

# The probability of a jump stays below one, because the mixing divides by that of the quiet model.
_MAX_PROBABILITY: Final = 1.0 - 1e-12


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


class ImmPosterior:
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
        self._m, self._P = gaussian.mixed(weights, (models[0][0], models[1][0]), (models[0][1], models[1][1]))

    @property
    def rate(self) -> float:
        """Mean of f [1]."""
        return float(self._m[STATES])

    @property
    def variance(self) -> float:
        """Variance of f [1]."""
        return float(self._P[STATES, STATES])

    def total_rate(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance of f + share e [1]."""
        return gaussian.total_rate(self._m, self._P, share)

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""
        return float(self._m[0])

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""
        return float(self._m[1])

    @property
    def effective(self) -> float:
        """Effective number of models, 1 to 2."""
        return 1.0 / (self.jumping**2 + (1.0 - self.jumping) ** 2)

    @property
    def errors(self) -> Errors:
        """Means of the errors of the train file."""
        return errors_of(self._m[3:STATES])

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors of the train file."""
        return errors_of(np.diag(self._P)[3:STATES])

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior."""
        prior = gaussian.prior(rate, std, error_stds)
        self._take(0.0, (prior, prior))

    def reinit_motion(self, start: Start) -> None:
        """Restart v, a and b."""
        first, second = (gaussian.anchored(m, P, start) for m, P in self.models)
        self._take(self.jumping, (first, second))

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""
        (m0, P0), (m1, P1) = self.models
        self._take(self.jumping, ((gaussian.recentred(m0, shift), P0), (gaussian.recentred(m1, shift), P1)))

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval."""
        (m0, P0), (m1, P1) = self.models
        self._take(self.jumping, (gaussian.predict(m0, P0, interval), gaussian.predict(m1, P1, interval)))

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v."""
        return float(self._m[0]), float(self._P[0, 0])

    def follow(self, speed: float, r: float) -> None:
        """Update without f, with a measured speed [m/s] of variance r [(m/s)^2]."""
        (m0, P0), (m1, P1) = self.models
        quiet = gaussian.update(m0, P0, speed, r, learns=False)
        self._take(self.jumping, (quiet, gaussian.update(m1, P1, speed, r, learns=False)))

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
