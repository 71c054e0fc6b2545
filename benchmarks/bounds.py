# SPDX-License-Identifier: Apache-2.0
"""What accuracy can be had: an exact Kalman filter of the brake rate, and least squares that knows of every change.

Both use the settings of the estimators that they are a measure for, and nothing of their code but the physics.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import Refusal
from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.brake_kinematics import BrakeStep, brake_step
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.prior import davis_prior
from trainid_ros.estimators.speed_window import Tick, WindowResult, observe_resistance, overlap_factor
from trainid_ros.physics.brake import CommandHistory
from trainid_ros.physics.resistance import davis

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.core.samples import Sample
    from trainid_ros.estimators.gsma import GsmaConfig
    from trainid_ros.estimators.vmils import VMilsConfig
    from trainid_ros.physics.train_file import TrainFile

_ANCHOR_STD_A: Final = 0.05


class BrakeKalman:
    """Kalman filter on x = [v, a, b, f]: speed, brake acceleration, disturbance and brake rate.

    f enters linearly with known coefficients, so nothing is approximated. Unlike GSMA it also learns of f from
    the samples between brakings, through the disturbance that both share.

    Attributes:
        x: Mean, shape (4,).
        P: Covariance, shape (4, 4).

    """

    def __init__(self, train_file: TrainFile, config: GsmaConfig) -> None:
        self._train_file, self._config = train_file, config
        self._known = KnownForce(train_file)
        self._commands = CommandHistory()
        self._stamp_ns = 0
        self._target = 0.0
        self._refused = 0
        self.x = np.array([0.0, 0.0, 0.0, train_file.brake.rate])
        self.P = np.diag([0.0, 0.0, 0.0, config.prior_std**2])

    def step(self, sample: Sample) -> None:
        """Take one sample in."""
        for change in sample.brake_changes:
            self._commands = self._commands.push(change)
        if self._stamp_ns == 0 or math.isnan(sample.dt):
            elapsed = (sample.stamp_ns - self._stamp_ns) / NS_PER_S if self._stamp_ns else 0.0
            self._stamp_ns = sample.stamp_ns
            self._anchor(sample, elapsed)
            return
        motion = brake_step(self._commands, self._train_file.brake, self._stamp_ns, sample.stamp_ns)
        self._target = motion.decay * self._target + motion.gain_a
        self._stamp_ns = sample.stamp_ns
        if sample.speed < self._config.min_speed:
            self._anchor(sample, sample.dt)
            return
        self._predict(sample, motion)
        self._update(sample)

    def _anchor(self, sample: Sample, elapsed: float) -> None:
        """Start v, a and b anew; f stands, its variance grows."""
        config, target = self._config, self._target
        f, variance = self.x[3], self.P[3, 3] + config.drift**2 * elapsed
        self.x = np.array([sample.speed, f * target, 0.0, f])
        self.P = np.diag([config.speed_std**2, _ANCHOR_STD_A**2, config.disturbance_std**2, 0.0])
        column = np.array([0.0, target, 0.0, 1.0])
        self.P += variance * np.outer(column, column)
        self._refused = 0

    def _predict(self, sample: Sample, motion: BrakeStep) -> None:
        config, dt = self._config, sample.dt
        rho = math.exp(-sample.speed * dt / config.disturbance_length)
        Phi = np.array(
            [
                [1.0, motion.reach, dt, motion.gain_v],
                [0.0, motion.decay, 0.0, motion.gain_a],
                [0.0, 0.0, rho, 0.0],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        traction = self._known.traction(max(sample.force_mean, 0.0), sample)
        slack = config.force_error * traction / self._known.inertia
        white = (config.acceleration_noise**2 + slack**2) * dt
        # f drifts before it acts, so its drift reaches v and a within the same step.
        Q = np.diag([white, 0.0, config.disturbance_std**2 * (1.0 - rho * rho), 0.0])
        Q += config.drift**2 * dt * np.outer(Phi[:, 3], Phi[:, 3])
        resistance = self._known.track(sample) + davis(self._train_file.resistance, sample.speed)
        self.x = Phi @ self.x
        self.x[0] += (traction - resistance) / self._known.inertia * dt
        self.P = Phi @ self.P @ Phi.T + Q

    def _update(self, sample: Sample) -> None:
        config = self._config
        S = self.P[0, 0] + config.speed_std**2
        nu = sample.speed - self.x[0]
        if abs(nu) > config.gate * math.sqrt(S):
            self._refused += 1
            if self._refused >= config.readmit_after:
                self._anchor(sample, 0.0)
            return
        self._refused = 0
        K = self.P[:, 0] / S
        A = np.eye(4)
        A[:, 0] -= K
        self.x = self.x + nu * K
        self.P = A @ self.P @ A.T + config.speed_std**2 * np.outer(K, K)


class ResistanceOracle:
    """Weighted least squares of the Davis parameters over all windows since the last true change.

    It is told when the truth changes and starts again from the prior of the train file then. Windows are those of
    V-MILS, weighed by their long-run variance.

    Attributes:
        theta: Parameters a, b, c, shape (3,).
        P: Their covariance, shape (3, 3).

    """

    def __init__(self, train_file: TrainFile, config: VMilsConfig, change_ns: Sequence[int]) -> None:
        self._config, self._change_ns = config, list(change_ns)
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        self._overlap = overlap_factor(config.window, config.hop)
        resistance = train_file.resistance
        believed = (resistance.a, resistance.b, resistance.c)
        floors = (config.prior_std_a, config.prior_std_b, config.prior_std_c)
        self._theta0, self._P0 = np.array(believed), davis_prior(believed, config.prior_share, floors)
        self._ticks: list[Tick] = []
        self._fresh = 0
        self._since_ns = 0
        self._begin()

    def _begin(self) -> None:
        self._information = np.linalg.inv(self._P0)
        self._vector = self._information @ self._theta0
        self._solve()

    def _solve(self) -> None:
        self.P: NDArray[np.float64] = np.linalg.inv(self._information)
        self.theta: NDArray[np.float64] = self.P @ self._vector

    def step(self, sample: Sample) -> None:
        """Take one sample in."""
        if self._change_ns and sample.stamp_ns >= self._change_ns[0]:
            self._since_ns = self._change_ns.pop(0)
            self._begin()
        if self._admission.refuse(sample) is not None:
            self._ticks, self._fresh = [], 0
            return
        traction = self._known.traction(sample.force_mean, sample)
        known = traction - self._known.track(sample)
        self._ticks.append(Tick(sample.stamp_ns, sample.dt, sample.speed, known, traction))
        self._ticks, self._fresh = self._ticks[-self._config.window :], self._fresh + 1
        if len(self._ticks) < self._config.window or self._fresh < self._config.hop:
            return
        self._fresh = 0
        observed, _ = observe_resistance(self._ticks, self._known.inertia, self._config.speed_std)
        if not isinstance(observed, Refusal) and self._ticks[0].stamp_ns >= self._since_ns:
            self._add(observed)

    def _add(self, observed: WindowResult) -> None:
        config = self._config
        hop_s = observed.duration * config.hop / (config.window - 1)
        slow = max(1.0, 2.0 * config.disturbance_time / hop_s)
        force = (config.force_error * observed.traction) ** 2 + (config.force_skew * observed.force_rate) ** 2
        variance = self._overlap * observed.noise_std**2 + slow * config.disturbance_std**2 + force
        phi = np.array(observed.phi)
        self._information = self._information + np.outer(phi, phi) / variance
        self._vector = self._vector + phi * (observed.y / variance)
        self._solve()
