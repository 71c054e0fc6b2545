# SPDX-License-Identifier: Apache-2.0
"""KF: brake rate by the linear Kalman filter on [v, a, b, e, f], exact for a brake rate that drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from trainid_lab.brake_rate import gaussian
from trainid_lab.brake_rate.particles import errors_of
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.motion_model import NO_ERRORS, STATES, Errors, Start, Transition
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.state import State, declare, definite
from trainid_ros.interface.vectors import vec

if TYPE_CHECKING:
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class KalmanConfig(BrakeRateConfig):
    """Settings of KF."""


class KalmanPosterior:
    """Gaussian posterior.

    Attributes:
        m: Mean of z = [v, a, b, e, f], shape (n + 1,).
        P: Its covariance, shape (n + 1, n + 1).

    """

    STATE: ClassVar[State] = declare('m', definite('P'))

    def __init__(self, config: KalmanConfig) -> None:
        self._q = config.drift**2
        self.m, self.P = gaussian.prior(0.0, 0.0, NO_ERRORS)

    effective = 1.0

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
        return gaussian.total_rate(self.m, self.P, share)

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

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior."""
        self.m, self.P = gaussian.prior(rate, std, error_stds)

    def reinit_motion(self, start: Start) -> None:
        """Restart v, a and b."""
        self.m, self.P = gaussian.anchored(self.m, self.P, start)

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""
        self.m = gaussian.recentred(self.m, shift)

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval."""
        self.m, self.P = gaussian.predict(self.m, self.P, interval)

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v."""
        return float(self.m[0]), float(self.P[0, 0])

    def follow(self, speed: float, r: float) -> None:
        """Update without f, with a measured speed [m/s] of variance r [(m/s)^2]."""
        self.m, self.P = gaussian.update(self.m, self.P, speed, r, learns=False)

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
