# SPDX-License-Identifier: Apache-2.0
"""What is estimated in addition to theta: force delay, error of the curve resistance, strength of disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_ros.interface.state import State, declare
from trainid_ros.interface.vectors import i64, vec
from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel, Theta

# Measurements kept: more than a second at the sample period, longer than any delay of the force.
_KEPT: Final = 6
# Numbers of each: time since the one before, speed, resistance of the track, curvature.
_FIELDS: Final = 4
# Smallest standard deviation of the delay [s]: lags and the sampling grid are not a pure delay.
_MIN_DELAY_STD: Final = 0.003
# One update leaves at least this share of the variance, so that rounding cannot make it negative.
_MIN_SHARE: Final = 1e-3
# Longest window of the disturbances, and shortest one that is used [s].
_MAX_WINDOW_S: Final = 30.0
_MIN_WINDOW_S: Final = 8.0
# Weight of the initial value, and memory, both in windows.
_PRIOR_WINDOWS: Final = 3.0
_MEMORY: Final = 60.0
# Limit of a squared window error over its expectation: a step of the resistance is not a gust.
_MAX_SQUARE: Final = 5.0
# Weight of one window in the running mean, and its limit in standard deviations.
_SHARE: Final = 0.4
_MAX_ERROR: Final = 4.0
# Map errors extend beyond one window: their power at long periods over that within a window.
_LONG_TERM: Final = 1.4
# Limits of the strength, as a standard deviation [m/s per sqrt(s)].
_MIN_STD: Final = 0.001
_MAX_STD: Final = 0.05


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

        Args:
            dt: Time since the last sample [s].
            speed: Measured speed [m/s].
            track: Resistance of the track, gradient included [N/kN].
            curve: 600 m over the curve radius, 0 on straight track [1].
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

    def speed(self, delay: float) -> float:
        """Return the speed ``delay`` [s] ago, interpolated; beyond the ends the newest or the oldest one [m/s]."""
        return self._before(self._speeds, delay)

    def track(self, delay: float) -> float:
        """Return the resistance of the track ``delay`` [s] ago [N/kN]."""
        return self._before(self._tracks, delay)

    def curve(self, delay: float) -> float:
        """Return 600 m over the curve radius ``delay`` [s] ago [1]."""
        return self._before(self._curves, delay)

    def _before(self, values: vec[float], delay: float) -> float:
        remaining = delay
        newer: i64 = self._newest
        for _ in range(self._count - 1):
            older: i64 = newer - 1 if newer > 0 else _KEPT - 1
            dt = self._dt[newer]
            if remaining <= dt:
                if dt <= 0.0:
                    return values[newer]
                return values[newer] + (values[older] - values[newer]) * max(remaining, 0.0) / dt
            remaining -= dt
            newer = older
        return values[newer]


@dataclass
class ForceDelay:
    """Delay of the reported force, estimated from the response of the speed to changes of the force.

    If the stamps of the force f are late by delta, the model output equals the train's speed delta ago, so it is
    compared with the speed measured then. An error in delta puts the model off by k delta (f - f0), where f0 is the
    force at the last restart of the model from a measurement and k the acceleration coefficient: each change of the
    force makes the error visible in the innovations. Measurement updates correct the model, so the sensitivity of x to
    delta shrinks with each update. delta has a scalar recursion of its own, separate from that of theta: both use the
    same innovations, and the uncertainty of one adds to the variance of x for the other.
    """

    delay: float  # delta [s]
    variance: float  # Its variance [s^2]
    sensitivity: float = 0.0  # Derivative of x with respect to delta [m/s^2]

    @classmethod
    def unknown(cls, std: float) -> ForceDelay:
        """Return the prior: zero delay with a standard deviation [s]."""
        return cls(0.0, std * std)

    def predict(self, change: float) -> float:
        """Predict after the force changed the acceleration by ``change`` [m/s^2].

        Returns:
            Variance that the uncertainty of the delay adds to x [(m/s)^2].
        """
        before = self.sensitivity
        self.sensitivity += change
        return max(self.sensitivity * self.sensitivity - before * before, 0.0) * self.variance

    def update(self, error: float, variance: float, noise: float) -> None:
        """Update with an innovation of speed.

        Args:
            error: Measured less predicted speed [m/s].
            variance: Variance of that innovation [(m/s)^2].
            noise: Variance of the measurement noise, a part of it [(m/s)^2].
        """
        gain = self.variance * self.sensitivity / variance
        remaining = self.variance - gain * self.sensitivity * self.variance
        self.delay += gain * error
        self.variance = max(remaining, min(self.variance, _MIN_DELAY_STD * _MIN_DELAY_STD))
        self.sensitivity = self.sensitivity * noise / variance


@dataclass
class CurveError:
    """Error of the train file's curve resistance, estimated as one more parameter in addition to theta.

    A typical curve coefficient is accurate to 20 %, and on a line with many curves this is the largest error. It
    changes the speed by a known amount per step, so it is estimated jointly with x and theta: the auxiliary model holds
    their covariance; this class holds the variance of the curve error and its covariance with x and theta.
    """

    error: float  # Error at 600 m [N/kN]
    variance: float  # Its variance [(N/kN)^2]
    x: float = 0.0  # Its covariance with x, and so on with a1, a2, b1, d0
    a1: float = 0.0  # See ``x``
    a2: float = 0.0  # See ``x``
    b1: float = 0.0  # See ``x``
    d0: float = 0.0  # See ``x``

    def predict(self, model: AuxiliaryModel, change: float, u: float, scale: float) -> None:
        """Apply the error to a step, before the step of the model.

        Args:
            model: The auxiliary model, of which x and its covariances are changed.
            change: Change of speed over the step by 1 N/kN at 600 m radius [m/s].
            u: Specific force over the step [N/kN].
            scale: Duration of the step over the sample period [1].
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
        """Update after the measurement update of the model.

        Args:
            model: The auxiliary model after the update.
            error: Measured less predicted speed [m/s].
            variance: Variance of that innovation [(m/s)^2].
            noise: Variance of the measurement noise, a part of it [(m/s)^2].
        """
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

        Args:
            model: The auxiliary model, with P.
        """
        most = model.squared_norm(self.x, self.a1, self.a2, self.b1, self.d0)
        if most > self.variance:
            share = math.sqrt(self.variance / most)
            self.x, self.a1, self.a2 = share * self.x, share * self.a1, share * self.a2
            self.b1, self.d0 = share * self.b1, share * self.d0


@dataclass
class Disturbance:
    """Strength of unmodelled disturbances (gusts, map errors), from the speed error over windows of half a minute.

    The disturbances are not white: a gust lasts for seconds, a map error for hundreds of metres. For parameters that
    are estimated over many minutes their power at low frequency matters, which shows in the deviation of the speed from
    the model over a long window, not from one sample to the next. This deviation is the sum of the corrections of x
    over the window, without the effect of the updates of theta meanwhile. Consecutive windows with errors of the same
    sign indicate a change of the resistance, not a disturbance.
    """

    density: float  # Variance that the speed gains in a second [(m/s)^2/s]
    windows: float = _PRIOR_WINDOWS  # Number of windows used for it [1]
    mean_error: float = 0.0  # Running mean of the window errors, in standard deviations [1]
    elapsed: float = 0.0  # Duration of the current window so far [s]
    deviation: float = 0.0  # Sum of the corrections of x in it [m/s]
    a1: float = 0.0  # Parameter a1 at its start [s/m]
    a2: float = 0.0  # Parameter a2 at its start [1]
    b1: float = 0.0  # Parameter b1 at its start [m/s per N/kN]
    d0: float = 0.0  # Parameter d0 at its start [m/s]
    # Variance of the speed at its end due to the uncertainty of theta, over the square of its duration [(m/s^2)^2]
    theta_variance: float = 0.0

    @classmethod
    def declared(cls, std: float) -> Disturbance:
        """Return the initial state with the configured strength [m/s per sqrt(s)]."""
        return cls(std * std)

    def add(self, correction: float, theta: Theta, phi: Theta, dt: float, variance: float) -> None:
        """Add a measurement to the current window.

        Args:
            correction: Correction of x by the measurement [m/s].
            theta: Parameters used to predict x.
            phi: Regressor of the step.
            dt: Time since the previous measurement [s].
            variance: Variance of the acceleration due to that of theta [(m/s^2)^2]; used at the start of a window.
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
