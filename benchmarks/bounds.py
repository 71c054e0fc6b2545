# SPDX-License-Identifier: Apache-2.0
"""Reference methods: an exact Kalman filter of the brake rate, and least squares given the time of every change.

The least squares are not a bound: windows discard information of the raw speed, and a filter bank is more accurate
without being given the changes. Both use the settings, speed noise and windows of the estimators that they are compared
with. The size of the disturbance, which GSMA also estimates, is the declared one in the Kalman filter.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.estimators.consistency import Admission
from trainid_ros.estimators.settings import prior_variances
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Rejection
from trainid_ros.resistance.window_learner import (
    Cut,
    SlidingWindow,
    WindowResult,
    WindowSample,
    observe_resistance,
    overlap_factor,
)
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.train.forces import CommandHistory, davis, lag_integral, lag_response

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.estimators.settings import GsmaConfig, VMilsConfig
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

_ANCHOR_STD_A: Final = 0.05
# Standard deviations assumed for the scale [1] and the delay [s] of the force.
_FORCE_ERROR: Final = 0.005
_FORCE_SKEW: Final = 0.06


class BrakeKalman:
    """Kalman filter on x = [v, a, b, f]: speed, brake acceleration, disturbance and brake rate.

    f enters linearly with known coefficients, so the filter is exact. Unlike GSMA it also gains information about f
    from samples between brakings, through the common disturbance.

    Attributes:
        x: Mean [m/s, m/s^2, m/s^2, 1], shape (4,).
        P: Covariance, shape (4, 4).

    """

    def __init__(self, train_file: TrainFile, config: GsmaConfig) -> None:
        self._train_file, self._config = train_file, config
        self._known = KnownForce(train_file)
        self._commands = CommandHistory()
        self._stamp_ns = 0
        self._target = 0.0
        self._rejected = 0
        self._noise = SpeedNoise.declared(config.speed_std)
        self.x = np.array([0.0, 0.0, 0.0, train_file.brake.rate])
        self.P = np.diag([0.0, 0.0, 0.0, config.prior_std**2])

    def step(self, sample: Sample) -> None:
        """Process one sample."""
        for change in sample.brake_changes:
            self._commands.push(change)
        self._noise.add(sample.speed, sample.dt)
        start_ns, self._stamp_ns = self._stamp_ns, sample.stamp_ns
        if start_ns == 0:
            self._anchor(sample, 0.0)
            return
        Phi = self._transition(sample, start_ns)
        self._target = float(Phi[1, 1]) * self._target + float(Phi[1, 3])
        if math.isnan(sample.dt) or sample.speed < self._config.min_speed:
            self._anchor(sample, (sample.stamp_ns - start_ns) / NS_PER_S)
            return
        self._predict(sample, Phi)
        self._update(sample)

    def _transition(self, sample: Sample, start_ns: int) -> NDArray[np.float64]:
        """Return the transition of x since the last sample, shape (4, 4), exact for a piecewise-constant command."""
        brake, dt = self._train_file.brake, (sample.stamp_ns - start_ns) / NS_PER_S
        delay_ns, tau = round(brake.delay * NS_PER_S), brake.time_constant
        a = v = 0.0
        for duration, u in self._commands.segments(start_ns - delay_ns, sample.stamp_ns - delay_ns):
            v += lag_integral(a, u, tau, duration)
            a = lag_response(a, u, tau, duration)
        Phi = np.eye(4)
        Phi[0] = 1.0, lag_integral(1.0, 0.0, tau, dt), dt, v
        Phi[1, 1], Phi[1, 3] = lag_response(1.0, 0.0, tau, dt), a
        Phi[2, 2] = math.exp(-sample.speed * dt / self._config.disturbance_length)
        return Phi

    def _anchor(self, sample: Sample, elapsed: float) -> None:
        """Reinitialise v, a and b; keep f and increase its variance by the drift."""
        config, target = self._config, self._target
        f, variance = self.x[3], self.P[3, 3] + config.drift**2 * elapsed
        self.x = np.array([sample.speed, f * target, 0.0, f])
        self.P = np.diag([self._noise.variance, _ANCHOR_STD_A**2, config.disturbance_std**2, 0.0])
        column = np.array([0.0, target, 0.0, 1.0])
        self.P += variance * np.outer(column, column)
        self._rejected = 0

    def _predict(self, sample: Sample, Phi: NDArray[np.float64]) -> None:
        config, dt, rho = self._config, sample.dt, float(Phi[2, 2])
        traction = self._known.traction(max(sample.force_mean, 0.0), sample)
        slack = config.force_error * traction / self._known.inertia
        white = (config.acceleration_noise**2 + slack**2) * dt
        # f drifts before it acts, so its drift affects v and a within the same step.
        Q = np.diag([white, 0.0, config.disturbance_std**2 * (1.0 - rho * rho), 0.0])
        Q += config.drift**2 * dt * np.outer(Phi[:, 3], Phi[:, 3])
        resistance = self._known.track(sample) + davis(self._train_file.resistance, sample.speed)
        self.x = Phi @ self.x
        self.x[0] += (traction - resistance) / self._known.inertia * dt
        self.P = Phi @ self.P @ Phi.T + Q

    def _update(self, sample: Sample) -> None:
        config = self._config
        S = self.P[0, 0] + self._noise.variance
        nu = sample.speed - self.x[0]
        if abs(nu) > config.gate * math.sqrt(S):
            self._rejected += 1
            if self._rejected >= config.readmit_after:
                self._anchor(sample, 0.0)
            return
        self._rejected = 0
        K = self.P[:, 0] / S
        A = np.eye(4)
        A[:, 0] -= K
        self.x = self.x + nu * K
        self.P = A @ self.P @ A.T + self._noise.variance * np.outer(K, K)


class InformedWindows:
    """Weighted least squares of the Davis parameters over all windows since the last true change.

    It is given the times of the true changes and then restarts from the prior of the train file, since it does not
    know which parameter has changed. Windows are those of V-MILS, weighted by their long-run variance.

    Attributes:
        theta: Parameters a, b, c [N/kN, v in m/s], shape (3,).
        P: Covariance of theta, shape (3, 3).

    """

    def __init__(self, train_file: TrainFile, config: VMilsConfig, change_ns: Sequence[int]) -> None:
        self._config, self._change_ns = config, list(change_ns)
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        self._windows = SlidingWindow(config.window, config.hop)
        resistance = train_file.resistance
        prior = (resistance.a, resistance.b, resistance.c)
        self._theta0 = np.array(prior)
        self._P0: NDArray[np.float64] = np.diag(prior_variances(prior, config))
        self._since_ns = 0
        self._noise = SpeedNoise.declared(config.speed_std)
        self._begin()

    def _begin(self) -> None:
        self._information = np.linalg.inv(self._P0)
        self._vector = self._information @ self._theta0
        self._solve()

    def _solve(self) -> None:
        self.P: NDArray[np.float64] = np.linalg.inv(self._information)
        self.theta: NDArray[np.float64] = self.P @ self._vector

    def step(self, sample: Sample) -> None:
        """Process one sample."""
        if self._change_ns and sample.stamp_ns >= self._change_ns[0]:
            self._since_ns = self._change_ns.pop(0)
            self._begin()
        if self._admission.reject(sample) is not None:
            self._windows.clear()
            self._noise.add(sample.speed, math.nan)
            return
        self._noise.add(sample.speed, sample.dt)
        traction = self._known.traction(sample.force_mean, sample)
        known = traction - self._known.track(sample)
        cut = self._windows.push(WindowSample(sample.stamp_ns, sample.dt, sample.speed, known, traction))
        if cut is None:
            return
        observed = observe_resistance(cut.ticks, self._known.inertia, self._noise.std)
        if not isinstance(observed, Rejection) and cut.ticks[0].stamp_ns >= self._since_ns:
            self._add(observed, cut)

    def _add(self, observed: WindowResult, cut: Cut) -> None:
        config = self._config
        slow = max(1.0, 2.0 * config.disturbance_time / cut.hop)
        force = (_FORCE_ERROR * observed.traction_size) ** 2 + (_FORCE_SKEW * observed.traction_rate) ** 2
        overlap = overlap_factor(len(cut.ticks), cut.samples)
        disturbance = math.hypot(config.disturbance_std, self._known.train_file.line.gradient_std)
        variance = overlap * observed.noise_std**2 + slow * disturbance**2 + force
        phi = np.array(observed.phi)
        self._information = self._information + np.outer(phi, phi) / variance
        self._vector = self._vector + phi * (observed.y / variance)
        self._solve()
