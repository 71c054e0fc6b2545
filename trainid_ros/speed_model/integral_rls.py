# SPDX-License-Identifier: Apache-2.0
"""Integral RLS: least squares on the change of speed over k samples, the cheap way round errors in the regressor.

Summed over k steps the model (2) reads

    y(n) - y(n-k) = a1 sum(x^2) + (a2 - 1) sum(x) + b1 sum(u) + d0 k,

so the noise of two measurements stands against k times the signal, while in one step it stands against one. The
speeds in the sums come from an observer: the model's own output, pulled towards the measurement by ``kappa``.
Regressions that begin at every sample have noise of speed of their own, but share gusts and force noise.

The error of the observer is known too: noise of speed and gusts, which pass on as a variance, and what the doubt about
theta adds from step to step, which does not change sign and so passes on as a standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from trainid_ros.core.samples import SAMPLE_PERIOD
from trainid_ros.core.settings import setting
from trainid_ros.core.state_validation import is_covariance
from trainid_ros.speed_model.method import Learned, Numbers
from trainid_ros.speed_model.physical_parameters import SpeedModelConfig, Symmetric, Theta
from trainid_ros.speed_model.rls import output, regressor, times, updated
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator, load_std

if TYPE_CHECKING:
    from trainid_ros.train.train_file import TrainFile

# x, theta, P, steps since the last regression, last speed seen, variance of x by noise, deviation of x by theta; then a
# block for each step in the window: phi of the step and the speed seen at its start.
_HEAD: Final = 19
_BLOCK: Final = 5


@dataclass(frozen=True, slots=True)
class IntegralRlsConfig(SpeedModelConfig):
    """Settings of the integral RLS."""

    window: int = setting(25, 'steps summed', 'samples', 2, 500)
    hop: int = setting(1, 'samples from one regression to the next', 'samples', 1, 500)
    kappa: float = setting(0.3, 'share of the measurement in the observer', '1', 0.01, 1.0)
    clip: float = setting(4.0, 'errors count for no more than this many standard deviations', '1', 1.0, 100.0)
    drift: float = setting(0.004, 'drift of the Davis a in 1 s (0.2 if no gradient is known)', 'N/kN', 0.0, 10.0)


class Tuning(NamedTuple):
    """What the kernel needs to know.

    ``noise`` is the variance that x gains in a sample period [(m/s)^2], ``drift`` and ``load`` are variances of d0 per
    sample period and b1 per stop.
    """

    window: int
    hop: int
    kappa: float
    clip: float
    noise: float
    drift: float
    load: float


def learn(numbers: Numbers, y: float, u: float, scale: float, variance: float, tuning: Tuning) -> Learned:
    """Return one step: the observer moves on, and after ``hop`` steps over a full window theta is corrected."""
    x, theta, P = numbers[0], numbers[1:5], numbers[5:15]
    phi = regressor(x, u, scale)
    predicted = output(theta, phi) + (1.0 - scale) * x  # type: ignore[arg-type]
    eps = y - predicted
    by_noise, by_theta = observer_variance(numbers[17], numbers[18], P, phi, scale * tuning.noise)  # type: ignore[arg-type]
    told = by_noise + by_theta * by_theta + variance
    limit = tuning.clip * math.sqrt(told)
    seen = min(max(y, predicted - limit), predicted + limit)
    kappa, left = tuning.kappa, 1.0 - tuning.kappa
    window, waited = _moved(numbers, phi, tuning.window), numbers[15] + 1.0
    if len(window) == _BLOCK * tuning.window and waited >= tuning.hop:
        waited = 0.0
        error, summed = regression(theta, window, seen)  # type: ignore[arg-type]
        doubted = (*P[:9], P[9] + tuning.drift * tuning.hop)
        noise = regression_variance(variance, tuning.noise, tuning.window, tuning.hop)
        theta, P = updated(theta, doubted, times(doubted, summed), error, noise)  # type: ignore[arg-type]
    now = predicted + kappa * (seen - predicted)
    # What is not fully believed takes away no doubt; so the limit widens if errors are large again and again.
    after = (left * left * by_noise + kappa * kappa * variance, left * by_theta) if seen == y else (by_noise, by_theta)
    return Learned((now, *theta, *P, waited, seen, *after, *window), predicted, eps, math.inf, 1.0, told)


def observer_variance(by_noise: float, by_theta: float, P: Symmetric, phi: Theta, noise: float) -> tuple[float, float]:
    """Return the variance of x by noise and its deviation by theta after one step without a measurement."""
    return by_noise + noise, by_theta + math.sqrt(max(times(P, phi)[4], 0.0))


def _moved(numbers: Numbers, phi: Theta, length: int) -> Numbers:
    """Return the window with one more step, and the oldest dropped if it was full."""
    window = numbers[_HEAD:]
    if len(window) >= _BLOCK * length:
        window = window[_BLOCK:]
    return (*window, *phi, numbers[16])


def regression(theta: Theta, window: Numbers, seen: float) -> tuple[float, Theta]:
    """Return the error of the change of speed over a window, and the sum of phi over it."""
    summed = sum(window[0::_BLOCK]), sum(window[1::_BLOCK]), sum(window[2::_BLOCK]), sum(window[3::_BLOCK])
    # theta holds a2, but a2 - 1 is what multiplies sum(x).
    return seen - window[4] - (output(theta, summed) - summed[1]), summed


def regression_variance(variance: float, noise: float, window: int, hop: int) -> float:
    """Return the variance that one regression counts with [(m/s)^2].

    Two measurements of its own, and the gusts of a window, of which all that begin within it know no more than one.
    """
    return 2.0 * variance + noise * window * max(1.0, window / hop)


class IntegralRls:
    """The kernel with its tuning and prior."""

    def __init__(self, theta0: Theta, P0: Symmetric, tuning: Tuning) -> None:
        self._start, self._tuning = (0.0, *theta0, *P0, 0.0, 0.0, 0.0, 0.0), tuning

    def start(self, variance: float) -> Numbers:  # noqa: ARG002 - x has no variance here
        """Return the prior."""
        return self._start

    def fits(self, numbers: Numbers) -> bool:
        """Return whether numbers are as many as a state has, with a covariance and no doubt below zero."""
        steps, left = divmod(len(numbers) - _HEAD, _BLOCK)
        sized = left == 0 and 0 <= steps <= self._tuning.window
        return sized and is_covariance(numbers[5:15]) and min(numbers[15], numbers[17], numbers[18]) >= 0.0

    def learn(self, numbers: Numbers, y: float, u: float, scale: float, variance: float) -> Learned:
        """Take in a measurement."""
        return learn(numbers, y, u, scale, variance, self._tuning)

    def coast(self, numbers: Numbers, u: float, scale: float) -> Numbers:
        """Move on as if the model's own speed had been measured."""
        phi = regressor(numbers[0], u, scale)
        x = output(self.theta(numbers), phi) + (1.0 - scale) * numbers[0]
        noise, P = scale * self._tuning.noise, self.covariance(numbers, 0.0)
        doubt = observer_variance(numbers[17], numbers[18], P, phi, noise)
        return (x, *numbers[1:15], numbers[15] + 1.0, x, *doubt, *_moved(numbers, phi, self._tuning.window))

    def anchor(self, numbers: Numbers, y: float, variance: float) -> Numbers:
        """Start x and the window anew from a measurement."""
        return (y, *numbers[1:15], 0.0, y, variance, 0.0)

    def shift(self, numbers: Numbers, change: float) -> Numbers:
        """Change x, and the speeds that the change over the window is counted from."""
        moved = list(numbers)
        moved[0] += change
        for i in (16, *range(_HEAD + _BLOCK - 1, len(moved), _BLOCK)):
            moved[i] += change
        return tuple(moved)

    def widen_speed(self, numbers: Numbers, variance: float) -> Numbers:  # noqa: ARG002 - it counts noise by the window
        """Leave all as it is."""
        return numbers

    def widen_load(self, numbers: Numbers, share: float = 1.0) -> Numbers:
        """Allow for another load: widen b1."""
        return (*numbers[:12], numbers[12] + share * self._tuning.load, *numbers[13:])

    def forget(self, numbers: Numbers, factor: float) -> Numbers:  # noqa: ARG002 - it forgets by itself, or not
        """Leave all as it is."""
        return numbers

    def theta(self, numbers: Numbers) -> Theta:
        """Return a1, a2, b1, d0."""
        return numbers[1:5]  # type: ignore[return-value]

    def covariance(self, numbers: Numbers, variance: float) -> Symmetric:  # noqa: ARG002 - P has its units already
        """Return the covariance of theta."""
        return numbers[5:15]  # type: ignore[return-value]


class SpeedIntegralRls(SpeedModelEstimator):
    """Estimate a1, a2, b1, d0 from aligned samples."""

    def __init__(self, train_file: TrainFile, config: IntegralRlsConfig) -> None:
        def method(theta0: Theta, P0: Symmetric) -> IntegralRls:
            noise = config.acceleration_noise**2 * SAMPLE_PERIOD
            drift = (config.drift * theta0[2]) ** 2 * SAMPLE_PERIOD
            load = (load_std(train_file, config) * theta0[2]) ** 2
            window, hop = int(config.window), int(config.hop)
            return IntegralRls(theta0, P0, Tuning(window, hop, config.kappa, config.clip, noise, drift, load))

        super().__init__(train_file, config, method)
