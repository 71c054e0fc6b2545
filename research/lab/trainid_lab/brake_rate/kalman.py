# SPDX-License-Identifier: Apache-2.0
"""KF and IMM: brake rate by Kalman filters on z = [x, f], x = [v, a, b, e].

f enters speed v and brake acceleration a with known coefficients (Zheng et al. 2015, eqs. (1), (2): f multiplies the
command after its dead time), so no particles are needed: the Kalman filter is the exact posterior of a Gaussian random
walk of f. IMM mixes two filters, one for a rate that drifts and one for a rate that jumps: the interacting multiple
model of Blom and Bar-Shalom. Each step starts every model from the mixture given by the Markov chain of the models, so
a jump is detected as soon as the wide model explains the speed better.

Means have the shape (n + 1,), covariances (n + 1, n + 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trainid_lab.brake_rate.particles import Array, error_covariance, errors_of, speed_step, started
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.gsma import drifts, transition
from trainid_ros.brake_rate.motion_model import ERRORS, NO_ERRORS, STATES, Errors, Start, Transition
from trainid_ros.estimators.settings import BrakeRateConfig, JumpConfig
from trainid_ros.interface.state import State, declare, decode, definite, encode
from trainid_ros.interface.vectors import vec
from trainid_ros.train.train_file import TrainFile


def prior(rate: float, std: float, error_stds: Errors) -> tuple[Array, Array]:
    """Return the prior mean and covariance; ``rate`` and ``std`` of f [1], errors as in :class:`Transition`."""
    m, P = np.zeros(STATES + 1), np.zeros((STATES + 1, STATES + 1))
    P[:STATES, :STATES] = error_covariance(error_stds)
    m[STATES], P[STATES, STATES] = rate, std * std
    return m, P


def predict(m: Array, P: Array, interval: Transition) -> tuple[Array, Array]:
    """Predict x = F x + known input, P = F P F' + Q; f is constant."""
    step = speed_step(interval)
    F = np.eye(STATES + 1)
    F[:STATES, :STATES], F[:STATES, STATES] = step.Phi, step.gamma
    mean = F.dot(m)
    mean[:STATES] += step.known
    cov = F.dot(P).dot(F.T)
    cov[:STATES, :STATES] += step.Q
    return mean, cov


def drift(P: Array, gain_v: float, gain_a: float, q: float) -> Array:
    """Add the drift of f over an interval, of variance q [1]; it acted on v and a from the start of the interval."""
    along = np.zeros(STATES + 1)
    along[0], along[1], along[STATES] = gain_v, gain_a, 1.0
    after: Array = P + np.outer(q * along, along)
    return after


def update(m: Array, P: Array, speed: float, r: float, *, learns: bool) -> tuple[Array, Array]:
    """Update with a measured speed [m/s] of variance r [(m/s)^2], K = P h / S.

    With ``learns`` False the gain of f is zero and f is unchanged (Schmidt-Kalman filter).
    """
    column = P[0].copy()
    S = float(column[0]) + r
    kept = P[STATES, STATES]
    cov = P - np.outer(column, column / S)
    if not learns:
        cov[STATES, STATES] = kept
        column[STATES] = 0.0
    return m + column * ((speed - float(m[0])) / S), cov


def anchored(m: Array, P: Array, start: Start) -> tuple[Array, Array]:
    """Restart v, a = f target and b; f is unchanged, and the errors e decay by ``decay_e`` and gain ``q_e``."""
    f, ff, decay_e = float(m[STATES]), float(P[STATES, STATES]), np.array(list(start.decay_e))
    mean, cov = np.concatenate([[start.speed, f * start.target, 0.0], decay_e * m[3:STATES], [f]]), np.zeros_like(P)
    cov[:STATES, :STATES] = started(P[:STATES, :STATES], start)
    with_f = np.concatenate([[0.0, ff * start.target, 0.0], decay_e * P[3:STATES, STATES]])
    cov[:STATES, STATES] = cov[STATES, :STATES] = with_f
    # a = f target is correlated with the errors through f.
    cov[1, 3:STATES] = cov[3:STATES, 1] = start.target * with_f[3:]
    cov[1, 1] += ff * start.target**2
    cov[STATES, STATES] = ff
    return mean, cov


def recentred(m: Array, P: Array, shift: Errors) -> tuple[Array, Array]:
    """Return the moments with the errors relative to a new origin, ``shift`` away from the old."""
    after = m.copy()
    after[3 : 3 + ERRORS] -= shift
    return after, P


def mixed(weights: tuple[float, ...], means: Sequence[Array], covs: Sequence[Array]) -> tuple[Array, Array]:
    """Return mean and covariance of a mixture; weights sum to one."""
    mean = sum((w * m for w, m in zip(weights, means, strict=True)), np.zeros_like(means[0]))
    cov = np.zeros_like(covs[0])
    for w, m, P in zip(weights, means, covs, strict=True):
        d = m - mean
        cov += w * (P + np.outer(d, d))
    return mean, cov


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
        self.change(lambda m, P: anchored(m, P, start))

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""
        self.change(lambda m, P: recentred(m, P, shift))

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval."""
        self.change(lambda m, P: predict(m, P, interval))

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v."""
        return float(self.m[0]), float(self.P[0, 0])

    def follow(self, speed: float, r: float) -> None:
        """Update without f, with a measured speed [m/s] of variance r [(m/s)^2]."""
        self.change(lambda m, P: update(m, P, speed, r, learns=False))


class KalmanPosterior(GaussianPosterior):
    """One Gaussian."""

    STATE: ClassVar[State] = declare('m', definite('P'))
    effective = 1.0

    def __init__(self, config: KalmanConfig) -> None:
        self._q = config.drift**2
        self.m, self.P = prior(0.0, 0.0, NO_ERRORS)

    def change(self, change: Callable[[Array, Array], Moments]) -> None:
        """Change the Gaussian."""
        self.m, self.P = change(self.m, self.P)

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior."""
        self.m, self.P = prior(rate, std, error_stds)

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update with a measured speed [m/s] of variance r [(m/s)^2]; f drifted over ``elapsed`` [s]."""
        P = drift(self.P, interval.gain_v, interval.gain_a, self._q * elapsed)
        m, P = update(self.m, P, speed, r, learns=True)
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
        empty = prior(0.0, 0.0, NO_ERRORS)
        self._take(0.0, (empty, empty))

    def _take(self, jumping: float, models: Models) -> None:
        """Set the mixture and cache its moments."""
        self.jumping, self.models = jumping, models
        weights = (1.0 - jumping, jumping)
        self.m, self.P = mixed(weights, (models[0][0], models[1][0]), (models[0][1], models[1][1]))

    @property
    def effective(self) -> float:
        """Effective number of models, 1 to 2."""
        return 1.0 / (self.jumping**2 + (1.0 - self.jumping) ** 2)

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior."""
        start = prior(rate, std, error_stds)
        self._take(0.0, (start, start))

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
            drifted = drift(P, interval.gain_v, interval.gain_a, walk)
            S, nu = float(drifted[0, 0]) + r, speed - float(m[0])
            likelihoods.append(-0.5 * (nu * nu / S + math.log(S)))
            updated.append(update(m, drifted, speed, r, learns=True))
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
        quiet = mixed((quiet_share, 1.0 - quiet_share), means, covs)
        jump = models[1]
        if after > 0.0:
            jump_share = into_jump[1] / after
            jump = mixed((1.0 - jump_share, jump_share), means, covs)
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
