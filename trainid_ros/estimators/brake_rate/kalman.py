# SPDX-License-Identifier: Apache-2.0
"""KF: brake rate by the linear Kalman filter on [v, a, b, f], exact for a brake rate that drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.soundness import check_numbers, is_covariance
from trainid_ros.estimators.brake_rate.config import BrakeRateConfig
from trainid_ros.estimators.brake_rate.estimator import BrakeRateEstimator
from trainid_ros.estimators.brake_rate.gaussian import Cov, Mean, anchored, drift, predict, update

if TYPE_CHECKING:
    import numpy as np

    from trainid_ros.estimators.brake_rate.belief import Interval
    from trainid_ros.physics.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class KalmanConfig(BrakeRateConfig):
    """Settings of KF."""


@dataclass(frozen=True, slots=True)
class KalmanState:
    """Mean (v, a, b, f) and upper triangle of the covariance."""

    m: tuple[float, ...]
    P: tuple[float, ...]


class KalmanBelief:
    """One Gaussian."""

    def __init__(self, config: KalmanConfig) -> None:
        self._q = config.drift**2
        self.m: Mean = (0.0, 0.0, 0.0, 0.0)
        self.P: Cov = (0.0,) * 10

    effective = 1.0

    @property
    def rate(self) -> float:
        """Mean of f."""
        return self.m[3]

    @property
    def variance(self) -> float:
        """Variance of f."""
        return self.P[9]

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""
        return self.m[0]

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""
        return self.m[1]

    def reset(self, rate: float, std: float) -> None:
        """Go back to the prior."""
        self.m, self.P = anchored(rate, std * std, 0.0, 0.0, (0.0, 0.0, 0.0))

    def anchor(self, speed: float, target: float, variances: tuple[float, float, float]) -> None:
        """Start v, a and b anew."""
        self.m, self.P = anchored(self.rate, self.variance, speed, target, variances)

    def predict(self, interval: Interval) -> None:
        """Follow the motion over an interval."""
        self.m, self.P = predict(self.m, self.P, interval)

    def predicted(self) -> tuple[float, float]:
        """Return mean and variance of v."""
        return self.m[0], self.P[0]

    def follow(self, speed: float, r: float) -> None:
        """Take in a speed that tells nothing of f."""
        self.m, self.P = update(self.m, self.P, speed, r, learns=False)

    def learn(self, interval: Interval, elapsed: float, speed: float, r: float) -> bool:
        """Take in a speed that tells of f."""
        P = drift(self.P, interval.gain_v, interval.gain_a, self._q * elapsed)
        m, P = update(self.m, P, speed, r, learns=True)
        if not (all(map(math.isfinite, m)) and all(map(math.isfinite, P))):
            return False
        self.m, self.P = m, P
        return True

    def save(self) -> str:
        """Return the whole state as JSON text."""
        return encode(KalmanState(self.m, self.P))

    def restore(self, text: str) -> None:
        """Take over a saved state."""
        state = decode(text, KalmanState)
        m, P = state.m, state.P
        sized = len(m) == 4 and len(P) == 10
        check_numbers(state)
        check_restored(sized and is_covariance(P), 'KalmanState', 'm or P')
        self.m = (m[0], m[1], m[2], m[3])
        self.P = (P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8], P[9])


class Kalman(BrakeRateEstimator):
    """Linear Kalman filter."""

    def __init__(self, train_file: TrainFile, config: KalmanConfig, rng: np.random.Generator) -> None:  # noqa: ARG002
        super().__init__(train_file, config, KalmanBelief(config))
