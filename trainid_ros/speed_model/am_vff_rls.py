# SPDX-License-Identifier: Apache-2.0
"""AM-VFF-RLS: the speed model by recursive least squares with auxiliary model and variable forgetting.

Algorithm (7) of Yuan et al. 2017, in the order in which it can be computed, with these corrections:

* The gain uses the true gradient of the auxiliary output, and the measurement corrects that output together with
  theta (``auxiliary_model``). As printed, the auxiliary output drifts away from a plant whose pole is 1 - 1e-4.
* lambda is computed from the running mean of the errors (``forgetting``). Only the resistance is forgotten, not the
  mass, and forgetting ends at the prior in every direction.
* P has the units of the parameters and is a consistent covariance: the speed noise, the strength of gusts and map
  errors (``disturbance_observer``) and the delay of the reported force (``force_delay``) are estimated, and slow
  changes of the weather are modelled as a drift of d0.
* Gradient and other known resistance act on the speed separately from u, so d0 is the Davis a without the gradient,
  and the error of mass and force affects traction only.
* A step may have any duration, outliers are gated, theta is frozen at standstill and while the brake acts, and b1
  gains variance at each stop for a change of load.

With lambda = 1 and a drift of d0 this is the extended Kalman filter (``speed_model_ekf``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from trainid_ros.settings import setting
from trainid_ros.speed_model.auxiliary_model import (
    Floor,
    anchor,
    correct,
    forget,
    moments,
    predict,
    prior_floor,
    widen_load,
    widen_speed,
)
from trainid_ros.speed_model.forgetting import forgetting_factor, running_mean
from trainid_ros.speed_model.method import Learned, Numbers
from trainid_ros.speed_model.physical_parameters import SpeedModelConfig, Symmetric, Theta
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator, load_std
from trainid_ros.state import is_covariance
from trainid_ros.stream.samples import SAMPLE_PERIOD

if TYPE_CHECKING:
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class AmVffRlsConfig(SpeedModelConfig):
    """Settings of AM-VFF-RLS."""

    drift: float = setting(0.004, 'drift of the Davis a in 1 s (0.1 if no gradient is known)', 'N/kN', 0.0, 10.0)
    memory: float = setting(25.0, 'memory of the running mean of the errors', 'samples', 1.0, 1e4)
    threshold: float = setting(6.0, 'chi-square of the mean error above which lambda falls below 1', '1', 0.0, 1e3)
    forgetting_scale: float = setting(
        50.0, 'sigma of (6): chi-square above the threshold for lambda = 0', '1', 1.0, 1e9
    )
    min_forgetting: float = setting(0.5, 'smallest forgetting factor', '1', 0.01, 1.0)
    gate: float = setting(4.0, 'errors beyond this many standard deviations are rejected', '1', 1.0, 100.0)
    gate_floor: float = setting(0.0, 'errors below this are never rejected', 'm/s', 0.0, 10.0)


class Tuning(NamedTuple):
    """Parameters of the kernel.

    Attributes:
        noise: Variance that x gains in a sample period in addition to what the estimator adds [(m/s)^2].
        drift: Variance that d0 gains in a sample period [(m/s)^2].
        load: Variance that b1 gains at a stop without weighing [(m/s per N/kN)^2].
        share: Weight of one error in the running mean [1].
        threshold: See the setting [1].
        scale: See the setting ``forgetting_scale`` [1].
        low: Smallest forgetting factor [1].
        gate: See the setting [1].
        gate_floor: See the setting [m/s].
        floor: Prior variances at which forgetting ends.

    """

    noise: float
    drift: float
    load: float
    share: float
    threshold: float
    scale: float
    low: float
    gate: float
    gate_floor: float
    floor: Floor


def learn(numbers: Numbers, y: float, u: float, scale: float, variance: float, tuning: Tuning) -> Learned:
    """Return one step of (7) in its computable order.

    Args:
        numbers: Moments of [x_a, theta] and the running mean of the normalised errors.
        y: Measured speed [m/s].
        u: Specific force over the step [N/kN].
        scale: Duration of the step over the sample period [1].
        variance: Variance of y [(m/s)^2].
        tuning: Parameters of the kernel.

    """
    noise, drift, _, share, threshold, sigma, low, gate, gate_floor, floor = tuning
    # Eq. (7): x_a = phi' theta(n-1), with its covariance.
    m = predict(numbers[:20], u, scale, noise, drift)  # type: ignore[arg-type]
    predicted = m[0]
    eps = y - predicted
    s = m[5] + variance
    std = math.sqrt(s)
    limit = gate * std
    limit = max(limit, gate_floor)
    if not -limit <= eps <= limit:
        return Learned((*m, numbers[20]), predicted, eps, limit, 1.0, s)
    mean, lam = running_mean(numbers[20], eps / std, share), 1.0
    # The variance of ``mean`` is share / (2 - share) if the errors are white.
    chi2 = mean * mean * (2.0 - share) / share
    if chi2 > threshold:
        # Eq. (6) on the mean error.
        lam = forgetting_factor(chi2, threshold, sigma, low)
        m = forget(m, lam, floor)
    # Eq. (7): theta(n) = theta(n-1) + K eps, x_a(n) = phi' theta(n) and P(n).
    return Learned((*correct(m, eps, variance), mean), predicted, eps, limit, lam, s)


class AuxiliaryModel:
    """The kernel with its parameters and prior."""

    def __init__(self, theta0: Theta, P0: Symmetric, tuning: Tuning) -> None:
        self.tuning = tuning
        self._theta0, self._P0, self._floor = theta0, P0, prior_floor(P0)

    def start(self, variance: float) -> Numbers:
        """Return the prior; ``variance`` is that of x [(m/s)^2]."""
        return (*moments(0.0, variance, self._theta0, self._P0), 0.0)

    def fits(self, numbers: Numbers) -> bool:
        """Return whether the numbers have the length of a state and hold a valid covariance."""
        return len(numbers) == 21 and is_covariance(numbers[5:20])

    def learn(self, numbers: Numbers, y: float, u: float, scale: float, variance: float) -> Learned:
        """Update with a measured speed y [m/s] after the force u [N/kN]; see :class:`Method`."""
        return learn(numbers, y, u, scale, variance, self.tuning)

    def coast(self, numbers: Numbers, u: float, scale: float) -> Numbers:
        """Predict over ``scale`` sample periods with the force u [N/kN], without a measurement."""
        tuning = self.tuning
        return (*predict(numbers[:20], u, scale, tuning.noise, tuning.drift), numbers[20])  # type: ignore[arg-type]

    def anchor(self, numbers: Numbers, y: float, variance: float) -> Numbers:
        """Restart x_a from a measured speed y [m/s] with a variance [(m/s)^2]."""
        return (*anchor(numbers[:20], y, variance), numbers[20])  # type: ignore[arg-type]

    def shift(self, numbers: Numbers, change: float) -> Numbers:
        """Add a change of speed [m/s] to x_a."""
        return (numbers[0] + change, *numbers[1:])

    def widen_speed(self, numbers: Numbers, variance: float) -> Numbers:
        """Add to the variance of x_a [(m/s)^2]."""
        return (*widen_speed(numbers[:20], variance), numbers[20])  # type: ignore[arg-type]

    def widen_load(self, numbers: Numbers, share: float = 1.0) -> Numbers:
        """Add a share of the load variance to the variance of b1."""
        return (*widen_load(numbers[:20], share * self.tuning.load), numbers[20])  # type: ignore[arg-type]

    def forget(self, numbers: Numbers, factor: float) -> Numbers:
        """Forget the resistance by a factor, down to the prior."""
        return (*forget(numbers[:20], factor, self._floor), 0.0)  # type: ignore[arg-type]

    def theta(self, numbers: Numbers) -> Theta:
        """Return a1 [s/m], a2 [1], b1 [m/s per N/kN], d0 [m/s]."""
        return numbers[1:5]  # type: ignore[return-value]

    def covariance(self, numbers: Numbers, variance: float) -> Symmetric:  # noqa: ARG002 - P has the units of theta already
        """Return the covariance of theta."""
        return numbers[10:20]  # type: ignore[return-value]


class AmVffRls(SpeedModelEstimator):
    """Estimate a1, a2, b1, d0 from aligned samples."""

    def __init__(self, train_file: TrainFile, config: AmVffRlsConfig) -> None:
        def method(theta0: Theta, P0: Symmetric) -> AuxiliaryModel:
            return AuxiliaryModel(theta0, P0, _tuning(theta0, P0, config, load_std(train_file, config)))

        super().__init__(train_file, config, method, adaptive=True)


def _tuning(theta0: Theta, P0: Symmetric, config: AmVffRlsConfig, load: float) -> Tuning:
    b1 = theta0[2]
    return Tuning(
        noise=0.0,
        drift=(config.drift * b1) ** 2 * SAMPLE_PERIOD,
        load=(load * b1) ** 2,
        share=1.0 / config.memory,
        threshold=config.threshold,
        scale=config.forgetting_scale,
        low=config.min_forgetting,
        gate=config.gate,
        gate_floor=config.gate_floor,
        floor=prior_floor(P0),
    )
