# SPDX-License-Identifier: Apache-2.0
"""Estimation of the resistance from speed windows and known forces.

A speed window gives one observation of the resistance, with Tw, Dw and (600/R)w the traction, its rate and the
curvature, each averaged with the weights of the slope of the window:

    y = a + b v + c s - kappa Tw - delta Dw + kappa_curve (600/R)w + noise.

Differenced 5 Hz speed is too noisy (Liu et al. 2018, Fig. 1), so y is the slope of a least-squares line. The paper's
line assumes constant forces within the window; here the speed v_u that the known force alone would give is subtracted
first. The remainder, ``v - v_u = v0 - (1/m) * integral of w(v)``, depends on the resistance only; its slope is exact
even if traction or gradient change within the window.

The noise of the speed, and the variance that disturbances (gusts, map errors) add to one observation and to the mean of
many, whose noise is correlated, are learned online, within bounds around the declared values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, several
from trainid_ros.interface.vectors import append, vec
from trainid_ros.resistance.change_points import Array, Tracker, dot, gate
from trainid_ros.resistance.davis_posterior import DrivenSpeeds, Inflation
from trainid_ros.stream.known_force import SpeedNoise

# Speeds further from the line of their window are outliers [standard deviations]; largest share of them [1].
_OUTLIER_SIGMAS: Final = 5.0
_MAX_OUTLIER_SHARE: Final = 0.34
# A line fit through fewer samples cannot detect outliers; at low sample rates the windows are longer.
_MIN_SAMPLES: Final = 8


@dataclass(slots=True)
class WindowSample:
    """One sample of a window."""

    stamp_ns: int  # Time stamp of the speed [ns]
    dt: float  # Time since the previous sample [s]
    speed: float  # Measured speed [m/s]
    known_force: float  # Mean known specific force since the previous sample [N/kN]
    traction: float  # Mean specific traction since the previous sample [N/kN]
    curve: float = 0.0  # Mean curvature since the previous sample as 600 m over the radius [1]; 0 on straight track


@dataclass(slots=True)
class WindowResult:
    """One observation of the resistance."""

    y: float  # Observed mean resistance [N/kN], eq. (5) of Liu et al. with rotating mass, gradient and traction
    # Regressor [1, v, v^2] with v in m/s, averaged with the weights of the slope, shape (3,)
    phi: tuple[float, float, float]
    noise_std: float  # Standard deviation of y due to speed noise alone [N/kN]
    traction: float  # Specific traction Tw, averaged with the weights of the slope [N/kN]
    traction_size: float  # Mean absolute specific traction [N/kN]
    traction_rate: float  # Slope Dw of the traction with these weights [N/kN per s]: error of y per second of delay
    curve: float  # 600 m over the radius, averaged with the weights of the slope [1]
    speed_min: float  # Slowest speed in the window without outliers [m/s]
    speed_max: float  # Fastest speed in the window without outliers [m/s]


@dataclass(slots=True)
class Cut:
    """Samples of a window."""

    samples: list[WindowSample]
    hop: float  # time from one window to the next [s]

    @property
    def hop_samples(self) -> int:
        """Samples from one window to the next."""
        duration = seconds(self.samples[-1].stamp_ns - self.samples[0].stamp_ns)
        return max(1, round(self.hop * (len(self.samples) - 1) / duration))


class SlidingWindow:
    """Window of the latest ``length`` seconds every ``hop`` seconds, both to half a sample period.

    A window with fewer than 8 samples grows to 8, and the hop in proportion.
    """

    STATE: ClassVar[State] = declare(several('samples', WindowSample), 'fresh_s')

    def __init__(self, length: float, hop: float) -> None:
        self._length, self._hop = length, hop
        self.clear()

    def clear(self) -> None:
        """Remove all samples."""
        self.samples: list[WindowSample] = []
        self.fresh_s = 0.0

    def push(self, sample: WindowSample) -> Cut | None:
        """Add one sample; return a window if one is due."""
        samples = self.samples
        samples.append(sample)
        self.fresh_s += sample.dt
        if len(samples) < _MIN_SAMPLES:
            return None
        half = 0.5 * self._span(0) / (len(samples) - 1)
        while len(samples) > _MIN_SAMPLES and self._span(1) > self._length - half:
            del samples[0]
        span = self._span(0)
        hop = self._hop * max(1.0, span / self._length) if len(samples) == _MIN_SAMPLES else self._hop
        # [2] The segments of Fig. 2, in time instead of speed.
        if span < self._length - half or self.fresh_s < hop - half:
            return None
        self.fresh_s = 0.0
        return Cut(list(samples), hop)

    def _span(self, first: int) -> float:
        return seconds(self.samples[-1].stamp_ns - self.samples[first].stamp_ns)


def observe_resistance(samples: list[WindowSample], inertia: float, speed_std: float) -> WindowResult | Rejection:
    """Fit one window.

    Args:
        samples: The window, oldest first; ``dt`` and forces of the first are not used.
        inertia: Specific force per acceleration, 1000 (1 + gamma) / g0 [N/kN per m/s^2].
        speed_std: Standard deviation of one speed measurement [m/s].

    Returns:
        The observation, or a rejection if the speed is inconsistent with the forces beyond its noise.
    """
    time = pushed = 0.0
    times, rest, speeds = vec[float](), vec[float](), vec[float]()
    for k in range(len(samples)):
        sample = samples[k]
        if k > 0:
            time += sample.dt
            pushed += sample.known_force * sample.dt
        times, speeds = append(times, time), append(speeds, sample.speed)
        # [3] v - v_u, whose slope replaces eq. (6).
        rest = append(rest, sample.speed - pushed / inertia)
    tolerance, weights = _OUTLIER_SIGMAS * speed_std, _plain_weights(times)
    if _largest_residual(times, rest, weights) > tolerance:
        t, y, v = np.array(list(times)), np.array(list(rest)), np.array(list(speeds))
        robust = y - _robust_line(t, y)
        kept = _inliers(t, y, robust, tolerance)
        if kept.mean() < 1.0 - _MAX_OUTLIER_SHARE:
            worst = float(np.max(np.abs(robust)))
            return Rejection(samples[-1].stamp_ns, Reason.SPEED_INCONSISTENT, worst, tolerance)
        weights = vec[float](_slope_weights(t, kept).tolist())
        speeds = vec[float](np.interp(t, t[kept], v[kept]).tolist())
    return _result(samples, rest, weights, speeds, inertia, speed_std)


def _mean(x: vec[float]) -> float:
    total = 0.0
    for k in range(len(x)):
        total += x[k]
    return total / float(len(x))


def _plain_weights(times: vec[float]) -> vec[float]:
    """Return the weights of the speeds in the least-squares slope."""
    middle, weights = _mean(times), vec[float]()
    for k in range(len(times)):
        weights = append(weights, times[k] - middle)
    square = dot(weights, weights)
    for k in range(len(times)):
        weights[k] /= square
    return weights


def _largest_residual(times: vec[float], y: vec[float], weights: vec[float]) -> float:
    slope, largest = dot(weights, y), 0.0
    level = _mean(y) - slope * _mean(times)
    for k in range(len(y)):
        largest = max(largest, abs(y[k] - slope * times[k] - level))
    return largest


def _result(
    samples: list[WindowSample],
    rest: vec[float],
    weights: vec[float],
    speeds: vec[float],
    inertia: float,
    speed_std: float,
) -> WindowResult:
    phi0 = phi1 = phi2 = traction = size = rate = curve = later = 0.0
    slowest, fastest, T = speeds[0], speeds[0], samples[-1].traction
    for k in range(len(samples) - 1, 0, -1):
        sample, v1, v0 = samples[k], speeds[k], speeds[k - 1]
        # Share of the interval in the slope: a change of speed there shifts all later speeds.
        later += weights[k]
        share = sample.dt * later
        phi0 += share
        phi1 += share * 0.5 * (v0 + v1)
        phi2 += share * (v0 * v0 + v0 * v1 + v1 * v1) / 3.0
        traction += share * sample.traction
        curve += share * sample.curve
        size += abs(sample.traction)
        # A force that acts delta later changes the slope by delta sum w_k T(t_k); T at a stamp is the mean beside it.
        rate += weights[k] * T
        T = 0.5 * (samples[k - 1].traction + sample.traction)
        slowest, fastest = min(slowest, v1), max(fastest, v1)
    return WindowResult(
        # [4] Eqs. (3)-(5).
        y=-inertia * dot(weights, rest),
        phi=(phi0, phi1, phi2),
        noise_std=inertia * speed_std * math.sqrt(dot(weights, weights)),
        traction=traction,
        traction_size=size / (len(samples) - 1),
        traction_rate=rate + weights[0] * T,
        curve=curve,
        speed_min=slowest,
        speed_max=fastest,
    )


@lru_cache(maxsize=64)
def overlap_factor(window: int, hop: int) -> float:
    """Return the ratio of long-run to marginal variance of slopes of overlapping windows in white speed noise.

    Neighbouring slopes share speeds with opposite signs, so their errors partly cancel.
    """
    c = np.arange(window) - 0.5 * (window - 1)
    covariances = [float(c[:-lag] @ c[lag:]) for lag in range(hop, window, hop)]
    return 1.0 + 2.0 * math.fsum(covariances) / float(c @ c)


def _slope_weights(time: Array, kept: NDArray[np.bool_]) -> Array:
    centred = np.where(kept, time - time[kept].mean(), 0.0)
    weights: Array = centred / (centred @ centred)
    return weights


def _line(time: Array, y: Array, kept: NDArray[np.bool_]) -> Array:
    slope = float(_slope_weights(time, kept) @ y)
    line: Array = y[kept].mean() + slope * (time - time[kept].mean())
    return line


def _robust_line(time: Array, y: Array) -> Array:
    """Return the line through the medians of the two halves."""
    half = len(y) // 2
    slope = (np.median(y[-half:]) - np.median(y[:half])) / (np.median(time[-half:]) - np.median(time[:half]))
    line: Array = slope * time + np.median(y - slope * time)
    return line


def _inliers(time: Array, y: Array, robust: Array, tolerance: float) -> NDArray[np.bool_]:
    """Mark the speeds within ``tolerance`` of the line, so that single spikes do not invalidate a window."""
    kept = np.ones(len(y), dtype=bool)
    if np.max(np.abs(y - _line(time, y, kept))) <= tolerance:
        return kept
    kept = np.abs(robust) <= 2.0 * tolerance
    for _ in range(3):
        if kept.mean() < 0.5:
            break
        kept = np.abs(y - _line(time, y, kept)) <= tolerance
    return kept


# Observations in a batch of the slow noise, and how many batches are averaged, fewer at first.
_BATCH: Final = 20
_SLOW_MEMORY: Final = 25.0
_FIRST_SLOW_MEMORY: Final = 12.0
# The ratio of one batch is limited, since a parameter step is not noise. Steps still count until they are detected;
# otherwise gusts that look like steps would never be learned.
_MAX_SLOW_RATIO: Final = 6.0


@dataclass(slots=True)
class SlowNoise:
    """Learned factor on the noise variance in the mean of many observations, and the current batch.

    As for :class:`Inflation`, the squared sum of the innovations of a batch is compared with the sum of variances.
    """

    factor: float = 1.0  # factor on the noise variance [1]
    total: float = 0.0  # sum of the innovations of the batch [N/kN]
    variance: float = 0.0  # expected variance of that sum [(N/kN)^2]
    known: float = 0.0  # share of the noise in it [(N/kN)^2]
    count: int = 0  # innovations in the batch
    memory: float = _FIRST_SLOW_MEMORY  # batches that the factor remembers

    def add(self, nu: float, prediction: float, variance: float, bounds: tuple[float, float]) -> None:
        """Add an innovation times its outlier weight [N/kN], within bounds of the factor [1].

        The variances are those of its prediction, and of its noise in the mean of many including the factor [(N/kN)^2].
        """
        self.total += nu
        self.variance += prediction + variance
        self.known += variance
        self.count += 1
        if self.count < _BATCH:
            return
        ratio = min(self.total * self.total / self.variance, _MAX_SLOW_RATIO)
        # If the parameter uncertainty dominates the variance, the batch carries little information on the noise.
        gain = self.known / self.variance / self.memory
        self.memory = min(self.memory + 1.0, _SLOW_MEMORY)
        self.factor = min(max(self.factor * (1.0 + gain * (ratio - 1.0)), bounds[0]), bounds[1])
        self.total = self.variance = self.known = 0.0
        self.count = 0


# Gain of one innovation in the learned disturbance variance [1].
_DISTURBANCE_MEMORY: Final = 0.03
# Range of the disturbance, as multiples of the declared one: gusts of up to 0.8 N/kN and map errors of 0.5 per mille.
_MIN_DISTURBANCE: Final = 0.3
_MAX_DISTURBANCE: Final = 8.0
# Limits of the factor of the slow noise [1].
_SLOW_BOUNDS: Final = (0.2, 20.0)
# Cap on one innovation in the learned disturbance, since slip is not a disturbance [standard deviations].
_MAX_SIGMAS: Final = 3.0
# Probability of a step above which an innovation is not used to learn the noise of one observation.
_UNCERTAIN: Final = 0.1


class WindowLearner:
    """Tracker updated by samples in windows; :meth:`interrupt` is for a sample that cannot be used.

    Attributes:
        tracker: Estimate of a, b, c, kappa, delta, kappa_curve.
        inflation: Inflation of the covariance for unmodelled errors.
        innovation: Innovation of the last observation [N/kN].
        innovation_variance: Its variance if the observation is good [(N/kN)^2]; 0 before the first.
        test_ratio: Its square over that variance and the square of the gate [1], above 1 if its weight is below 1/2.
        driven: Speeds of the windows used.
    """

    STATE: ClassVar[State] = declare(
        'tracker', '_speed_noise', '_slow', 'inflation', '_windows', '_disturbance', 'innovation',
        'innovation_variance', 'test_ratio', 'driven',
    )  # fmt: skip

    def __init__(self, tracker: Tracker, config: VMilsConfig, inertia: float, gradient_std: float) -> None:
        """Prepare; inertia as in :func:`observe_resistance`, std of the gradients of the map [per mille]."""
        self.tracker = tracker
        self._config, self._inertia = config, inertia
        # A gradient of 1 per mille is 1 N/kN.
        self._disturbance_std = math.hypot(config.disturbance_std, gradient_std)
        self._windows = SlidingWindow(config.window, config.hop)
        self._gate = gate(config.outlier_share)
        self._clear()

    def _clear(self) -> None:
        self._speed_noise = SpeedNoise.declared(self._config.speed_std, robust=True)
        self._slow = SlowNoise()
        self.inflation = Inflation()
        self._windows.clear()
        self._disturbance = self._disturbance_std**2
        self.innovation = self.innovation_variance = self.test_ratio = 0.0
        self.driven = DrivenSpeeds()

    def reset(self) -> None:
        """Return to the prior."""
        self.tracker.reset()
        self._clear()

    def interrupt(self, speed: float) -> None:
        """Start a new window after a sample that cannot be used; speed in m/s."""
        self._windows.clear()
        self._speed_noise.add(speed, math.nan)

    def push(self, sample: WindowSample) -> Rejection | None:
        """Add a sample; every ``hop`` seconds make an observation. Return the rejection, if any."""
        self._speed_noise.add(sample.speed, sample.dt)
        # [2]
        cut = self._windows.push(sample)
        if cut is None:
            return None
        observed = observe_resistance(cut.samples, self._inertia, self._speed_noise.std)
        return observed if isinstance(observed, Rejection) else self._learn(observed, cut)

    def foreseen_information(self, samples: Sequence[WindowSample], sampled_s: float) -> Array:
        """Return the information that planned motion, without noise at equal intervals, would give on theta.

        ``sampled_s`` is the time between two speeds that are then measured [s]; the information has the shape (n, n).
        """
        config, n = self._config, len(self.tracker.prior.mean)
        windows, information = SlidingWindow(config.window, config.hop), np.zeros((n, n))
        if not samples:
            return information
        speed_std = self._speed_noise.std * math.sqrt(sampled_s / samples[0].dt)
        for sample in samples:
            cut = windows.push(sample)
            observed = None if cut is None else observe_resistance(cut.samples, self._inertia, speed_std)
            if cut is None or not isinstance(observed, WindowResult):
                continue
            phi = np.array(list(_regressor(observed)))
            noise, slow = self._noise_of(observed, cut)
            information += np.outer(phi, phi) / (slow * noise)
        return information

    def _learn(self, observed: WindowResult, cut: Cut) -> Rejection | None:
        tracker, phi, stamp_ns = self.tracker, _regressor(observed), cut.samples[-1].stamp_ns
        # [6]
        noise, slow = self._noise_of(observed, cut)
        expected, variance = tracker.estimate.predict(phi)
        walked, walk_variance = tracker.walk.predict(phi)
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
        self._slow.add(weight * nu, variance, slow * noise, _SLOW_BOUNDS)
        # Those of the long memory hold the steps too, for which the walk allows.
        self.inflation.add(weight * (observed.y - walked), walk_variance + slow * noise, cut.hop)
        if weight < 0.5:
            return Rejection(stamp_ns, Reason.OUTLIER, nu, self._gate * math.sqrt(S))
        self.driven.add_mean(observed.phi[1], observed.speed_min, observed.speed_max)
        return None

    def _noise_of(self, item: WindowResult, cut: Cut) -> tuple[float, float]:
        """Return the variance of one observation [(N/kN)^2], and the factor on it in the mean of many."""
        config = self._config
        force = (config.force_error * item.traction_size) ** 2 + (config.force_skew * item.traction_rate) ** 2
        one = item.noise_std**2 + self._disturbance + force
        together = max(1.0, 2.0 * config.disturbance_time / cut.hop)
        overlap = overlap_factor(len(cut.samples), cut.hop_samples)
        mean = overlap * item.noise_std**2 + together * self._disturbance_std**2 + force
        return one, self._slow.factor * mean / one

    def _learn_disturbance(self, nu: float, S: float) -> None:
        """Learn the disturbance variance from the innovations beyond their predicted variance, within bounds."""
        declared = self._disturbance_std * self._disturbance_std
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
