# SPDX-License-Identifier: Apache-2.0
"""Estimation of the resistance from speed windows and known forces.

A speed window gives one observation of the resistance, with Tw, Dw and (600/R)w the traction, its rate and the
curvature, each averaged with the weights of the slope of the window:

    y = a + b v + c s - kappa Tw - delta Dw + kappa_curve (600/R)w + noise.

The tracker is updated with it. Window and tracker need noise levels: that of the speed, and the variance that
disturbances (gusts, map errors) add to one observation and to the mean of many. All are learned online, within bounds
around the declared values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.davis_posterior import DrivenSpeeds
from trainid_ros.resistance.normal import Inflation, SlowNoise, gate
from trainid_ros.resistance.speed_window import (
    Cut,
    SlidingWindow,
    WindowResult,
    WindowSample,
    observe_resistance,
    overlap_factor,
)
from trainid_ros.stream.known_force import SpeedNoise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.resistance.change_points import Tracker
    from trainid_ros.resistance.normal import Array

_DISTURBANCE_MEMORY: Final = 0.03
# The range includes gusts of up to 0.8 N/kN and map errors of 0.5 per mille.
_MIN_DISTURBANCE: Final = 0.3
_MAX_DISTURBANCE: Final = 8.0
_MIN_SLOW: Final = 0.2
_MAX_SLOW: Final = 20.0
# Cap on one innovation in the learned disturbance, since slip is not a disturbance [standard deviations].
_MAX_SIGMAS: Final = 3.0
# Probability of a step above which an innovation is not used to learn the noise of one observation.
_UNCERTAIN: Final = 0.1
# Observations with less weight are rejected.
_MIN_WEIGHT: Final = 0.5


@dataclass(frozen=True, slots=True)
class WindowPlan:
    """Window lengths and declared noise, see VMilsConfig for the units.

    ``inertia`` is 1000 (1 + gamma) / g [N/kN per m/s^2]; ``disturbance_std`` [N/kN] includes gusts and map errors.
    """

    window: float
    hop: float
    inertia: float
    speed_std: float
    disturbance_std: float
    disturbance_time: float
    force_error: float
    force_skew: float
    outliers: float


class WindowLearner:
    """Estimator updated by ticks; the caller uses :meth:`interrupt` instead for a tick that cannot be used.

    Attributes:
        tracker: Estimate of a, b, c, kappa, delta, kappa_curve.
        inflation: Inflation of the covariance for unmodelled errors.
        innovation: Innovation of the last observation [N/kN].
        innovation_variance: Its variance if the observation is good [(N/kN)^2]; 0 before the first.
        test_ratio: Its square over that variance and the square of the gate [1]; above 1 the weight of the
            observation is less than one half.
        driven: Speeds of the windows used.
    """

    STATE: ClassVar[State] = declare(
        'tracker', '_tachometer', '_slow', 'inflation', '_windows', '_disturbance', 'innovation',
        'innovation_variance', 'test_ratio', 'driven',
    )  # fmt: skip

    def __init__(self, tracker: Tracker, plan: WindowPlan) -> None:
        self.tracker = tracker
        self._plan = plan
        self._windows = SlidingWindow(plan.window, plan.hop)
        self._gate = gate(plan.outliers)
        self._clear()

    def _clear(self) -> None:
        self._tachometer = SpeedNoise.declared(self._plan.speed_std, robust=True)
        self._slow = SlowNoise()
        self.inflation = Inflation()
        self._windows.clear()
        self._disturbance = self._plan.disturbance_std**2
        self.innovation = self.innovation_variance = self.test_ratio = 0.0
        self.driven = DrivenSpeeds()

    def reset(self) -> None:
        """Return to the prior."""
        self.tracker.reset()
        self._clear()

    def interrupt(self, speed: float) -> None:
        """Start a new window after a tick that cannot be used; speed in m/s."""
        self._windows.clear()
        self._tachometer.add(speed, math.nan)

    def push(self, tick: WindowSample) -> Rejection | None:
        """Add a tick; every ``hop`` seconds make an observation. Return the rejection, if any."""
        self._tachometer.add(tick.speed, tick.dt)
        # [2]
        cut = self._windows.push(tick)
        if cut is None:
            return None
        observed = observe_resistance(cut.ticks, self._plan.inertia, self._tachometer.std)
        if isinstance(observed, Rejection):
            return observed
        return self._learn(observed, cut)

    def foreseen_information(self, ticks: Sequence[WindowSample], sampled_s: float) -> Array:
        """Return the information that planned motion would give on theta, shape (n, n).

        Args:
            ticks: The motion, at equal intervals; without noise.
            sampled_s: Time between two speeds that are then measured [s].
        """
        plan, n = self._plan, len(self.tracker.prior.mean)
        windows, information = SlidingWindow(plan.window, plan.hop), np.zeros((n, n))
        if not ticks:
            return information
        speed_std = self._tachometer.std * math.sqrt(sampled_s / ticks[0].dt)
        for tick in ticks:
            cut = windows.push(tick)
            observed = None if cut is None else observe_resistance(cut.ticks, plan.inertia, speed_std)
            if cut is None or not isinstance(observed, WindowResult):
                continue
            phi = np.array(list(_regressor(observed)))
            noise, slow = self._noise_of(observed, cut)
            information += np.outer(phi, phi) / (slow * noise)
        return information

    def _learn(self, observed: WindowResult, cut: Cut) -> Rejection | None:
        tracker, phi, stamp_ns = self.tracker, _regressor(observed), cut.ticks[-1].stamp_ns
        # [6]
        noise, slow = self._noise_of(observed, cut)
        expected, variance = tracker.estimate.predict(phi)
        # [7] Eqs. (9), (16).
        nu, S = observed.y - expected, variance + noise
        if not is_finite(nu * nu / S):
            return Rejection(stamp_ns, Reason.NUMERICAL, nu, math.nan)
        # [8]-[14]
        weight = tracker.update(phi, observed.y, noise, slow)
        self.innovation, self.innovation_variance = nu, S
        self.test_ratio = nu * nu / (self._gate**2 * S)
        # [15]
        if tracker.change_probability < _UNCERTAIN:
            self._learn_disturbance(nu, S)
        self._slow.add(weight * nu, variance, slow * noise, (_MIN_SLOW, _MAX_SLOW))
        self.inflation.add(weight * nu, variance + slow * noise, cut.hop)
        if weight < _MIN_WEIGHT:
            return Rejection(stamp_ns, Reason.OUTLIER, nu, self._gate * math.sqrt(S))
        self.driven.add_mean(observed.phi[1], observed.speed_min, observed.speed_max)
        return None

    def _noise_of(self, item: WindowResult, cut: Cut) -> tuple[float, float]:
        """Return the variance of one observation [(N/kN)^2], and the factor on it in the mean of many."""
        plan = self._plan
        force = (plan.force_error * item.traction_size) ** 2 + (plan.force_skew * item.traction_rate) ** 2
        one = item.noise_std**2 + self._disturbance + force
        together = max(1.0, 2.0 * plan.disturbance_time / cut.hop)
        overlap = overlap_factor(len(cut.ticks), cut.samples)
        mean = overlap * item.noise_std**2 + together * plan.disturbance_std**2 + force
        return one, self._slow.factor * mean / one

    def _learn_disturbance(self, nu: float, S: float) -> None:
        """Learn the disturbance variance from the innovations beyond their predicted variance, within bounds."""
        declared = self._plan.disturbance_std * self._plan.disturbance_std
        low, high = _MIN_DISTURBANCE * _MIN_DISTURBANCE * declared, _MAX_DISTURBANCE * _MAX_DISTURBANCE * declared
        bounded = min(nu * nu, _MAX_SIGMAS * _MAX_SIGMAS * S)
        # The noisier an innovation, the less information it carries on a small disturbance.
        gain = _DISTURBANCE_MEMORY * min(1.0, high / S)
        self._disturbance = min(max(self._disturbance + gain * (bounded - S), low), high)


def _regressor(observed: WindowResult) -> vec[float]:
    """Return phi = [1, v, s, -Tw, -Dw, (600/R)w] of theta = [a, b, c, kappa, delta, kappa_curve], 6 numbers."""
    # [5] Eq. (2).
    _, v, s = observed.phi
    return vec[float]([1.0, v, s, -observed.traction, -observed.traction_rate, observed.curve])
