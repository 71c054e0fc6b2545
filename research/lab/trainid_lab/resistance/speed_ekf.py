# SPDX-License-Identifier: Apache-2.0
"""speed-EKF: Davis parameters from raw speed by an extended Kalman filter.

More accurate than windows while disturbances are small, and converges faster; it models drift of the parameters but
not steps. In addition to the filter there are:

* a gate on the innovation; after many consecutive rejections the speed restarts and the parameters are kept;
* stuck-speed detection: a speed that stays bit-identical longer than motion and rounding allow is stuck. The filter
  has already used it for a while, so it returns to the state before and predicts from there without measurements;
* a divergence check: if the parameters leave the region of the prior, the filter returns to the prior.

The filter, on x = [v, a, b, c] in floats:

    v' = v + k dt (u - a - b v - c v^2),  k = 1 / inertia,  u the known specific force,

with white process noise of variance q on v for unmodelled forces. Unlike windows, the filter loses no information: on
clean coasting runs it reaches the Cramer-Rao bound with and without gusts. Its state is a tuple of 14 floats: x, then
the upper triangle of its covariance, row by row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_lab.resistance.multi_innovation import is_finite
from trainid_ros.estimators.settings import PriorSettings, prior_variances
from trainid_ros.interface.errors import check_settings, setting
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.interface.state import State as Declared
from trainid_ros.interface.state import declare, encode, restore
from trainid_ros.resistance.davis_posterior import (
    drift_rates,
    drifted,
    is_accurate,
    predict,
    representative_speeds,
    resistance_estimate,
)
from trainid_ros.stream.known_force import Admission, KnownForce, SpeedNoise
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

State = tuple[float, ...]


def predicted(state: State, dt: float, u: float, k: float, q: float) -> State:
    """Return the state predicted ``dt`` [s] ahead.

    Args:
        state: State estimate.
        dt: Time step [s].
        u: Mean known specific force over the step [N/kN].
        k: Acceleration per specific force [m/s^2 per N/kN].
        q: Process noise variance added to v [(m/s)^2].

    """
    v, a, b, c, Pvv, Pva, Pvb, Pvc, Paa, Pab, Pac, Pbb, Pbc, Pcc = state
    # Speed in the middle of the step; w at the initial speed would lag by half a step.
    h = k * dt
    m = v + 0.5 * h * (u - a - v * (b + c * v))
    # F = [1 - h (b + 2 c m), -h, -h m, -h m^2; 0 I];  P = F P F' + Q
    f, fb, fc = 1.0 - h * (b + 2.0 * c * m), h * m, h * m * m
    Ra = f * Pva - h * Paa - fb * Pab - fc * Pac
    Rb = f * Pvb - h * Pab - fb * Pbb - fc * Pbc
    Rc = f * Pvc - h * Pac - fb * Pbc - fc * Pcc
    Pvv = f * (f * Pvv - h * Pva - fb * Pvb - fc * Pvc) - h * Ra - fb * Rb - fc * Rc + q
    return v + h * (u - a - m * (b + c * m)), a, b, c, Pvv, Ra, Rb, Rc, Paa, Pab, Pac, Pbb, Pbc, Pcc


def corrected(state: State, speed: float, R: float) -> State:
    """Return the state after a measurement of v [m/s] with variance R [(m/s)^2]."""
    v, a, b, c, Pvv, Pva, Pvb, Pvc, Paa, Pab, Pac, Pbb, Pbc, Pcc = state
    # K = P e / S;  P -= K S K'
    S = Pvv + R
    nu = speed - v
    K0, K1, K2, K3 = Pvv / S, Pva / S, Pvb / S, Pvc / S
    rest = R / S
    return (
        *(v + K0 * nu, a + K1 * nu, b + K2 * nu, c + K3 * nu),
        *(rest * Pvv, rest * Pva, rest * Pvb, rest * Pvc),
        *(Paa - K1 * Pva, Pab - K1 * Pvb, Pac - K1 * Pvc),
        *(Pbb - K2 * Pvb, Pbc - K2 * Pvc, Pcc - K3 * Pvc),
    )


def restarted(state: State, speed: float, R: float) -> State:
    """Return the state with v reset to one measurement [m/s] of variance R [(m/s)^2]; the parameters are kept."""
    return speed, *state[1:4], R, 0.0, 0.0, 0.0, *state[8:]


# Largest plausible squared distance from the prior, normalised by its standard deviations.
_MAX_PRIOR_DISTANCE: Final = 30.0
# Number of equal speeds without detection after which the state before a possible fault advances.
_MAX_HELD: Final = 50


@dataclass(frozen=True, slots=True)
class SpeedEkfConfig(PriorSettings):
    """Settings of the speed EKF."""

    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(
        0.15, 'unmodelled resistance; choose too large rather than too small', 'N/kN', 0.0, 10.0
    )
    disturbance_time: float = setting(6.0, 'correlation time of the disturbance', 's', 0.0, 600.0)
    force_error: float = setting(0.005, 'relative error of the traction force', '1', 0.0, 0.5)
    force_skew: float = setting(0.06, 'unknown delay of the reported force', 's', 0.0, 5.0)
    drift_share: float = setting(0.15, 'drift in one hour, std as a share of the prior std', '1', 0.0, 100.0)
    gate: float = setting(3.5, 'innovations beyond this many standard deviations are rejected', '1', 1.0, 100.0)
    restart_after: int = setting(25, 'consecutive rejections after which the speed restarts', 'samples', 1, 10000)
    stuck_sigmas: float = setting(
        5.0, 'predicted change above which an unchanged speed is stuck', 'standard deviations', 1.0, 1e6
    )
    valid_std: float = setting(0.15, 'resistance is fit to use below this standard deviation', 'N/kN', 1e-3, 10.0)


class SpeedEkf:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples, one update per sample.

    While a speed repeats, ``_before`` is the filter state at its first occurrence and ``_held`` the (dt, u, q) since.
    """

    STATE: ClassVar[Declared] = declare(
        '_filter', '_before', '_held', '_speed_noise', '_speed', '_force', '_running', '_rejected', '_stamp_ns',
        '_admission', '_innovation', '_innovation_variance', '_test_ratio', '_speed_min', '_speed_max', '_accepted',
        '_converged',
    )  # fmt: skip

    def __init__(self, train_file: TrainFile, config: SpeedEkfConfig) -> None:
        check_settings(config)
        self.config = config
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        self._k = 1.0 / self._known.inertia
        davis = train_file.resistance
        self._theta0 = (davis.a, davis.b, davis.c)
        self._max_variance = prior_variances(self._theta0, config)
        self._drift_rates = drift_rates(config.drift_share, self._max_variance)
        self.reset()

    def reset(self) -> None:
        """Return to the prior."""
        a, b, c = self._max_variance
        self._filter: State = (0.0, *self._theta0, 1.0, 0.0, 0.0, 0.0, a, 0.0, 0.0, b, 0.0, c)
        self._before: State = self._filter
        self._held: list[tuple[float, ...]] = []
        self._speed_noise = SpeedNoise.declared(self.config.speed_std, robust=True)
        self._speed = self._force = 0.0
        self._running = self._converged = False
        self._rejected = self._stamp_ns = self._accepted = self._admission.braked_ns = 0
        self._innovation = self._innovation_variance = self._test_ratio = 0.0
        self._speed_min = self._speed_max = 0.0

    def save(self) -> str:
        """Return the state as JSON text."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough over the speeds observed."""
        return self._converged

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample."""
        self._stamp_ns = sample.stamp_ns
        self._speed_noise.add(sample.speed, sample.dt)
        if (rejection := self._admission.reject(sample)) is not None:
            self._running = False
            return rejection
        traction = self._known.traction(sample.force_mean, sample)
        u = traction - self._known.track(sample)
        if not self._running:
            self._begin(sample.speed, u)
            return None
        self._predict(sample.dt, u, traction)
        rejection = self._correct(sample)
        self._force = u
        if not is_finite(self._filter):
            self._return_to_prior(sample.speed)
            return Rejection(sample.stamp_ns, Reason.NUMERICAL, self._innovation, math.nan)
        self._judge()
        return rejection

    def _begin(self, speed: float, u: float) -> None:
        """Restart from a measured speed [m/s] with the known specific force u [N/kN]."""
        self._filter = restarted(self._filter, speed, self._speed_noise.variance)
        self._before, self._held = self._filter, []
        self._speed, self._force = speed, u
        self._running, self._rejected = True, 0

    def _predict(self, dt: float, u: float, traction: float) -> None:
        config = self.config
        # A slow disturbance acts on speed like white noise with its spectral density at zero frequency.
        density = 2.0 * config.disturbance_time * (config.disturbance_std**2 + (config.force_error * traction) ** 2)
        q = self._k**2 * (density * dt + (config.force_skew * (u - self._force)) ** 2)
        v, _, _, _, Pvv, Pva, Pvb, Pvc, *P = predicted(self._filter, dt, u, self._k, q)
        wandered = drifted((*self._filter[1:4], *P), self._drift_rates, dt, self._max_variance)
        self._filter = (v, *wandered[:3], Pvv, Pva, Pvb, Pvc, *wandered[3:])
        self._held.append((dt, u, q))

    def idle(self, seconds: float) -> None:
        """Let a, b, c drift over a time without samples [s]."""
        posterior = (*self._filter[1:4], *self._filter[8:])
        wandered = drifted(posterior, self._drift_rates, seconds, self._max_variance)
        self._filter = (self._filter[0], *wandered[:3], *self._filter[4:8], *wandered[3:])
        self._judge()

    def _correct(self, sample: Sample) -> Rejection | None:
        """Correct with the measurement unless it is stuck or beyond the gate."""
        R, limit = self._speed_noise.variance, self.config.gate
        v, S = self._filter[0], self._filter[4] + R
        nu = sample.speed - v
        self._innovation, self._innovation_variance = nu / self._k, S / self._k**2
        self._test_ratio = nu * nu / (limit * limit * S)
        if sample.speed != self._speed:
            self._speed = sample.speed
            self._held.clear()
        elif self._is_stuck():
            return self._reject(sample, Reason.SPEED_STUCK, nu, self.config.stuck_sigmas * math.sqrt(R))
        if self._test_ratio > 1.0:
            return self._reject(sample, Reason.OUTLIER, nu, limit * math.sqrt(S))
        self._rejected = 0
        self._filter = corrected(self._filter, sample.speed, R)
        if not self._held or len(self._held) >= _MAX_HELD:
            self._before = self._filter
            self._held.clear()
        if self._is_diverged(self._filter):
            self._return_to_prior(sample.speed)
            return Rejection(sample.stamp_ns, Reason.NUMERICAL, nu, math.nan)
        self._accepted += 1
        self._speed_min = min(self._speed_min, v) if self._accepted > 1 else v
        self._speed_max = max(self._speed_max, v)
        return None

    def _is_stuck(self) -> bool:
        """Return whether an unchanged speed contradicts the predicted change; if so, discard it from the filter."""
        state = self._before
        for dt, u, q in self._held:
            state = predicted(state, dt, u, self._k, q)
        if abs(state[0] - self._speed) <= self.config.stuck_sigmas * self._speed_noise.std:
            return False
        self._filter = state
        return True

    def _reject(self, sample: Sample, reason: Reason, nu: float, limit: float) -> Rejection:
        self._rejected += 1
        # A restart from a stuck speed would be wrong.
        if self._rejected >= self.config.restart_after and reason is Reason.OUTLIER:
            self._begin(sample.speed, self._force)
        return Rejection(sample.stamp_ns, reason, nu, limit)

    def _is_diverged(self, state: State) -> bool:
        pairs = zip(state[1:4], self._theta0, self._max_variance, strict=True)
        return sum((x - x0) ** 2 / P for x, x0, P in pairs) > _MAX_PRIOR_DISTANCE

    def _return_to_prior(self, speed: float) -> None:
        """Return to the prior, at a measured speed [m/s]."""
        a, b, c = self._max_variance
        self._filter = (speed, *self._theta0, self._speed_noise.variance, 0.0, 0.0, 0.0, a, 0.0, 0.0, b, 0.0, c)
        self._before, self._held = self._filter, []

    def _judge(self) -> None:
        """Decide whether w is fit to use."""
        posterior, speeds = (*self._filter[1:4], *self._filter[8:]), (self._speed_min, self._speed_max)
        v1, v2, v3 = (predict(posterior, v, v * v)[1] for v in representative_speeds(*speeds))
        self._converged = self._accepted > 0 and is_accurate(
            (v1, v2, v3), self.config.valid_std, was_accurate=self._converged
        )

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [N/kN] and its variance before it [(N/kN)^2], as in the estimate."""
        return self._innovation, self._innovation_variance

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters for v in m/s and the resistance [N/kN] at a speed [m/s]."""
        return resistance_estimate(
            (*self._filter[1:4], *self._filter[8:]),
            speed,
            (self._innovation, self._innovation_variance, self._test_ratio),
            (self._speed_min, self._speed_max),
        )
