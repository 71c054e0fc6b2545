# SPDX-License-Identifier: Apache-2.0
"""AM-VFF-RLS: the speed model by recursive least squares with auxiliary model and variable forgetting.

After Yuan et al. 2017, algorithm (7), in the order in which it can be computed and with what it needs to work:

* the gain from the true gradient of the auxiliary output, which is corrected by the measurement as theta is
  (``auxiliary_model``); as printed the auxiliary output drifts away from a plant whose pole is 1 - 1e-4;
* lambda from errors that agree (``forgetting``); what is forgotten is the resistance, not the mass, and forgetting
  ends at the prior in every direction;
* P in the units of the parameters, speed noise learned; gusts, force noise, a force that is reported late and slow
  changes of the weather allowed for: a covariance to rely on;
* the input u less gradient and other known resistance, so that d0 is the Davis a and not the gradient;
* a step of any duration, a gate for outliers, theta frozen at standstill and while the brake acts, another load
  allowed for after each stop.

With lambda = 1 and a drift of d0 this is the extended Kalman filter (``ekf``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from trainid_ros.core.samples import SAMPLE_PERIOD
from trainid_ros.core.settings import setting
from trainid_ros.estimators.speed_model.auxiliary_model import (
    Floor,
    anchor,
    correct,
    doubt_load,
    doubt_speed,
    forget,
    moments,
    predict,
    prior_floor,
)
from trainid_ros.estimators.speed_model.estimator import SpeedModelEstimator
from trainid_ros.estimators.speed_model.forgetting import agreement, forgetting_factor
from trainid_ros.estimators.speed_model.method import Learned, Numbers
from trainid_ros.estimators.speed_model.parameters import SpeedModelConfig, Symmetric, Theta

if TYPE_CHECKING:
    from trainid_ros.physics.train_file import TrainFile


# A change of the force takes so many samples, whose errors in time are one.
_CHANGE_SAMPLES: Final = 5.0


@dataclass(frozen=True, slots=True)
class AmVffRlsConfig(SpeedModelConfig):
    """Settings of AM-VFF-RLS."""

    acceleration_noise: float = setting(0.004, 'gusts, force noise and map errors', 'm/s per sqrt(s)', 0.0, 1.0)
    force_skew: float = setting(0.06, 'unknown delay of the reported force', 's', 0.0, 5.0)
    drift: float = setting(0.002, 'drift of the Davis a in 1 s (0.1 if no gradient is known)', 'N/kN', 0.0, 10.0)
    load_std: float = setting(0.001, 'change of the mass at a stop that is not weighed, a share', '1', 0.0, 1.0)
    memory: float = setting(25.0, 'errors that must agree before something is forgotten', 'samples', 1.0, 1e4)
    threshold: float = setting(6.0, 'chi-square of the agreement from which on is forgotten', '1', 0.0, 1e3)
    forgetting_scale: float = setting(50.0, 'sigma of (6): chi-square over the threshold to forget all', '1', 1.0, 1e9)
    min_forgetting: float = setting(0.5, 'smallest forgetting factor', '1', 0.01, 1.0)
    gate: float = setting(4.0, 'errors beyond this many standard deviations are refused', '1', 1.0, 100.0)
    gate_floor: float = setting(0.0, 'errors below this are never refused', 'm/s', 0.0, 10.0)


class Tuning(NamedTuple):
    """What the kernel needs to know.

    Attributes:
        noise: Variance that x gains in a sample period [(m/s)^2].
        drift: Variance that d0 gains in a sample period [(m/s)^2].
        load: Variance that b1 gains at a stop.
        share: Weight of one error in the agreement.
        threshold: See settings.
        scale: See settings.
        low: Smallest forgetting factor.
        gate: See settings.
        gate_floor: See settings [m/s].
        floor: Prior that forgetting ends at.

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
    """Return (7) in its computable order; ``numbers`` are the moments of [x_a, theta] and the agreement of errors."""
    noise, drift, _, share, threshold, sigma, low, gate, gate_floor, floor = tuning
    # x_a = phi' theta(n-1), with its covariance
    m = predict(numbers[:20], u, scale, noise, drift)  # type: ignore[arg-type]
    predicted = m[0]
    eps = y - predicted
    s = m[5] + variance
    std = math.sqrt(s)
    limit = gate * std
    limit = max(limit, gate_floor)
    if not -limit <= eps <= limit:
        return Learned((*m, numbers[20]), predicted, eps, limit, 1.0, s)
    agreed, lam = agreement(numbers[20], eps / std, share), 1.0
    # The variance of ``agreed`` is share / (2 - share) if errors are white.
    chi2 = agreed * agreed * (2.0 - share) / share
    if chi2 > threshold:
        lam = forgetting_factor(chi2, threshold, sigma, low)
        m = forget(m, lam, floor)
    # theta(n) = theta(n-1) + K eps, x_a(n) = phi' theta(n) and P(n)
    return Learned((*correct(m, eps, variance), agreed), predicted, eps, limit, lam, s)


