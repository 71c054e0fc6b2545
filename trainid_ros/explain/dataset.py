# SPDX-License-Identifier: Apache-2.0
"""Grid points of all runs: measured less predicted speed, averaged over about one second.

Speeds are compared, not accelerations: with the mean forces of each stage the simulated speed is
``v_j = v_0 + sum dt (u - w(v) - ...) / inertia`` (after Xia et al. 2023, (2) and (7)), so every resistance r adds
the *response* ``-sum dt r / inertia``, which is linear in r. w(v) uses the measured speed; the sum averages its noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from trainid_ros.train.davis import davis, specific_inertia

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.run_data import Run
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

POINT_S: Final = 1.0
"""Time over which a grid point averages [s]."""
MAD_TO_STD: Final = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""
# Columns integrated at once.
_COLUMN_BATCH: Final = 16
# Outliers: samples on either side that define the level, thresholds in std of an outlier and of the flank of a burst.
_HALF_WINDOW: Final = 15
_OUTLIER: Final = 5.0
_FLANK: Final = 2.0
# A run may begin or end within a burst, detected by a jump between two samples: minimum jump [m/s], maximum distance
# from the edge [samples], number of samples before and after it whose medians must confirm it.
_JUMP: Final = 0.5
_EDGE: Final = 20
_NEAR: Final = 5
# Lower limit of the std of the speed [m/s].
_MIN_SCALE: Final = 0.03


@dataclass(frozen=True, slots=True)
class Dataset:
    """Samples of all runs, one run after another, and the grid points they are averaged to.

    Attributes:
        runs: The runs.
        inertia: Specific force per acceleration [N/kN per m/s^2].
        run_of: Run of each sample, shape (n,).
        starts: First sample of each run, shape (R,).
        dt: Length of the stage that ends at each sample [s], shape (n,).
        time: Time [s], shape (n,).
        speed: Mean speed of the stage, interpolated over outliers [m/s], shape (n,).
        gap: Measured less predicted speed [m/s], shape (n,).
        outlier: True where the measured speed is excluded, shape (n,).
        deviation: Deviation of an outlier from its neighbours [m/s], 0 elsewhere, shape (n,).
        point_starts: First sample of each grid point, shape (m,).
        point_run: Run of each grid point, shape (m,).
        point_time: Mean time of each grid point [s], shape (m,).
        point_count: Number of samples in each grid point without outliers, shape (m,).
        following: Share of these samples that lie at the end of each stage or after it [1], shape (n,).

    """

    runs: tuple[Run, ...]
    inertia: float
    run_of: NDArray[np.intp]
    starts: NDArray[np.intp]
    dt: Array
    time: Array
    speed: Array
    gap: Array
    outlier: NDArray[np.bool_]
    deviation: Array
    point_starts: NDArray[np.intp]
    point_run: NDArray[np.intp]
    point_time: Array
    point_count: Array
    following: Array

    @property
    def direction(self) -> NDArray[np.int_]:
        """Direction of travel of each sample, +1 for rising positions, -1 for falling ones, shape (n,)."""
        return np.array([run.direction for run in self.runs])[self.run_of]

    @property
    def positioned(self) -> bool:
        """True if the position on the line is known for all runs."""
        return all(run.positioned for run in self.runs)

    def average(self, values: Array) -> Array:
        """Return the mean of each grid point without outliers, shapes (n,) to (m,)."""
        total = np.add.reduceat(np.where(self.outlier, 0.0, values), self.point_starts)
        return np.asarray(total / np.maximum(self.point_count, 1.0))

    def column(self, resistance: Array) -> Array:
        """Return the mean speed change [m/s] of each point due to a resistance on each stage [N/kN], 0 if not measured.

        Shapes (n,) to (m,) or (n, k) to (m, k).
        """
        if resistance.ndim == 1:
            return self._response(resistance[:, None])[:, 0]
        # In batches: a hundred columns over hours of samples take gigabytes.
        parts = [resistance[:, k : k + _COLUMN_BATCH] for k in range(0, resistance.shape[1], _COLUMN_BATCH)]
        return np.concatenate([self._response(part) for part in parts], axis=1)

    def _response(self, resistance: Array) -> Array:
        """Return the column of each of k resistances, shape (n, k) to (m, k)."""
        kick = resistance * (-self.dt / self.inertia)[:, None]
        change = np.add.reduceat(kick, self.point_starts)
        # A kick acts on the samples of its grid point that follow, and on all later grid points of the run.
        within = np.add.reduceat(kick * self.following[:, None], self.point_starts)
        path = np.cumsum(change, axis=0) - change
        first = np.flatnonzero(np.diff(self.point_run, prepend=-1))
        return np.where(self.point_count[:, None] > 0.0, path - path[first][self.point_run] + within, 0.0)

    def joined(self, name: str) -> Array:
        """Return one field of all runs, concatenated, shape (n,)."""
        return np.concatenate([getattr(run, name) for run in self.runs])


def assemble(runs: Sequence[Run], train_file: TrainFile, extra: Array | None = None) -> Dataset:
    """Return the dataset of one or more runs.

    Args:
        runs: The runs.
        train_file: Train file with the model to compare with.
        extra: Resistance of known effects, in addition to Davis and gradient, mean over each stage [N/kN], shape (n,).

    """
    inertia = specific_inertia(1.0, train_file.train.rotary_mass)
    sizes = np.array([run.time.size for run in runs])
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.intp)
    run_of = np.repeat(np.arange(len(runs)), sizes)
    dt, time = np.concatenate([run.dt for run in runs]), np.concatenate([run.time for run in runs])
    known = np.concatenate([run.traction + run.brake - run.gradient for run in runs])
    measured = np.concatenate([run.speed for run in runs])
    speed = measured
    # The second pass predicts with the outliers of the first one interpolated.
    for _ in range(2):
        middle = _stage_means(speed, starts)
        w = davis(train_file.resistance, middle) + (0.0 if extra is None else extra)
        # Xia et al. 2023, (2) and (7), with the mean forces of each stage.
        path = np.cumsum(dt * (known - w) / inertia)
        gap = measured - (path - path[starts][run_of])
        outlier = find_outliers(gap, starts)
        bridged = _bridge(gap, outlier, run_of)
        speed = np.maximum(measured + (bridged - gap), 0.0)
    point_starts = _divide(time, starts, run_of)
    point_time, count = _point_times(time, outlier, point_starts)
    return Dataset(
        tuple(runs), inertia, run_of, starts, dt, time, _stage_means(speed, starts), gap, outlier, gap - bridged,
        point_starts, run_of[point_starts], point_time, count, _following(outlier, point_starts),
    )  # fmt: skip


def find_outliers(gap: Array, starts: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return the samples whose speed leaves the level of the surrounding seconds and returns to it, shape (n,).

    A permanent step, as a late brake causes, is not an outlier: the level steps as well.

    Args:
        gap: Measured less predicted speed [m/s], shape (n,).
        starts: First sample of each run, shape (R,).

    """
    edges = np.append(starts, gap.size)
    return np.concatenate([_outliers_of(gap[a:b]) for a, b in pairwise(edges)])


