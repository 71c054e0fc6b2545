# SPDX-License-Identifier: Apache-2.0
"""Integral RLS: least squares on the change of speed over k samples, a cheap remedy for noise in the regressor.

Summed over k steps the model (2) reads

    y(n) - y(n-k) = a1 sum(x^2) + (a2 - 1) sum(x) + b1 sum(u) + d0 k,

so the noise of two measurements is set against k times the signal of the one-step form. The speeds in the sums come
from an observer: the model output, corrected towards the measurement with the gain ``kappa``. Overlapping regressions
have independent speed noise, but share gusts and force noise.

The observer error has two parts: speed noise and gusts are independent from step to step, so their variances add; the
error due to theta keeps its sign, so its standard deviations add.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from trainid_lab.speed_model.rls import MethodNumbers, Numbers, output, regressor, times, updated
from trainid_ros.estimators.settings import SpeedModelConfig
from trainid_ros.interface.errors import setting
from trainid_ros.speed_model.am_vff_rls import Learned, Symmetric, Theta
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator, load_std
from trainid_ros.stream.samples import SAMPLE_PERIOD
from trainid_ros.train.train_file import TrainFile

# x, theta, P, steps since the last regression, last clipped speed, variance of x due to noise, standard deviation of x
# due to theta; then a block for each step in the window: phi of the step and the clipped speed at its start.
_HEAD: Final = 19
_BLOCK: Final = 5


@dataclass(frozen=True, slots=True)
class IntegralRlsConfig(SpeedModelConfig):
    """Settings of the integral RLS."""

    window: int = setting(25, 'steps in one regression', 'samples', 2, 500)
    hop: int = setting(1, 'samples from one regression to the next', 'samples', 1, 500)
    kappa: float = setting(0.3, 'gain of the observer', '1', 0.01, 1.0)
    clip: float = setting(4.0, 'errors are clipped at this many standard deviations', '1', 1.0, 100.0)
    drift: float = setting(0.004, 'drift of the Davis a in 1 s (0.2 if no gradient is known)', 'N/kN', 0.0, 10.0)


class Tuning(NamedTuple):
    """Parameters of the kernel; see the settings.

    ``noise`` is the variance that x gains in a sample period [(m/s)^2], ``drift`` and ``load`` are variances of d0 per
    sample period [(m/s)^2] and of b1 per stop [(m/s per N/kN)^2].
    """

    window: int
    hop: int
    kappa: float
    clip: float
    noise: float
    drift: float
    load: float


def learn(
    numbers: Numbers, y: float, u: float, scale: float, variance: float, tuning: Tuning
) -> tuple[Numbers, Learned]:
    """Return the state after one step, and its result: the observer is updated, every ``hop`` steps also theta.

    Args:
        numbers: State; see the layout above.
        y: Measured speed [m/s].
        u: Specific force over the step [N/kN].
        scale: Duration of the step over the sample period [1].
        variance: Variance of y [(m/s)^2].
        tuning: Parameters of the kernel.

    """
    x, theta, P = numbers[0], numbers[1:5], numbers[5:15]
    phi = regressor(x, u, scale)
    predicted = output(theta, phi) + (1.0 - scale) * x  # type: ignore[arg-type]
    eps = y - predicted
    by_noise, by_theta = observer_variance(numbers[17], numbers[18], P, phi, scale * tuning.noise)  # type: ignore[arg-type]
    total = by_noise + by_theta * by_theta + variance
    limit = tuning.clip * math.sqrt(total)
    clipped = min(max(y, predicted - limit), predicted + limit)
    kappa, rest = tuning.kappa, 1.0 - tuning.kappa
    window, steps = _shifted(numbers, phi, tuning.window), numbers[15] + 1.0
    if len(window) == _BLOCK * tuning.window and steps >= tuning.hop:
        steps = 0.0
        error, summed = regression(theta, window, clipped)  # type: ignore[arg-type]
        drifted = (*P[:9], P[9] + tuning.drift * tuning.hop)
        noise = regression_variance(variance, tuning.noise, tuning.window, tuning.hop)
        theta, P = updated(theta, drifted, times(drifted, summed), error, noise)  # type: ignore[arg-type]
    x = predicted + kappa * (clipped - predicted)
    # A clipped measurement does not reduce the variance, so the limit widens if large errors persist.
    after = (
        (rest * rest * by_noise + kappa * kappa * variance, rest * by_theta) if clipped == y else (by_noise, by_theta)
    )
    return (x, *theta, *P, steps, clipped, *after, *window), Learned(predicted, eps, math.inf, 1.0, total)


def observer_variance(by_noise: float, by_theta: float, P: Symmetric, phi: Theta, noise: float) -> tuple[float, float]:
    """Return the predicted variance of x due to noise [(m/s)^2] and its standard deviation due to theta [m/s]."""
    return by_noise + noise, by_theta + math.sqrt(max(times(P, phi)[4], 0.0))


def _shifted(numbers: Numbers, phi: Theta, length: int) -> Numbers:
    """Return the window with one more step; a full window drops its oldest step."""
    window = numbers[_HEAD:]
    if len(window) >= _BLOCK * length:
        window = window[_BLOCK:]
    return (*window, *phi, numbers[16])


def regression(theta: Theta, window: Numbers, y: float) -> tuple[float, Theta]:
    """Return the error of the change of speed over a window that ends at y [m/s], and the sum of phi over it."""
    summed = sum(window[0::_BLOCK]), sum(window[1::_BLOCK]), sum(window[2::_BLOCK]), sum(window[3::_BLOCK])
    # theta holds a2, while sum(x) is multiplied by a2 - 1.
    return y - window[4] - (output(theta, summed) - summed[1]), summed


def regression_variance(variance: float, noise: float, window: int, hop: int) -> float:
    """Return the noise variance to use for one regression [(m/s)^2].

    It contains two measurements and the gusts of one window. All regressions that start within a window share its
    gusts, so together they have the information of one.

    Args:
        variance: Variance of a measured speed [(m/s)^2].
        noise: Variance that x gains in a sample period [(m/s)^2].
        window: Length of the window [samples].
        hop: Samples from one regression to the next.

    """
    return 2.0 * variance + noise * window * max(1.0, window / hop)


class IntegralRls(MethodNumbers):
    """The kernel with its state; see the layout above."""

    def __init__(self, theta0: Theta, P0: Symmetric, tuning: Tuning) -> None:
        self._tuning = tuning
        self._prior: Numbers = (0.0, *theta0, *P0, 0.0, 0.0, 0.0, 0.0)
        self._numbers = self._prior

    def start(self, variance: float) -> None:  # noqa: ARG002 - x has no variance here
        """Go to the prior."""
        self._numbers = self._prior

    def covariance(self, variance: float) -> Symmetric:  # noqa: ARG002 - P has the units of theta already
        """Return the covariance of theta."""
        return self._numbers[5:15]  # type: ignore[return-value]

    def update(self, y: float, u: float, scale: float, variance: float) -> Learned:
        """Update with a measured speed y [m/s] after the force u [N/kN]; see :class:`Method`."""
        self._numbers, learned = learn(self._numbers, y, u, scale, variance, self._tuning)
        return learned

    def coast(self, u: float, scale: float) -> None:
        """Predict, taking the predicted speed as the measured one in the window."""
        numbers = self._numbers
        phi = regressor(numbers[0], u, scale)
        x = output(self.theta(), phi) + (1.0 - scale) * numbers[0]
        noise, P = scale * self._tuning.noise, self.covariance(0.0)
        spread = observer_variance(numbers[17], numbers[18], P, phi, noise)
        window = _shifted(numbers, phi, self._tuning.window)
        self._numbers = (x, *numbers[1:15], numbers[15] + 1.0, x, *spread, *window)

    def reinit_speed(self, y: float, variance: float) -> None:
        """Restart x and the window from a measured speed y [m/s] with a variance [(m/s)^2]."""
        self._numbers = (y, *self._numbers[1:15], 0.0, y, variance, 0.0)

    def shift(self, change: float) -> None:
        """Add a change of speed [m/s] to x and to all speeds at the starts of the window's steps."""
        moved = list(self._numbers)
        moved[0] += change
        for i in (16, *range(_HEAD + _BLOCK - 1, len(moved), _BLOCK)):
            moved[i] += change
        self._numbers = tuple(moved)

    def inflate_load_variance(self, share: float) -> None:
        """Add a share of the load variance to the variance of b1."""
        numbers = self._numbers
        self._numbers = (*numbers[:12], numbers[12] + share * self._tuning.load, *numbers[13:])


def speed_integral_rls(train_file: TrainFile, config: IntegralRlsConfig) -> SpeedModelEstimator:
    """Return an estimator of a1, a2, b1, d0 from aligned samples by the integral RLS."""

    def method(theta0: Theta, P0: Symmetric) -> IntegralRls:
        noise = config.acceleration_noise**2 * SAMPLE_PERIOD
        drift = (config.drift * theta0[2]) ** 2 * SAMPLE_PERIOD
        load = (load_std(train_file, config) * theta0[2]) ** 2
        window, hop = int(config.window), int(config.hop)
        return IntegralRls(theta0, P0, Tuning(window, hop, config.kappa, config.clip, noise, drift, load))

    return SpeedModelEstimator(train_file, config, method)
