# SPDX-License-Identifier: Apache-2.0
"""Estimator of the speed model: admits samples, computes the known forces, runs an algorithm, returns the estimate.

In addition to theta it estimates nuisances: force delay, error of the curve resistance, strength of disturbances.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Final

from trainid_ros.estimators.settings import SpeedModelConfig
from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.results import Reason, Rejection, SpeedModelEstimate
from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, encode, restore
from trainid_ros.interface.vectors import i64, vec
from trainid_ros.resistance.davis_posterior import CURVE_RADIUS, curve_std, is_accurate, representative_speeds
from trainid_ros.speed_model.am_vff_rls import (
    AuxiliaryModel,
    Learned,
    Method,
    Symmetric,
    Theta,
    full,
    prior,
    resistance_variance,
    to_physical,
)
from trainid_ros.stream.known_force import Admission, KnownForce, SpeedNoise
from trainid_ros.stream.samples import SAMPLE_PERIOD, Sample
from trainid_ros.train.train_file import TrainFile

# Measurements kept: more than a second at the sample period, longer than any delay of the force.
_KEPT: Final = 6
# Smallest standard deviation of the delay [s]: lags and the sampling grid are not a pure delay.
_MIN_DELAY_STD: Final = 0.003
# One update leaves at least this share of the variance, so that rounding cannot make it negative.
_MIN_SHARE: Final = 1e-3
# Longest window of the disturbances, and shortest one that is used [s].
_MAX_WINDOW_S: Final = 30.0
_MIN_WINDOW_S: Final = 8.0
# Weight of the initial value, and memory, both in windows.
_PRIOR_WINDOWS, _MEMORY = 3.0, 60.0
# Limit of a squared window error over its expectation: a step of the resistance is not a gust.
_MAX_SQUARE: Final = 5.0
# Weight of one window in the running mean, and its limit in standard deviations.
_SHARE, _MAX_ERROR = 0.4, 4.0
# Map errors extend beyond one window: their power at long periods over that within a window.
_LONG_TERM: Final = 1.4
# Limits of the strength, as a standard deviation [m/s per sqrt(s)].
_MIN_STD, _MAX_STD = 0.001, 0.05


class RecentSamples:
    """Last samples, to look up the values at the time to which a delayed force belongs."""

    STATE: ClassVar[State] = declare('_dt', '_speeds', '_tracks', '_curves', '_newest', '_count')

    def __init__(self) -> None:
        # A ring: each value is followed by a newer one, the newest by the oldest.
        self._dt = vec[float]([0.0] * _KEPT)
        self._speeds = vec[float]([0.0] * _KEPT)
        self._tracks = vec[float]([0.0] * _KEPT)
        self._curves = vec[float]([0.0] * _KEPT)
        self._newest: i64 = 0
        self._count: i64 = 0

    def add(self, dt: float, speed: float, track: float, curve: float) -> None:
        """Add the values of a sample ``dt`` [s] after the last one; NaN after a gap, which discards the older values.

        They are the measured speed [m/s], the resistance of the track, gradient included [N/kN], and 600 m over the
        curve radius [1], 0 on straight track.
        """
        if math.isnan(dt):
            self._count = 0
        k: i64 = self._newest + 1
        if k == _KEPT:
            k = 0
        self._dt[k] = 0.0 if math.isnan(dt) else dt
        self._speeds[k], self._tracks[k], self._curves[k] = speed, track, curve
        self._newest = k
        if self._count < _KEPT:
            self._count += 1

    def at(self, delay: float) -> tuple[float, float, float]:
        """Return the three values ``delay`` [s] ago, interpolated; beyond the ends the newest or the oldest ones."""
        v, w, c, remaining = self._speeds, self._tracks, self._curves, delay
        new: i64 = self._newest
        for _ in range(self._count - 1):
            old: i64 = new - 1 if new > 0 else _KEPT - 1
            dt = self._dt[new]
            if remaining <= dt:
                if dt <= 0.0:
                    break
                since = max(remaining, 0.0)
                speed, track = v[new] + (v[old] - v[new]) * since / dt, w[new] + (w[old] - w[new]) * since / dt
                return speed, track, c[new] + (c[old] - c[new]) * since / dt
            remaining -= dt
            new = old
        return v[new], w[new], c[new]


@dataclass
class ForceDelay:
    """Delay of the reported force, estimated from the response of the speed to changes of the force.

    If the stamps of the force f are late by delta, the model output equals the train's speed delta ago, so it is
    compared with the speed measured then. An error in delta puts the model off by k delta (f - f0), where f0 is the
    force at the last restart of the model and k the acceleration coefficient; each measurement update reduces that.
    delta has a scalar recursion apart from that of theta, with the same innovations; the uncertainty of one adds to the
    variance of x for the other.
    """

    delay: float  # delta [s]
    variance: float  # Its variance [s^2]
    sensitivity: float = 0.0  # Derivative of x with respect to delta [m/s^2]

    def predict(self, change: float) -> float:
        """Predict after the force changed the acceleration [m/s^2]; return the variance this adds to x [(m/s)^2]."""
        before = self.sensitivity
        self.sensitivity += change
        return max(self.sensitivity * self.sensitivity - before * before, 0.0) * self.variance

    def update(self, error: float, variance: float, noise: float) -> None:
        """Update with an innovation of speed [m/s], its variance, and that of the noise, a part of it [(m/s)^2]."""
        gain = self.variance * self.sensitivity / variance
        remaining = self.variance - gain * self.sensitivity * self.variance
        self.delay += gain * error
        self.variance = max(remaining, min(self.variance, _MIN_DELAY_STD * _MIN_DELAY_STD))
        self.sensitivity = self.sensitivity * noise / variance


@dataclass
class CurveError:
    """Error of the train file's curve resistance, on a line with many curves the largest error.

    It is estimated jointly with x and theta: the auxiliary model holds their covariance, this class the rest.
    """

    error: float  # Error at 600 m [N/kN]
    variance: float  # Its variance [(N/kN)^2]
    # Its covariances with x and theta
    x: float = 0.0
    a1: float = 0.0
    a2: float = 0.0
    b1: float = 0.0
    d0: float = 0.0

    def predict(self, model: AuxiliaryModel, change: float, u: float, scale: float) -> None:
        """Apply the error to a step of ``scale`` sample periods with the force u [N/kN], before that of the model.

        ``change`` is the change of speed over the step by 1 N/kN at 600 m radius [m/s].
        """
        model.add_input(
            change * self.error,
            change * (2.0 * self.x + change * self.variance),
            (change * self.a1, change * self.a2, change * self.b1, change * self.d0),
        )
        self.x += change * self.variance
        x = model.speed()
        a1, a2, _, _ = model.theta()
        slope = 1.0 + scale * (2.0 * a1 * x + a2 - 1.0)
        self.x = slope * self.x + scale * (x * x * self.a1 + x * self.a2 + u * self.b1 + self.d0)

    def update(self, model: AuxiliaryModel, error: float, variance: float, noise: float) -> None:
        """Update after the measurement update of the model; the numbers are those of :meth:`ForceDelay.update`."""
        gain = self.x / variance
        # Gains of the model: the covariance with x before the update is that after it times variance / noise.
        share = gain * variance / noise
        P = model.P
        self.error += gain * error
        self.variance = max(self.variance - gain * self.x, _MIN_SHARE * self.variance)
        self.x -= share * P[0]
        self.a1 -= share * P[1]
        self.a2 -= share * P[2]
        self.b1 -= share * P[3]
        self.d0 -= share * P[4]

    def bound(self, model: AuxiliaryModel) -> None:
        """Shrink the covariances c until c' P^-1 c is at most the variance, as in every joint covariance.

        Exact updates keep it so. But forgetting, which ends at the prior, may reduce P, and a rejected sample changes
        P and not c; under extreme settings the correlations then exceeded one.
        """
        most = model.squared_norm(self.x, self.a1, self.a2, self.b1, self.d0)
        if most > self.variance:
            share = math.sqrt(self.variance / most)
            self.x, self.a1, self.a2 = share * self.x, share * self.a1, share * self.a2
            self.b1, self.d0 = share * self.b1, share * self.d0


@dataclass
class Disturbance:
    """Strength of unmodelled disturbances (gusts, map errors), from the speed error over windows of half a minute.

    For parameters that are estimated over many minutes their power at low frequency matters, which shows in the
    deviation of the speed from the model over a long window: the sum of the corrections of x, without the effect of the
    updates of theta meanwhile. Window errors of the same sign indicate a change of the resistance instead.
    """

    density: float  # Variance that the speed gains in a second [(m/s)^2/s]
    windows: float = _PRIOR_WINDOWS  # Number of windows used for it [1]
    mean_error: float = 0.0  # Running mean of the window errors, in standard deviations [1]
    elapsed: float = 0.0  # Duration of the current window so far [s]
    deviation: float = 0.0  # Sum of the corrections of x in it [m/s]
    # Theta at its start
    a1: float = 0.0
    a2: float = 0.0
    b1: float = 0.0
    d0: float = 0.0
    # Variance of the speed at its end due to the uncertainty of theta, over the square of its duration [(m/s^2)^2]
    theta_variance: float = 0.0

    def add(self, correction: float, theta: Theta, phi: Theta, dt: float, variance: float) -> None:
        """Add a measurement after ``dt`` [s]: its correction of x [m/s], which was predicted by theta and phi.

        The variance is that of the acceleration due to theta [(m/s^2)^2], used at the start of a window.
        """
        a1, a2, b1, d0 = theta
        if self.elapsed == 0.0:
            self.a1, self.a2, self.b1, self.d0 = theta
            self.deviation, self.elapsed, self.theta_variance = correction, dt, variance
            return
        updates = (a1 - self.a1) * phi[0] + (a2 - self.a2) * phi[1] + (b1 - self.b1) * phi[2] + (d0 - self.d0) * phi[3]
        self.deviation = self.deviation + correction + updates
        self.elapsed += dt
        if self.elapsed >= _MAX_WINDOW_S:
            self.end_window()

    def end_window(self) -> None:
        """Close the current window and update the strength, unless the window is too short."""
        elapsed, deviation, theta_variance = self.elapsed, self.deviation, self.theta_variance
        self.elapsed = self.deviation = self.theta_variance = 0.0
        if elapsed < _MIN_WINDOW_S:
            return
        own = self.density * elapsed
        expected = own + theta_variance * elapsed * elapsed
        ratio = min(deviation * deviation / expected, _MAX_SQUARE)
        # Share of the error variance not due to theta; a window dominated by theta's uncertainty has little weight.
        share = own / expected
        weight = share * share * elapsed / _MAX_WINDOW_S
        self.windows = min(self.windows + weight, _MEMORY)
        density = self.density * (1.0 + (weight / self.windows) * (ratio - 1.0) / share)
        self.density = min(max(density, _MIN_STD * _MIN_STD), _MAX_STD * _MAX_STD)
        z = min(max(deviation / math.sqrt(expected), -_MAX_ERROR), _MAX_ERROR)
        self.mean_error += _SHARE * (z - self.mean_error)

    @property
    def chi2(self) -> float:
        """Chi-square of the mean window error, one degree of freedom [1]."""
        return self.mean_error * self.mean_error * (2.0 - _SHARE) / _SHARE

    @property
    def long_term_density(self) -> float:
        """Density at periods of minutes, over which parameters are estimated [(m/s)^2/s]."""
        return _LONG_TERM * self.density


# The range of speeds driven: memory of about half an hour, and its half-width in standard deviations.
_SPEED_SAMPLES: Final = 9000.0
_SPEED_WIDTH: Final = 1.5


@dataclass
class SpeedModelState:
    """State of an estimator of the speed model."""

    noise: SpeedNoise  # Noise of measured speed
    disturbance: Disturbance  # Strength of gusts and other unmodelled disturbances
    force_delay: ForceDelay  # Delay of the reported force
    curve: CurveError  # Error of the curve resistance
    forgetting: float = 1.0  # Last forgetting factor [1]
    predicted: float = 0.0  # Last predicted speed [m/s]
    error: float = 0.0  # Last prediction error [m/s]
    variance: float = 0.0  # Its predicted variance [(m/s)^2]
    slowest: float = 0.0  # Slowest speed used [m/s]
    fastest: float = -1.0  # Fastest speed used [m/s]; less than ``slowest`` if there is none yet
    speed_mean: float = 0.0  # Running mean of the speeds used [m/s]
    speed_variance: float = 0.0  # Their running variance [(m/s)^2]
    used: float = 0.0  # Number of samples used, up to the memory of these means
    rejected_in_a_row: int = 0  # Outliers in a row
    slow_in_a_row: int = 0  # Samples in a row below the minimum speed
    traction: float = 0.0  # Last known traction [N/kN]
    weighed: bool = False  # Whether the mass was weighed at the last sample
    fit: bool = False  # Whether the resistance is valid

    def drive(self, y: float) -> None:
        """Take a speed used [m/s] into the range and the running mean and variance of the speeds."""
        if self.fastest >= self.slowest:
            self.slowest, self.fastest = min(y, self.slowest), max(y, self.fastest)
        else:
            self.slowest = self.fastest = y
        share, off = 1.0 / min(self.used + 1.0, _SPEED_SAMPLES), y - self.speed_mean
        self.speed_mean += share * off
        self.speed_variance = (1.0 - share) * (self.speed_variance + share * (off * off))
        self.used = 1.0 / share

    def speeds_driven(self) -> tuple[float, float]:
        """Return slowest and fastest of the usual speeds [m/s]."""
        width = _SPEED_WIDTH * math.sqrt(self.speed_variance)
        return max(self.speed_mean - width, self.slowest), min(self.speed_mean + width, self.fastest)


# Slow samples in a row that indicate standstill: a single one may be an outlier.
_STOP_SAMPLES: Final = 3
# Largest plausible loss of speed from one sample to the next [m/s].
_MAX_SPEED_LOSS: Final = 1.0
# A detected change keeps at least the square of this share of the information.
_MIN_FACTOR: Final = 0.1
# Limit of the change of traction from sample to sample [N/kN]; beyond it is an outlier.
_MAX_CHANGE: Final = 500.0


class ModelStep:
    """One step of the model: its inputs, and what is known before it.

    Attributes:
        dt: Duration [s].
        scale: Duration in sample periods [1].
        traction: Traction at its end [N/kN].
        u: Mean traction [N/kN].
        theta: Parameters before it.
        phi: Regressor.
        acceleration_variance: Variance of the acceleration due to that of theta [(m/s^2)^2].
    """

    def __init__(self, dt: float, traction: float, u: float) -> None:
        self.dt, self.scale, self.traction, self.u = dt, dt / SAMPLE_PERIOD, traction, u
        self.theta: Theta = (0.0, 0.0, 0.0, 0.0)
        self.phi: Theta = self.theta
        self.acceleration_variance = 0.0


def load_std(train_file: TrainFile, config: SpeedModelConfig) -> float:
    """Return the std of the relative change of mass at a stop without weighing [1]."""
    return min(config.load_std, train_file.train.mass_std)


class SpeedModelEstimator:
    """Run a method on samples; ``method`` makes it from theta(0) and its covariance.

    With an auxiliary model, which has the covariance of x, the nuisances are estimated too.
    """

    STATE: ClassVar[State] = declare('state', 'method', '_recent', '_admission')

    def __init__(
        self, train_file: TrainFile, config: SpeedModelConfig, method: Callable[[Theta, Symmetric], Method]
    ) -> None:
        check_settings(config)
        self._config = config
        self._min_speed, self._valid_std = config.min_speed, config.valid_std
        self._change_threshold, self._readmit_after = config.change_threshold, config.readmit_after
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis, train = train_file.resistance, train_file.train
        self._curve_std = curve_std(train_file)
        self._k = 1.0 / self._known.inertia
        self._rotary = 1.0 + train.rotary_mass
        mass_std = math.hypot(train.mass_std, train.force_std)
        theta0, P0 = prior((davis.a, davis.b, davis.c), self._k, config, mass_std)
        self._make_method, self._mass_variance = partial(method, theta0, P0), P0[7]
        unweighed, weighing = load_std(train_file, config), min(config.weighing_std, train.mass_std)
        self._weighed_share = (weighing / unweighed) ** 2 if unweighed > 0.0 else 0.0
        self.reset()

    def reset(self) -> None:
        """Reset to the prior."""
        config, noise = self._config, SpeedNoise.declared(self._config.speed_std)
        disturbance = Disturbance(config.acceleration_noise * config.acceleration_noise)
        force_delay = ForceDelay(0.0, config.force_skew * config.force_skew)
        self.state = SpeedModelState(noise, disturbance, force_delay, CurveError(0.0, self._curve_std**2))
        self._recent = RecentSamples()
        self._admission.braked_ns = 0
        self.method = method = self._make_method()
        self._auxiliary = method if isinstance(method, AuxiliaryModel) else None
        method.start(noise.variance)

    def save(self) -> str:
        """Return the complete state as JSON text."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)
        self._update_validity()

    def idle(self, seconds: float) -> None:
        """Add the drift over a time without samples [s], and in more than 15 s a change of load as at a stop."""
        if self._auxiliary is not None:
            self._auxiliary.idle(seconds / SAMPLE_PERIOD)
        if seconds > 15.0:
            self.method.inflate_load_variance(self._load_share())
        self._update_validity()

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; return the reason if it is rejected."""
        self._store(sample)
        rejection = self._admission.reject(sample)
        step = self._model_step(sample)
        if rejection is not None:
            self._hold(sample.speed, step, rejection.reason)
            return rejection
        state, y = self.state, self._recent.at(self._delay())[0]
        noise, sensitivity, curve_x = state.noise.variance, state.force_delay.sensitivity, state.curve.x
        self._predict(step)
        learned = self.method.update(y, step.u, step.scale, noise)
        usable = self.method.is_usable()
        if usable and not learned.rejected:
            self._learn(sample, step, learned)
            return None
        # A rejected sample holds no information on delay and curve error.
        state.force_delay.sensitivity, state.curve.x = sensitivity, curve_x
        if self._auxiliary is not None:
            state.curve.bound(self._auxiliary)
        if learned.rejected:
            self._reject(y, step, learned, usable)
            return Rejection(sample.stamp_ns, Reason.OUTLIER, learned.error, learned.limit)
        b1 = self.method.theta()[2]
        self.method.start(noise)
        self.method.reinit_speed(y, 1.0)
        return Rejection(sample.stamp_ns, Reason.NUMERICAL, b1, 0.0)

    def _delay(self) -> float:
        """Return the delay of the force [s]: its speed is compared with the one measured then."""
        return self.state.force_delay.delay if self._auxiliary is not None else 0.0

    def _store(self, sample: Sample) -> None:
        speed, dt = sample.speed, sample.dt
        track, curve = self._known.track(sample), CURVE_RADIUS * sample.curvature
        if not (is_finite(track) and is_finite(curve)):
            track = curve = 0.0
        self.state.noise.add(speed, dt)
        self._recent.add(dt, speed, track, curve)

    def _model_step(self, sample: Sample) -> ModelStep:
        """Return the step to a sample; the mean of the traction is used for its end if the force there is missing."""
        mean = self._known.traction(sample.force_mean, sample)
        end = self._known.traction(sample.force, sample) if is_finite(sample.force) else mean
        step = ModelStep(sample.dt, end, mean)
        if self._auxiliary is not None:
            scale, x = step.scale, self._auxiliary.speed()
            step.theta, step.phi = self._auxiliary.theta(), (scale * x * x, scale * x, scale * mean, scale)
            if self.state.disturbance.elapsed == 0.0:  # a window starts
                variance = resistance_variance(self._auxiliary.covariance(0.0), sample.speed, self._k)
                step.acceleration_variance = self._k**2 * max(variance, 0.0)
        return step

    def _predict(self, step: ModelStep) -> None:
        """Apply known resistance, disturbance, force delay and curve error of a step."""
        state, model = self.state, self._auxiliary
        _, track, curve = self._recent.at(self._delay())
        change = -self._k * track * step.dt
        if model is None:
            self.method.shift(change)
            return
        model.shift(change)
        change_of_traction = min(max(step.traction - state.traction, -_MAX_CHANGE), _MAX_CHANGE)
        acceleration = step.theta[2] / SAMPLE_PERIOD * change_of_traction
        by_delay = state.force_delay.predict(acceleration)
        model.inflate_speed_variance(state.disturbance.long_term_density * step.dt + by_delay)
        if self._curve_std > 0.0:
            state.curve.predict(model, -self._k * curve * step.dt, step.u, step.scale)

    def _learn(self, sample: Sample, step: ModelStep, learned: Learned) -> None:
        """Store the result of a measurement update and update the estimates other than theta."""
        state = self.state
        if self._auxiliary is not None:
            self._learn_nuisances(self._auxiliary, step, learned)
        state.forgetting = learned.forgetting
        state.predicted, state.error, state.variance = learned.predicted, learned.error, learned.variance
        state.drive(sample.speed)
        state.rejected_in_a_row = state.slow_in_a_row = 0
        state.traction, state.weighed = step.traction, sample.weighed
        self._update_validity()

    def _learn_nuisances(self, model: AuxiliaryModel, step: ModelStep, learned: Learned) -> None:
        state, noise = self.state, self.state.noise.variance
        correction = model.speed() - learned.predicted
        self._learn_delay(model, learned)
        if self._curve_std > 0.0:
            state.curve.update(model, learned.error, learned.variance, noise)
            if learned.forgetting < 1.0:
                state.curve.bound(model)
        density = state.disturbance.density
        state.disturbance.add(correction, step.theta, step.phi, step.dt, step.acceleration_variance)
        if state.disturbance.elapsed == 0.0:
            self._detect_change(model, density)

    def _detect_change(self, model: AuxiliaryModel, density: float) -> None:
        """Reduce the information on the resistance if the window errors show that it has changed.

        The strength of the disturbances is again that before the last window: the change does not add to it.
        """
        disturbance, threshold = self.state.disturbance, self._change_threshold
        if disturbance.chi2 > threshold:
            factor = max(threshold / disturbance.chi2, _MIN_FACTOR)
            model.forget(factor * factor)
            self.state.curve.bound(model)
            disturbance.mean_error, disturbance.density = 0.0, density

    def _learn_delay(self, model: AuxiliaryModel, learned: Learned) -> None:
        """Update the delay of the force; x is moved to the time to which the new delay refers."""
        recent, late = self._recent, self.state.force_delay
        before = late.delay
        late.update(learned.error, learned.variance, self.state.noise.variance)
        moved = recent.at(late.delay)[0] - recent.at(before)[0] + late.sensitivity * (late.delay - before)
        model.shift(moved)

    def _update_validity(self) -> None:
        """Update whether the resistance is valid at the speeds driven."""
        state = self.state
        if state.fastest < state.slowest:
            return
        (v1, v2, v3), S, k = representative_speeds(*state.speeds_driven()), self._covariance(), self._k
        variances = resistance_variance(S, v1, k), resistance_variance(S, v2, k), resistance_variance(S, v3, k)
        state.fit = is_accurate(variances, self._valid_std, was_accurate=state.fit)

    def _covariance(self) -> Symmetric:
        if self._auxiliary is not None:
            return self._auxiliary.covariance(0.0)
        return self.method.covariance(self.state.noise.variance)

    def _hold(self, y: float, step: ModelStep, reason: Reason) -> None:
        """Hold theta over a rejected sample of speed y [m/s]; x follows the measurement."""
        state, method, noise = self.state, self.method, self.state.noise.variance
        state.slow_in_a_row = state.slow_in_a_row + 1 if y < self._min_speed else 0
        sudden = method.speed() - y > _MAX_SPEED_LOSS
        if reason is Reason.STANDSTILL and state.slow_in_a_row < _STOP_SAMPLES and sudden:
            self._predict(step)
            method.coast(step.u, step.scale)
            if not self.method.is_usable():
                method.reinit_speed(y, noise)
        else:
            method.reinit_speed(self._recent.at(self._delay())[0], noise)
        if state.slow_in_a_row == _STOP_SAMPLES:
            method.inflate_load_variance(self._load_share())
        self._end_window()
        state.predicted, state.error, state.variance = y, 0.0, 0.0
        if is_finite(step.traction):
            state.traction = step.traction

    def _end_window(self) -> None:
        """End the window of the disturbance; x was restarted from a measurement, independent of delay and curves."""
        self.state.disturbance.end_window()
        self.state.force_delay.sensitivity = self.state.curve.x = 0.0

    def _load_share(self) -> float:
        """Return what a stop adds to the variance of b1, as a share of that of a stop without weighing [1].

        The load varies about the train file's value, so less is added the closer the variance of b1 is to its prior.
        """
        share = max(1.0 - self._covariance()[7] / self._mass_variance, 0.0)
        return share * (self._weighed_share if self.state.weighed else 1.0)

    def _reject(self, y: float, step: ModelStep, learned: Learned, usable: bool) -> None:
        """Predict over an outlier; after several in a row accept the measured speed y [m/s]."""
        state = self.state
        state.rejected_in_a_row += 1
        accepted = state.rejected_in_a_row >= self._readmit_after
        if accepted or not usable:
            self.method.reinit_speed(y, state.noise.variance)
        if accepted:
            self._end_window()
            state.rejected_in_a_row = 0
        state.predicted = learned.predicted if is_finite(learned.predicted) else y
        state.error = learned.error if is_finite(learned.error) else 0.0
        state.variance = learned.variance if is_finite(learned.variance) else 0.0
        state.traction = step.traction

    @property
    def converged(self) -> bool:
        """Whether w is known accurately enough over the speeds driven."""
        return self.state.fit

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [m/s] and its variance before it [(m/s)^2], as in the estimate."""
        return self.state.error, self.state.variance

    def estimate(self, speed: float) -> SpeedModelEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the speed model and its physical parameters; ``speed`` [m/s] is unused."""
        state = self.state
        a1, a2, b1, d0 = theta = self.method.theta()
        a, b, c, scale = to_physical(theta, self._k)
        return SpeedModelEstimate(
            a1,
            a2,
            b1,
            d0,
            full(self._covariance()),
            state.forgetting,
            state.predicted,
            state.error,
            a,
            b,
            c,
            mass_factor=self._rotary / scale,
            prediction_variance=state.variance,
        )
