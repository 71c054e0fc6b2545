# SPDX-License-Identifier: Apache-2.0
"""Statistics that show which numbers of a bag are speed, position, force, gradient and brake command."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.bag.number_series import NumberSeries

    Array = NDArray[np.float64]

STEP_S: Final = 0.2
"""Interval of the common times [s]."""
# Half of the time over which a derivative is taken [steps].
_HALF: Final = 5
# Values farther apart are not interpolated [s]; slower series are always.
_LONGEST_S: Final = 1.5
_FEWEST: Final = 50
# Changes of a position are compared with the distance over so much time, at least [s], and at most.
_SPAN_S: Final = (8.0, 900.0)


def common_times(speed: NumberSeries) -> Array:
    """Return the times at which all series are compared with a speed [s], shape (n,)."""
    return np.arange(speed.time[0], speed.time[-1], STEP_S)


def at_times(series: NumberSeries, times: Array) -> Array:
    """Return the numbers at times [s], shape (n,): interpolated, NaN in gaps; whole and rare ones are held."""
    after = np.searchsorted(series.time, times, side='right')
    before = np.clip(after - 1, 0, series.time.size - 1)
    if series.is_whole or not series.rate > 1.0 / _LONGEST_S:
        held: Array = np.where(after > 0, series.value[before], math.nan)
        return held
    values = np.interp(times, series.time, series.value, left=math.nan, right=math.nan)
    gap = series.time[np.clip(after, 0, series.time.size - 1)] - series.time[before]
    return np.where(gap > _LONGEST_S, math.nan, values)


def derivative(values: Array) -> Array:
    """Return the change per second of values at common times, shape (n,); NaN at the ends."""
    slope = np.full_like(values, math.nan)
    slope[_HALF:-_HALF] = (values[2 * _HALF :] - values[: -2 * _HALF]) / (2 * _HALF * STEP_S)
    return slope


def correlation(x: Array, y: Array) -> float:
    """Return the correlation of two series where both are known [1]; 0 if that is hardly anywhere."""
    known = np.isfinite(x) & np.isfinite(y)
    if np.count_nonzero(known) < _FEWEST or np.ptp(x[known]) == 0.0 or np.ptp(y[known]) == 0.0:
        return 0.0
    return float(np.corrcoef(x[known], y[known])[0, 1])


class Travel(NamedTuple):
    """A position compared with the integral of a speed."""

    correlation: float  # Correlation of their changes [1]
    ratio: float  # Change of the position for each unit of the speed and second


def compare_travel(speed: NumberSeries, position: NumberSeries) -> Travel:
    """Compare changes of a position with the integral of a speed, between its stamps."""
    steps = np.diff(speed.time)
    mean = 0.5 * (np.abs(speed.value[1:]) + np.abs(speed.value[:-1]))
    distance = np.concatenate(([0.0], np.cumsum(np.where(steps < _SPAN_S[0], mean * steps, 0.0))))
    inside = (position.time >= speed.time[0]) & (position.time <= speed.time[-1]) & np.isfinite(position.value)
    time, value = position.time[inside], position.value[inside]
    if time.size == 0:
        return Travel(0.0, math.nan)
    bins = np.floor((time - time[0]) / _SPAN_S[0])
    first = np.concatenate(([True], np.diff(bins) > 0.0))
    time, value = time[first], value[first]
    gone, elapsed = np.diff(np.interp(time, speed.time, distance)), np.diff(time)
    change = np.abs(np.diff(value))
    usable = (elapsed < _SPAN_S[1]) & (gone > 0.0)
    if np.count_nonzero(usable) < _HALF or not change[usable].any():
        return Travel(0.0, math.nan)
    # Positions are set anew now and then.
    usual = float(np.median(change[usable] / gone[usable]))
    usable &= np.abs(change - usual * gone) <= 0.3 * usual * gone + 1e-3 * float(change[usable].max())
    if np.count_nonzero(usable) < _HALF or np.ptp(gone[usable]) == 0.0 or np.ptp(change[usable]) == 0.0:
        return Travel(0.0, math.nan)
    share = float(np.mean(usable[gone > 0.0]))
    ratio = float(change[usable] @ gone[usable]) / float(gone[usable] @ gone[usable])
    return Travel(float(np.corrcoef(gone[usable], change[usable])[0, 1]) * share, ratio)


class Fit(NamedTuple):
    """A regression."""

    slopes: tuple[float, ...]  # Coefficients of the regressors
    share: float  # Explained share of the variance [1]


def regress(y: Array, columns: Sequence[Array], moving: NDArray[np.bool_]) -> Fit | None:
    """Return the regression of y on columns and a constant, where all are known and the train moves; None if nowhere.

    Args:
        y: Shape (n,).
        columns: Each of shape (n,).
        moving: Shape (n,).
    """
    known = np.isfinite(y) & moving
    for column in columns:
        known &= np.isfinite(column)
    if np.count_nonzero(known) < _FEWEST:
        return None
    design = np.column_stack([*(column[known] for column in columns), np.ones(np.count_nonzero(known))])
    scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
    slopes, *_ = np.linalg.lstsq(design / scale, y[known], rcond=1e-9)
    variance = float(np.var(y[known]))
    rest = float(np.mean((y[known] - design / scale @ slopes) ** 2))
    return Fit(tuple((slopes / scale)[:-1].tolist()), 1.0 - rest / variance if variance > 0.0 else 0.0)