class AuxiliaryModel:
    """The kernel with its tuning and prior.

    A force that is reported ``force_skew`` seconds late puts the speed wrong by its change times that. One delay goes
    through a whole change, so the errors of its samples add up; from one change to the next they count as new ones.
    """

    def __init__(self, theta0: Theta, P0: Symmetric, tuning: Tuning, force_skew: float = 0.0) -> None:
        self.tuning = tuning
        self._skew = _CHANGE_SAMPLES * (force_skew * theta0[2] / SAMPLE_PERIOD) ** 2
        self._theta0, self._P0 = theta0, P0

    def start(self, variance: float) -> Numbers:
        """Return the prior."""
        return (*moments(0.0, variance, self._theta0, self._P0), 0.0)

    def fits(self, numbers: Numbers) -> bool:
        """Return whether numbers are as many as a state has."""
        return len(numbers) == 21

    def learn(self, numbers: Numbers, y: float, u: float, scale: float, variance: float) -> Learned:
        """Take in a measurement."""
        return learn(numbers, y, u, scale, variance, self.tuning)

    def coast(self, numbers: Numbers, u: float, scale: float) -> Numbers:
        """Move on without a measurement."""
        tuning = self.tuning
        return (*predict(numbers[:20], u, scale, tuning.noise, tuning.drift), numbers[20])  # type: ignore[arg-type]

    def anchor(self, numbers: Numbers, y: float, variance: float) -> Numbers:
        """Start x_a anew from a measurement."""
        return (*anchor(numbers[:20], y, variance), numbers[20])  # type: ignore[arg-type]

    def doubt_force(self, numbers: Numbers, change: float) -> Numbers:
        """Allow for a force that is reported late."""
        return (*doubt_speed(numbers[:20], self._skew * change * change), numbers[20])  # type: ignore[arg-type]

    def doubt_load(self, numbers: Numbers) -> Numbers:
        """Allow for another load."""
        return (*doubt_load(numbers[:20], self.tuning.load), numbers[20])  # type: ignore[arg-type]

    def theta(self, numbers: Numbers) -> Theta:
        """Return a1, a2, b1, d0."""
        return numbers[1:5]  # type: ignore[return-value]

    def covariance(self, numbers: Numbers, variance: float) -> Symmetric:  # noqa: ARG002 - P has its units already
        """Return the covariance of theta."""
        return numbers[10:20]  # type: ignore[return-value]


class AmVffRls(SpeedModelEstimator):
    """Estimate a1, a2, b1, d0 from aligned samples."""

    def __init__(self, train_file: TrainFile, config: AmVffRlsConfig) -> None:
        def method(theta0: Theta, P0: Symmetric) -> AuxiliaryModel:
            return AuxiliaryModel(theta0, P0, _tuning(theta0, P0, config), config.force_skew)

        super().__init__(train_file, config, method)


def _tuning(theta0: Theta, P0: Symmetric, config: AmVffRlsConfig) -> Tuning:
    b1 = theta0[2]
    return Tuning(
        noise=config.acceleration_noise**2 * SAMPLE_PERIOD,
        drift=(config.drift * b1) ** 2 * SAMPLE_PERIOD,
        load=(config.load_std * b1) ** 2,
        share=1.0 / config.memory,
        threshold=config.threshold,
        scale=config.forgetting_scale,
        low=config.min_forgetting,
        gate=config.gate,
        gate_floor=config.gate_floor,
        floor=prior_floor(P0),
    )
