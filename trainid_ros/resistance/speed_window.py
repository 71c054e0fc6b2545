# SPDX-License-Identifier: Apache-2.0
"""Resistance from a short window of speed: least-squares slope of the speed minus the effect of the known force.

Differenced 5 Hz speed is too noisy (Liu et al. 2018, Fig. 1), so a line is fitted through a window. The paper's
acceleration of that line assumes constant forces within the window; here the speed v_u that the known force alone
would give is subtracted first. The remainder, ``v - v_u = v0 - (1/m) * integral of w(v)``, depends on the resistance
only, and its slope is exact even if traction or gradient change within the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import seconds
from trainid_ros.interface.state import State, declare, several
from trainid_ros.interface.vectors import append, vec
from trainid_ros.resistance.normal import dot

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OUTLIER_SIGMAS: Final = 5.0
_MAX_OUTLIER_SHARE: Final = 0.34
_ROBUST_ROUNDS: Final = 3
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

    y: float  # Observed mean resistance [N/kN], eq. (5) of Liu et al. with rotating mass, gradient and traction.
    # Regressor [1, v, v^2] with v in m/s, averaged with the weights of the slope, shape (3,)
    phi: tuple[float, float, float]
    noise_std: float  # Standard deviation of y due to speed noise alone [N/kN]
    traction: float  # Specific traction Tw, averaged with the weights of the slope [N/kN]
    traction_size: float  # Mean absolute specific traction [N/kN]
    # Slope Dw of the traction with the weights of the speed slope [N/kN per s]: the error of y per second of force
    # delay
    traction_rate: float
    curve: float  # 600 m over the radius, averaged with the weights of the slope [1]
    duration: float  # Time from the first to the last sample [s]
    speed_min: float  # Slowest speed in the window without outliers [m/s]
    speed_max: float  # Fastest speed in the window without outliers [m/s]


@dataclass(slots=True)
class Cut:
    """Samples of a window, and the time from one window to the next [s]."""

    ticks: list[WindowSample]
    hop: float

    @property
    def samples(self) -> int:
        """Samples from one window to the next."""
        duration = seconds(self.ticks[-1].stamp_ns - self.ticks[0].stamp_ns)
        return max(1, round(self.hop * (len(self.ticks) - 1) / duration))


class SlidingWindow:
    """Window of the latest ``length`` seconds every ``hop`` seconds, both to half a sample period.

    At rates with fewer than 8 samples in a window, the window grows to 8 samples and the hop in proportion.
    """

    STATE: ClassVar[State] = declare(several('ticks', WindowSample), 'fresh_s')

    def __init__(self, length: float, hop: float) -> None:
        self._length, self._hop = length, hop
        self.clear()

    def clear(self) -> None:
        """Remove all samples."""
        self.ticks: list[WindowSample] = []
        self.fresh_s = 0.0

    def push(self, tick: WindowSample) -> Cut | None:
        """Add one sample; return a window if the sample completes one that is due."""
        ticks = self.ticks
        ticks.append(tick)
        self.fresh_s += tick.dt
        if len(ticks) < _MIN_SAMPLES:
            return None
        half = 0.5 * self._span(0) / (len(ticks) - 1)
        while len(ticks) > _MIN_SAMPLES and self._span(1) > self._length - half:
            del ticks[0]
        span = self._span(0)
        hop = self._hop * max(1.0, span / self._length) if len(ticks) == _MIN_SAMPLES else self._hop
        # [2] The segments of Fig. 2, in time instead of speed.
        if span < self._length - half or self.fresh_s < hop - half:
            return None
        self.fresh_s = 0.0
        return Cut(list(ticks), hop)

    def _span(self, first: int) -> float:
        return seconds(self.ticks[-1].stamp_ns - self.ticks[first].stamp_ns)


def observe_resistance(ticks: list[WindowSample], inertia: float, speed_std: float) -> WindowResult | Rejection:
    """Fit one window.

    Args:
        ticks: The window, oldest first; ``dt`` and forces of the first are not used.
        inertia: Specific force per acceleration, 1000 (1 + gamma) / g [N/kN per m/s^2].
        speed_std: Standard deviation of one speed measurement [m/s].

    Returns:
        The observation, or a rejection if the speed is inconsistent with the forces beyond its noise.
    """
    times, rest = _unforced(ticks, inertia)
    tolerance, weights = _OUTLIER_SIGMAS * speed_std, _plain_weights(times)
    speeds = vec[float]()
    for tick in ticks:
        speeds = append(speeds, tick.speed)
    if _largest_residual(times, rest, weights) > tolerance:
        time, y, v = np.array(list(times)), np.array(list(rest)), np.array(list(speeds))
        robust = y - _robust_line(time, y)
        kept = _inliers(time, y, robust, tolerance)
        if kept.mean() < 1.0 - _MAX_OUTLIER_SHARE:
            worst = float(np.max(np.abs(robust)))
            return Rejection(ticks[-1].stamp_ns, Reason.SPEED_INCONSISTENT, worst, tolerance)
        weights = vec[float](_slope_weights(time, kept).tolist())
        speeds = vec[float](np.interp(time, time[kept], v[kept]).tolist())
    return _result(ticks, times, rest, weights, speeds, inertia, speed_std)


def _unforced(ticks: list[WindowSample], inertia: float) -> tuple[vec[float], vec[float]]:
    """Return the times since the first tick, and the speeds minus the change due to the known forces."""
    time = pushed = 0.0
    times, rest = vec[float](), vec[float]()
    for k in range(len(ticks)):
        if k > 0:
            time += ticks[k].dt
            pushed += ticks[k].known_force * ticks[k].dt
        times = append(times, time)
        # [3] v - v_u, whose slope replaces eq. (6).
        rest = append(rest, ticks[k].speed - pushed / inertia)
    return times, rest


def _mean(x: vec[float]) -> float:
    total = 0.0
    for k in range(len(x)):
        total += x[k]
    return total / float(len(x))


def _plain_weights(times: vec[float]) -> vec[float]:
    """Return the weights of the speeds in the least-squares slope through all of them."""
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
    ticks: list[WindowSample],
    times: vec[float],
    rest: vec[float],
    weights: vec[float],
    speeds: vec[float],
    inertia: float,
    speed_std: float,
) -> WindowResult:
    """Return the observation of a line with these weights."""
    phi0 = phi1 = phi2 = traction = size = curve = later = 0.0
    slowest = fastest = speeds[0]
    for k in range(len(ticks) - 1, 0, -1):
        tick, v1, v0 = ticks[k], speeds[k], speeds[k - 1]
        # Share of the interval in the slope: a change of speed there shifts all later speeds.
        later += weights[k]
        share = tick.dt * later
        phi0 += share
        phi1 += share * 0.5 * (v0 + v1)
        phi2 += share * (v0 * v0 + v0 * v1 + v1 * v1) / 3.0
        traction += share * tick.traction
        curve += share * tick.curve
        size += abs(tick.traction)
        slowest, fastest = min(slowest, v1), max(fastest, v1)
    return WindowResult(
        # [4] Eqs. (3)-(5).
        y=-inertia * dot(weights, rest),
        phi=(phi0, phi1, phi2),
        noise_std=inertia * speed_std * math.sqrt(dot(weights, weights)),
        traction=traction,
        traction_size=size / (len(ticks) - 1),
        traction_rate=_traction_rate(ticks, weights),
        curve=curve,
        duration=times[-1],
        speed_min=slowest,
        speed_max=fastest,
    )


def _traction_rate(ticks: list[WindowSample], weights: vec[float]) -> float:
    """Return sum w_k T(t_k), the slope of the traction; T at a stamp is the mean of the two adjacent intervals.

    A force that acts delta later changes the speed slope by delta times this value: summation by parts turns the
    changes of T, weighted by the shares of the intervals, into T weighted by w.
    """
    rate, T = 0.0, ticks[-1].traction
    for k in range(len(ticks) - 1, 0, -1):
        rate += weights[k] * T
        T = 0.5 * (ticks[k - 1].traction + ticks[k].traction)
    return rate + weights[0] * T


@lru_cache(maxsize=64)
def overlap_factor(window: int, hop: int) -> float:
    """Return the ratio of long-run to marginal variance of slopes of overlapping windows in white speed noise.

    Neighbouring slopes share speeds with opposite signs, so their errors partly cancel in the mean.
    """
    c = np.arange(window) - 0.5 * (window - 1)
    covariances = [float(c[:-lag] @ c[lag:]) for lag in range(hop, window, hop)]
    return 1.0 + 2.0 * math.fsum(covariances) / float(c @ c)


def _slope_weights(time: NDArray[np.float64], kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    centred = np.where(kept, time - time[kept].mean(), 0.0)
    weights: NDArray[np.float64] = centred / (centred @ centred)
    return weights


def _line(time: NDArray[np.float64], y: NDArray[np.float64], kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    slope = float(_slope_weights(time, kept) @ y)
    line: NDArray[np.float64] = y[kept].mean() + slope * (time - time[kept].mean())
    return line


def _robust_line(time: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the line through the medians of the two halves."""
    half = len(y) // 2
    slope = (np.median(y[-half:]) - np.median(y[:half])) / (np.median(time[-half:]) - np.median(time[:half]))
    line: NDArray[np.float64] = slope * time + np.median(y - slope * time)
    return line


def _inliers(
    time: NDArray[np.float64], y: NDArray[np.float64], robust: NDArray[np.float64], tolerance: float
) -> NDArray[np.bool_]:
    """Mark the speeds within ``tolerance`` of the line, so that single spikes do not invalidate a window."""
    kept = np.ones(len(y), dtype=bool)
    if np.max(np.abs(y - _line(time, y, kept))) <= tolerance:
        return kept
    kept = np.abs(robust) <= 2.0 * tolerance
    for _ in range(_ROBUST_ROUNDS):
        if kept.mean() < 0.5:
            break
        kept = np.abs(y - _line(time, y, kept)) <= tolerance
    return kept
