# SPDX-License-Identifier: Apache-2.0
"""IMM: two Kalman filters that mix, one for a brake rate that drifts and one for a brake rate that jumps.

The interacting multiple model of Blom and Bar-Shalom: each step begins with every model at the mixture to
which the Markov chain of the models leads, so a jump is found as soon as the wide model explains speed better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.soundness import check_numbers, is_covariance
from trainid_ros.estimators.brake_rate.estimator import BrakeRateEstimator
from trainid_ros.estimators.brake_rate.gaussian import Cov, Mean, anchored, drift, mixed, predict, update
from trainid_ros.estimators.brake_rate.jumps import JumpConfig, drifts, transition

if TYPE_CHECKING:
    import numpy as np

    from trainid_ros.estimators.brake_rate.belief import Interval
    from trainid_ros.physics.train_file import TrainFile

Models = tuple[tuple[Mean, Cov], tuple[Mean, Cov]]
_SIZES: Final = (4, 10)


@dataclass(frozen=True, slots=True)
class ImmConfig(JumpConfig):
    """Settings of IMM."""


@dataclass(frozen=True, slots=True)
class ImmState:
    """Probability of the jumping model; of each model mean (v, a, b, f) and covariance, in one row."""

    jumping: float
    quiet_model: tuple[float, ...]
    jump_model: tuple[float, ...]


class ImmBelief:
    """Two Gaussians, the quiet one first, after mixing for the next step."""

    def __init__(self, config: ImmConfig) -> None:
        self._config = config
        self._q = drifts(config)
        nothing = anchored(0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0))
        self._take(0.0, (nothing, nothing))

    def _take(self, jumping: float, models: Models) -> None:
        """Take over a mixture, and compute once what is asked often."""
        self.jumping, self.models = jumping, models
        weights = (1.0 - jumping, jumping)
        self._m, self._P = mixed(weights, (models[0][0], models[1][0]), (models[0][1], models[1][1]))

    @property
    def rate(self) -> float:
        """Mean of f."""
        return self._m[3]

    @property
    def variance(self) -> float:
        """Variance of f."""
        return self._P[9]

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""
        return self._m[0]

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""
        return self._m[1]

    @property
    def effective(self) -> float:
        """Effective number of models, 1 to 2."""
        return 1.0 / (self.jumping**2 + (1.0 - self.jumping) ** 2)

    def reset(self, rate: float, std: float) -> None:
        """Go back to the prior."""
        prior = anchored(rate, std * std, 0.0, 0.0, (0.0, 0.0, 0.0))
        self._take(0.0, (prior, prior))

    def anchor(self, speed: float, target: float, variances: tuple[float, float, float]) -> None:
        """Start v, a and b anew."""
        first, second = (anchored(m[3], P[9], speed, target, variances) for m, P in self.models)
        self._take(self.jumping, (first, second))

    def predict(self, interval: Interval) -> None:
        """Follow the motion over an interval."""
        (m0, P0), (m1, P1) = self.models
        self._take(self.jumping, (predict(m0, P0, interval), predict(m1, P1, interval)))

    def predicted(self) -> tuple[float, float]:
        """Return mean and variance of v."""
        return self._m[0], self._P[0]

    def follow(self, speed: float, r: float) -> None:
        """Take in a speed that tells nothing of f."""
        (m0, P0), (m1, P1) = self.models
        quiet, jump = update(m0, P0, speed, r, learns=False), update(m1, P1, speed, r, learns=False)
        self._take(self.jumping, (quiet, jump))

    def learn(self, interval: Interval, elapsed: float, speed: float, r: float) -> bool:
        """Take in a speed that tells of f; then mix for the next step."""
        before = self._q[0] * (elapsed - interval.dt)  # while no brake acts f drifts, it does not jump
        likelihoods, updated = [], []
        for (m, P), q in zip(self.models, self._q, strict=True):
            drifted = drift(P, interval.gain_v, interval.gain_a, before + q * interval.dt)
            S, nu = drifted[0] + r, speed - m[0]
            likelihoods.append(-0.5 * (nu * nu / S + math.log(S)))
            updated.append(update(m, drifted, speed, r, learns=True))
        numbers = [x for m, P in updated for x in (*m, *P)]
        if not all(map(math.isfinite, numbers)):
            return False
        jumping = _posterior(self.jumping, likelihoods[1] - likelihoods[0])
        self._mix(jumping, (updated[0], updated[1]), interval.dt)
        return True

    def _mix(self, jumping: float, models: Models, dt: float) -> None:
        starts, ends = transition(self._config, dt)
        means, covs = (models[0][0], models[1][0]), (models[0][1], models[1][1])
        into_jump = starts * (1.0 - jumping), (1.0 - ends) * jumping
        after = sum(into_jump)
        quiet_share = (1.0 - starts) * (1.0 - jumping) / (1.0 - after)
        quiet = mixed((quiet_share, 1.0 - quiet_share), means, covs)
        jump = models[1]
        if after > 0.0:
            jump_share = into_jump[1] / after
            jump = mixed((1.0 - jump_share, jump_share), means, covs)
        self._take(after, (quiet, jump))

    def save(self) -> str:
        """Return the whole state as JSON text."""
        quiet, jump = ((*m, *P) for m, P in self.models)
        return encode(ImmState(self.jumping, quiet, jump))

    def restore(self, text: str) -> None:
        """Take over a saved state."""
        state = decode(text, ImmState)
        rows = (state.quiet_model, state.jump_model)
        sized = all(len(row) == sum(_SIZES) for row in rows) and 0.0 <= state.jumping < 1.0
        check_numbers(state)
        check_restored(sized and all(is_covariance(row[_SIZES[0] :]) for row in rows), 'ImmState', 'a model')
        self._take(state.jumping, (_model(rows[0]), _model(rows[1])))


def _posterior(prior: float, log_ratio: float) -> float:
    """Probability of the jumping model after its likelihood, given as log-ratio to the quiet one."""
    if prior <= 0.0:
        return 0.0
    odds = math.log(prior) - math.log1p(-prior) + log_ratio
    return 1.0 / (1.0 + math.exp(min(-odds, 700.0)))


def _model(row: tuple[float, ...]) -> tuple[Mean, Cov]:
    v, a, b, f, *P = row
    return (v, a, b, f), (P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8], P[9])


class Imm(BrakeRateEstimator):
    """Interacting multiple model of a drifting and a jumping brake rate."""

    def __init__(self, train_file: TrainFile, config: ImmConfig, rng: np.random.Generator) -> None:  # noqa: ARG002
        super().__init__(train_file, config, ImmBelief(config))
