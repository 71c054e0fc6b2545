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
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.results import Reason, Rejection

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OUTLIER_SIGMAS: Final = 5.0
_MAX_OUTLIER_SHARE: Final = 0.34
_ROBUST_ROUNDS: Final = 3


@dataclass(frozen=True, slots=True)
class Tick:
    """One sample of a window.

    Attributes:
        stamp_ns: Time stamp of the speed [ns].
        dt: Time since the previous sample [s].
        speed: Measured speed [m/s].
        known_force: Mean known specific force since the previous sample [N/kN].
        traction: Mean specific traction since the previous sample [N/kN].
        curve: Mean curvature since the previous sample as 600 m over the radius [1]; 0 on straight track.

    """

    stamp_ns: int
    dt: float
    speed: float
    known_force: float
    traction: float
    curve: float = 0.0


@dataclass(frozen=True, slots=True)
class WindowResult:
    """One observation of the resistance.

    Attributes:
        y: Observed mean resistance [N/kN], eq. (5) of Liu et al. with rotating mass, gradient and traction.
        phi: Regressor [1, v, v^2] with v in m/s, averaged with the weights of the slope, shape (3,).
        noise_std: Standard deviation of y due to speed noise alone [N/kN].
        traction: Specific traction Tw, averaged with the weights of the slope [N/kN].
        traction_size: Mean absolute specific traction [N/kN].
        traction_rate: Slope Dw of the traction with the weights of the speed slope [N/kN per s]: the error of y per
            second of force delay.
        curve: 600 m over the radius, averaged with the weights of the slope [1].
        duration: Time from the first to the last sample [s].
        speed_min: Slowest speed in the window without outliers [m/s].
        speed_max: Fastest speed in the window without outliers [m/s].

    """

    y: float
    phi: tuple[float, float, float]
    noise_std: float
    traction: float
    traction_size: float
    traction_rate: float
    curve: float
    duration: float
    speed_min: float
    speed_max: float


def observe_resistance(ticks: list[Tick], inertia: float, speed_std: float) -> WindowResult | Rejection:
    """Fit one window.

    Args:
        ticks: The window, oldest first; ``dt`` and forces of the first are not used.
        inertia: Specific force per acceleration, 1000 (1 + gamma) / g [N/kN per m/s^2].
        speed_std: Standard deviation of one speed measurement [m/s].

    Returns:
        The observation, or a rejection if the speed is inconsistent with the forces beyond its noise.

    """
    times, rest = _unforced(ticks, inertia)
    tolerance = _OUTLIER_SIGMAS * speed_std
    weights = _plain_weights(times)
    if _largest_residual(times, rest, weights) <= tolerance:
        return _result(ticks, times, rest, weights, [tick.speed for tick in ticks], inertia, speed_std)
    time, y = np.array(times), np.array(rest)
    robust = y - _robust_line(time, y)
    kept = _inliers(time, y, robust, tolerance)
    if kept.mean() < 1.0 - _MAX_OUTLIER_SHARE:
        worst = float(np.max(np.abs(robust)))
        return Rejection(ticks[-1].stamp_ns, Reason.SPEED_INCONSISTENT, worst, tolerance)
    corrected = np.interp(time, time[kept], np.array([tick.speed for tick in ticks])[kept])
    return _result(ticks, times, rest, _slope_weights(time, kept).tolist(), corrected.tolist(), inertia, speed_std)


def _unforced(ticks: list[Tick], inertia: float) -> tuple[list[float], list[float]]:
    """Return the times since the first tick, and the speeds minus the change due to the known forces."""
    time = pushed = 0.0
    times, rest = [0.0], [ticks[0].speed]
    for tick in ticks[1:]:
        time += tick.dt
        pushed += tick.known_force * tick.dt
        times.append(time)
        rest.append(tick.speed - pushed / inertia)
    return times, rest


def _plain_weights(times: list[float]) -> list[float]:
    """Return the weights of the speeds in the least-squares slope through all of them."""
    middle = math.fsum(times) / len(times)
    centred = [time - middle for time in times]
    square = math.fsum([x * x for x in centred])
    return [x / square for x in centred]


def _largest_residual(times: list[float], y: list[float], weights: list[float]) -> float:
    slope = math.fsum([w * x for w, x in zip(weights, y, strict=True)])
    levels = [x - slope * time for time, x in zip(times, y, strict=True)]
    level = math.fsum(levels) / len(levels)
    return max(max(levels) - level, level - min(levels))


def _result(
    ticks: list[Tick],
    times: list[float],
    rest: list[float],
    weights: list[float],
    speeds: list[float],
    inertia: float,
    speed_std: float,
) -> WindowResult:
    """Return the observation of a line with these weights; a float loop is faster than arrays of 25."""
    phi0 = phi1 = phi2 = traction = size = curve = later = 0.0
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
    slope = math.fsum([w * x for w, x in zip(weights, rest, strict=True)])
    return WindowResult(
        y=-inertia * slope,
        phi=(phi0, phi1, phi2),
        noise_std=inertia * speed_std * math.sqrt(math.fsum([w * w for w in weights])),
        traction=traction,
        traction_size=size / (len(ticks) - 1),
        traction_rate=_traction_rate(ticks, weights),
        curve=curve,
        duration=times[-1],
        speed_min=min(speeds),
        speed_max=max(speeds),
    )


def _traction_rate(ticks: list[Tick], weights: list[float]) -> float:
    """Return sum w_k T(t_k), the slope of the traction [N/kN per s].

    A force that acts delta later changes the speed slope by delta times this value: summation by parts turns the
    changes of T, weighted by the shares of the intervals, into T weighted by w. T at a stamp is the mean of the two
    adjacent intervals.
    """
    means = [tick.traction for tick in ticks]
    at = [0.5 * (before + after) for before, after in pairwise(means)]
    return math.fsum([w * T for w, T in zip(weights, (*at, means[-1]), strict=True)])


@lru_cache(maxsize=64)
def overlap_factor(window: int, hop: int) -> float:
    """Return the ratio of long-run to marginal variance of slopes of overlapping windows in white speed noise.

    Neighbouring slopes share speeds with opposite signs, so their errors partly cancel in the mean.
    """
    c = np.arange(window) - 0.5 * (window - 1)
    lags = range(hop, window, hop)
    return float(1.0 + 2.0 * sum(c[:-lag] @ c[lag:] for lag in lags) / (c @ c))


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