def _outliers_of(gap: Array) -> NDArray[np.bool_]:
    """Return the outliers of one run, shape (n,); fewer than three samples define no level."""
    if gap.size < 3:
        return np.zeros(gap.size, dtype=bool)
    half = min(_HALF_WINDOW, (gap.size - 1) // 2)
    windows = sliding_window_view(gap, 2 * half + 1)
    level = np.median(windows, axis=1)
    slope = (np.median(windows[:, half + 1 :], axis=1) - np.median(windows[:, :half], axis=1)) / (half + 1)
    off = windows - level[:, None] - slope[:, None] * np.arange(-half, half + 1)
    scale = MAD_TO_STD * np.median(np.abs(off), axis=1)
    scale = np.minimum(scale, 2.0 * float(np.median(scale)))
    # At both ends of a run the nearest complete window defines the level.
    at = np.arange(gap.size)
    window = np.clip(at - half, 0, len(windows) - 1)
    expected = level[window] + slope[window] * (at - half - window)
    floor = max(_MIN_SCALE, float(np.median(scale)))
    # A permanent step lifts one half of the window only; an outlier lies outside the levels of both halves.
    step = np.abs(slope[window]) * (half + 1)
    off_by, usual = gap - expected, np.maximum(scale[window], floor)
    clear = np.abs(off_by) > np.maximum(_OUTLIER * usual, 0.7 * step)
    least = max(_JUMP, 2.0 * _OUTLIER * floor)
    clear |= _cut_bursts(gap, least) | _cut_bursts(gap[::-1], least)[::-1]
    return clear | _with_flanks(clear, np.where(np.abs(off_by) > _FLANK * usual, np.sign(off_by), 0.0))


def _cut_bursts(gap: Array, least: float) -> NDArray[np.bool_]:
    """Return the samples before a jump that no train can make: a burst that began before the run."""
    early = gap[: _EDGE + _NEAR]
    outlier = np.zeros(gap.size, dtype=bool)
    for j in np.flatnonzero(np.abs(np.diff(early[:_EDGE])) > least).tolist():
        before, after = early[max(j + 1 - _NEAR, 0) : j + 1], early[j + 1 : j + 1 + _NEAR]
        if abs(float(np.median(after)) - float(np.median(before))) > least:
            outlier[: j + 1] = True
    return outlier


def _with_flanks(clear: NDArray[np.bool_], side: Array) -> NDArray[np.bool_]:
    """Return outliers with their flanks: adjacent samples that deviate to the same side (1, -1, else 0)."""
    edges = np.flatnonzero(np.diff(side)) + 1
    burst = np.searchsorted(edges, np.arange(side.size), side='right')
    return np.asarray((side != 0.0) & np.isin(burst, burst[clear]))


def _stage_means(speed: Array, starts: NDArray[np.intp]) -> Array:
    """Return the mean of the speeds at both ends of each stage [m/s], shape (n,)."""
    means = speed.copy()
    means[1:] = 0.5 * (speed[1:] + speed[:-1])
    means[starts] = speed[starts]
    return means


def _bridge(gap: Array, outlier: NDArray[np.bool_], run_of: NDArray[np.intp]) -> Array:
    """Interpolate over outliers within each run."""
    if not outlier.any():
        return gap
    bridged = gap.copy()
    for run in np.unique(run_of[outlier]):
        at = np.flatnonzero(run_of == run)
        bad = outlier[at]
        if not bad.all():
            bridged[at[bad]] = np.interp(at[bad], at[~bad], gap[at[~bad]])
    return bridged


def _divide(time: Array, starts: NDArray[np.intp], run_of: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the first sample of each grid point, shape (m,)."""
    since = time - time[starts][run_of]
    number = np.floor(since / POINT_S + 1e-9)
    fresh = np.ones(time.size, dtype=bool)
    fresh[1:] = (np.diff(number) != 0.0) | (np.diff(run_of) != 0)
    return np.flatnonzero(fresh)


def _point_times(time: Array, outlier: NDArray[np.bool_], point_starts: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the mean time [s] and the number of the samples of each grid point that are no outliers, shapes (m,).

    If all are outliers, the time is the mean of all.
    """
    weight = (~outlier).astype(float)
    count = np.add.reduceat(weight, point_starts)
    counting = np.add.reduceat(weight * time, point_starts) / np.maximum(count, 1.0)
    every = np.add.reduceat(time, point_starts) / np.diff(np.append(point_starts, time.size))
    return np.where(count > 0.0, counting, every), count


def _following(outlier: NDArray[np.bool_], point_starts: NDArray[np.intp]) -> Array:
    """Return the share of the samples of each point, without outliers, that are not before each sample, shape (n,)."""
    sizes = np.diff(point_starts, append=outlier.size)
    so_far = np.cumsum(~outlier)
    last = np.repeat(so_far[point_starts + sizes - 1], sizes)
    count = np.repeat(np.add.reduceat(~outlier, point_starts, dtype=int), sizes)
    return np.asarray((last - so_far + ~outlier) / np.maximum(count, 1))
