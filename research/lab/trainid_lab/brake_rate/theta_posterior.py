# SPDX-License-Identifier: Apache-2.0
"""Posterior of weighted particles with one shared covariance; subclasses define the update of f."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from trainid_lab.brake_rate.particles import (
    SPEED,
    Correction,
    error_covariance,
    errors_of,
    speed_correction,
    speed_step,
    started,
)
from trainid_lab.brake_rate.resampling import effective_number
from trainid_lab.brake_rate.theta_cloud import ThetaCloud
from trainid_ros.brake_rate.motion_model import STATES, Errors, Start, Transition
from trainid_ros.interface.state import decode, encode
from trainid_ros.interface.vectors import vec

if TYPE_CHECKING:
    from trainid_lab.brake_rate.particles import Array, LinearStep


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
