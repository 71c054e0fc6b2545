# SPDX-License-Identifier: Apache-2.0
"""Data of the workflow: the runs of a bag, and the gap between measured and simulated speed on their grid points.

A run begins when the train moves and ends when it stands. A gap in the data, an emergency brake application or the
maximum length ends it too; every run has its own initial speed. Measured less simulated speed is averaged over about
one second around each grid point.

Speeds are compared, not accelerations: with the mean forces of each stage the simulated speed is
``v_j = v_0 + sum dt (u - w(v) - ...) / inertia`` (after Xia et al. 2023, (2) and (7)), so every resistance r adds
the *response* ``-sum dt r / inertia``, which is linear in r. w(v) uses the measured speed; the sum averages its noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.sample_stream import DriveHistory
from trainid_ros.stream.samples import Motion, Sample
from trainid_ros.train.effects import BRAKE_APPLIED
from trainid_ros.train.forces import (
    davis,
    load_drag,
    specific_force,
    specific_inertia,
)
from trainid_ros.train.train_file import TrainFile

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

MAX_RUN_S: Final = 240.0
"""Maximum length of a run [s]: a longer drive is split, so that errors by gusts do not accumulate over all of it."""
PULLING: Final = 1.0
"""Traction above this is taken as traction [N/kN]; less is noise."""
BRAKING: Final = -1.0
"""Brake force below this is taken as braking [N/kN]."""
MAD_TO_STD: Final = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""
_UNWEIGHED: Final = 0.3  # Load that is not weighed, as a share of the mass [1]
_EXACT: Final = 0.05  # Error of the reported brake, as a share of its force, up to which the report is exact [1]
_MIN_SPEED: Final = 0.3  # Speed below which the brake may hold the train, so the force balance is not valid [m/s]


@dataclass(frozen=True, slots=True)
class Run:
    """One run; row j describes the stage from sample j - 1 to sample j, row 0 a single instant."""

    bag: int  # Number of the bag
    direction: int  # +1 for rising positions, -1 for falling ones
    time: Array  # Time since the first sample of all bags [s], shape (n,)
    dt: Array  # Length of the stage [s], 0 in row 0
    speed: Array  # Measured speed at the end of the stage [m/s]
    position: Array  # Position of the front at the end of the stage [m]; the distance travelled if not measured
    gradient: Array  # Mean over the stage [per mille, + uphill in the direction of travel]
    radius: Array  # Curve radius [m], 0 = straight
    tunnel: Array  # 1 in a tunnel
    traction: Array  # Mean reported force without that of the brake, per weight [N/kN]
    brake: Array  # Mean brake force by the brake model of the train file, per weight [N/kN, <= 0]
    heat: Array  # Energy stored in the brake per mass of the train [J/kg]
    since_release: Array  # Time since the brake was released [s], infinite if it never was
    distance_run: Array  # Distance since the first sample of the bag [m]
    positioned: bool  # True if the position was measured, except for interpolated gaps
    weighed: bool  # True if the mass was measured
    stops: tuple[float, float]  # Measured positions at the standstills before and after [m], NaN if there is none
    travelled: float  # Integral of measured speed between those standstills [m]
    number: int = 0  # Number of departures since the start of the record; 0 if not known
    load_drag: Array | float = 0.0  # What the weighed load adds to the resistance of the train file [N/kN]


def numbered(runs: Iterable[Run]) -> list[Run]:
    """Return runs whose numbers count on from bag to bag; those without a number follow the one before."""
    out, before, last, bag = list[Run](), 0, 0, -1
    for run in runs:
        if run.bag != bag:
            before, bag = last, run.bag
        number = before + run.number if run.number else last + 1
        last = max(last, number)
        out.append(replace(run, number=number))
    return out


class RunCollector:
    """Collects the samples of one bag into ``runs``, by the mass and the brake model of a train file.

    ``bag`` is its number, ``origin_ns`` the stamp at which times are zero; 0 = that of the first sample.
    """

    def __init__(self, train_file: TrainFile, bag: int = 0, origin_ns: int = 0) -> None:
        self.origin_ns, self.runs = origin_ns, list[Run]()
        self._train_file, self._bag = train_file, bag
        self._rows: list[tuple[float, ...]] = []
        self._history = DriveHistory(train_file)
        self._weighed, self._departed_m = 0, 0.0
        self._start_position = math.nan

    def add(self, sample: Sample) -> None:
        """Add one sample."""
        self.origin_ns = self.origin_ns or sample.stamp_ns
        motion = self._history.follow(sample)
        if math.isnan(sample.dt):
            self.end_run()
        if sample.speed <= 1e-3:  # m/s, the train stands
            if self._rows:
                self.end_run(sample.position)
            self._start_position, self._departed_m = sample.position, motion.distance_run
            return
        known = (sample.force_mean, sample.gradient_mean, sample.brake_command)
        if sample.emergency or not all(map(math.isfinite, known)):
            self.end_run()
            return
        self._add_row(sample, motion)

    def start_over(self) -> None:
        """End the current run and forget the history of the drive, as after a jump of the stamps."""
        self.end_run()
        self._history.reset()
        self._departed_m = 0.0

    def _add_row(self, sample: Sample, motion: Motion) -> None:
        rate = self._train_file.brake.rate_at(sample.speed)
        brake = rate * motion.brake_mean
        # A brake that is still releasing at departure may hold the train or drag; which of them is unknown.
        if not self._rows and (sample.speed < _MIN_SPEED or brake < BRAKE_APPLIED):
            return
        train = self._train_file.train
        mass = sample.mass if math.isfinite(sample.mass) else train.mass
        self._weighed += sample.weighed
        braking = specific_inertia(1.0, train.rotary_mass) * brake if brake < BRAKE_APPLIED else 0.0
        traction = specific_force(sample.force_mean, mass)
        # While the brake acts, its force follows from its command, and the reported force is the sum of traction and a
        # brake of rate 1. There is traction where the sum is positive, and where a driver pulls before the brake is
        # released. Other differences may be errors of the reported brake, as by a load that is not weighed.
        pull = nominal = 0.0
        if braking:
            nominal = braking / rate
            pull, least = traction - nominal, max(PULLING, -_UNWEIGHED * nominal)
            traction = pull if traction > PULLING or (self._history.is_releasing and pull > least) else 0.0
        row = (
            (sample.stamp_ns - self.origin_ns) / NS_PER_S, sample.dt, sample.speed, sample.position,
            sample.gradient_mean, sample.curve_radius, float(sample.tunnel), traction,
            braking, motion.heat, motion.since_release, motion.distance_run, pull, nominal,
            load_drag(self._train_file.c_of_load, train.mass, mass, sample.speed),
        )  # fmt: skip
        self._rows.append(row)
        if row[0] - self._rows[0][0] > MAX_RUN_S:
            self.end_run()

    def end_run(self, stop_position: float = math.nan) -> None:
        """End the current run, at a measured position [m] if the train stands; discard it if it is too short."""
        rows, self._rows = self._rows, []
        # Near its stops a train may stand, and its mass may then be that of other passengers.
        weighed, self._weighed = 2 * self._weighed > len(rows), 0
        while rows and rows[-1][2] < _MIN_SPEED:
            rows.pop()
        start, self._start_position = self._start_position, math.nan
        if not rows or rows[-1][0] - rows[0][0] < 15.0:  # s
            return
        columns = np.array(rows).T.copy()
        time, dt, speed, position, gradient, radius, tunnel, traction, brake, heat, release, distance = columns[:12]
        dt[0] = 0.0
        traction = _beside_brake(traction, *columns[12:14])
        position, positioned = _bridged(position, distance)
        driven = self._history.motion
        run = Run(
            self._bag, 1 if position[-1] >= position[0] else -1, time, dt, speed, position, gradient, radius, tunnel,
            traction, brake, heat, release, distance, positioned, weighed, (start, stop_position),
            driven.distance_run - self._departed_m, driven.run, columns[14],
        )  # fmt: skip
        self.runs.append(run)


def _beside_brake(traction: Array, pull: Array, nominal: Array) -> Array:
    """Return the traction of a run [N/kN], shape (n,), with all that acts beside the brake if its report is exact.

    ``pull`` is the reported force less that of the nominal brake, which is zero where it does not act.
    """
    braking = nominal < BRAKING
    if not braking.any() or abs(float(np.median(pull[braking] / nominal[braking]))) > _EXACT:
        return traction
    return np.where(pull > np.maximum(PULLING, -_EXACT * nominal), pull, traction)


def _bridged(position: Array, distance: Array) -> tuple[Array, bool]:
    """Return positions (n,) with gaps bridged by the distance [m], and True; of less than half, the distance alone."""
    known = np.isfinite(position)
    if np.mean(known) < 0.5:
        return distance.copy(), False
    way = 1.0 if position[known][-1] >= position[known][0] else -1.0
    offset = position[known] - way * distance[known]
    return np.where(known, position, way * distance + np.interp(distance, distance[known], offset)), True


_OUTLIER: Final = 5.0  # Deviation from the level beyond which a speed is an outlier [std of the window]


@dataclass(frozen=True, slots=True)
class Dataset:
    """Samples of all runs, one run after another, and the grid points they are averaged to."""

    runs: tuple[Run, ...]
    inertia: float  # Specific force per acceleration [N/kN per m/s^2]
    run_of: Indices  # Run of each sample, shape (n,)
    starts: Indices  # First sample of each run, shape (R,)
    dt: Array  # Length of the stage that ends at each sample [s], shape (n,)
    time: Array  # Time [s], shape (n,)
    speed: Array  # Mean speed of the stage, interpolated over outliers [m/s], shape (n,)
    gap: Array  # Measured less predicted speed [m/s], shape (n,)
    outlier: Flags  # True where the measured speed is excluded, shape (n,)
    deviation: Array  # Deviation of an outlier from its neighbours [m/s], 0 elsewhere, shape (n,)
    point_starts: Indices  # First sample of each grid point, shape (m,)
    point_run: Indices  # Run of each grid point, shape (m,)
    point_time: Array  # Mean time of each grid point [s], shape (m,)
    point_count: Array  # Number of samples in each grid point without outliers, shape (m,)
    following: Array  # Share of these samples that lie at the end of each stage or after it [1], shape (n,)

    @property
    def direction(self) -> NDArray[np.int_]:
        """Direction of travel of each sample, +1 for rising positions, -1 for falling ones, shape (n,)."""
        return np.array([run.direction for run in self.runs])[self.run_of]

    @property
    def point_change(self) -> Array:
        """Change of the force since the previous grid point, as acceleration [m/s^2], shape (m,)."""
        force = (self.joined('traction') + self.joined('brake'))[self.point_starts]
        change = np.abs(np.diff(force, prepend=force[0])) / self.inertia
        return np.where(np.diff(self.point_run, prepend=-1) == 0, change, 0.0)

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
        # In batches of 16: a hundred columns over hours of samples take gigabytes.
        batches = [resistance[:, k : k + 16] for k in range(0, resistance.shape[1], 16)]
        return np.concatenate([self._response(batch) for batch in batches], axis=1)

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
        return _joined(self.runs, name)


def _joined(runs: Sequence[Run], name: str) -> Array:
    return np.concatenate([getattr(run, name) for run in runs])


def assemble(runs: Sequence[Run], train_file: TrainFile, extra: Array | None = None) -> Dataset:
    """Return the dataset of one or more runs, compared with the model of a train file.

    ``extra`` is the resistance of its effects, mean over each stage [N/kN], shape (n,).
    """
    inertia = specific_inertia(1.0, train_file.train.rotary_mass)
    sizes = np.array([run.time.size for run in runs])
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.intp)
    run_of = np.repeat(np.arange(len(runs)), sizes)
    dt, time, measured = (_joined(runs, name) for name in ('dt', 'time', 'speed'))
    known = _joined(runs, 'traction') + _joined(runs, 'brake') - _joined(runs, 'gradient')
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
    number = np.floor(time - time[starts][run_of] + 1e-9)  # a grid point averages over one second
    fresh = (np.diff(number, prepend=-1.0) != 0.0) | (np.diff(run_of, prepend=-1) != 0)
    point_starts = np.flatnonzero(fresh)
    return Dataset(
        tuple(runs), inertia, run_of, starts, dt, time, _stage_means(speed, starts), gap, outlier, gap - bridged,
        point_starts, run_of[point_starts], *_points(time, outlier, point_starts),
    )  # fmt: skip


def find_outliers(gap: Array, starts: Indices) -> Flags:
    """Return the samples (n,) whose speed leaves the level of the surrounding seconds and returns to it.

    A permanent step, as a late brake causes, is not an outlier: the level steps as well. ``gap`` is the measured less
    the predicted speed [m/s], shape (n,), ``starts`` the first sample of each run, shape (R,).
    """
    edges = np.append(starts, gap.size)
    return np.concatenate([_outliers_of(gap[a:b]) for a, b in pairwise(edges)])


def _outliers_of(gap: Array) -> Flags:
    """Return the outliers of one run, shape (n,); fewer than three samples define no level."""
    if gap.size < 3:
        return np.zeros(gap.size, dtype=bool)
    half = min(15, (gap.size - 1) // 2)  # samples on either side of one that define its level
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
    floor = max(0.03, float(np.median(scale)))  # m/s
    # A permanent step lifts one half of the window only; an outlier lies outside the levels of both halves.
    step = np.abs(slope[window]) * (half + 1)
    off_by, usual = gap - expected, np.maximum(scale[window], floor)
    clear = np.abs(off_by) > np.maximum(_OUTLIER * usual, 0.7 * step)
    least = max(0.5, 2.0 * _OUTLIER * floor)  # jump [m/s]
    clear |= _cut_bursts(gap, least) | _cut_bursts(gap[::-1], least)[::-1]
    # With the flanks of a burst: adjacent samples that deviate by more than 2 std to the same side.
    side = np.where(np.abs(off_by) > 2.0 * usual, np.sign(off_by), 0.0)
    burst = np.searchsorted(np.flatnonzero(np.diff(side)) + 1, at, side='right')
    return np.asarray(clear | ((side != 0.0) & np.isin(burst, burst[clear])))


def _cut_bursts(gap: Array, least: float) -> Flags:
    """Return the samples before a jump that no train can make: a burst that began before the run.

    It lies within 20 samples, and the medians of 5 samples before and after it confirm it.
    """
    outlier = np.zeros(gap.size, dtype=bool)
    for j in np.flatnonzero(np.abs(np.diff(gap[:20])) > least).tolist():
        before, after = gap[max(j - 4, 0) : j + 1], gap[j + 1 : j + 6]
        if abs(float(np.median(after)) - float(np.median(before))) > least:
            outlier[: j + 1] = True
    return outlier


def _stage_means(speed: Array, starts: Indices) -> Array:
    """Return the mean of the speeds at both ends of each stage [m/s], shape (n,)."""
    means = speed.copy()
    means[1:] = 0.5 * (speed[1:] + speed[:-1])
    means[starts] = speed[starts]
    return means


def _bridge(gap: Array, outlier: Flags, run_of: Indices) -> Array:
    """Interpolate over outliers within each run."""
    bridged = gap.copy()
    for run in np.unique(run_of[outlier]):
        at = np.flatnonzero(run_of == run)
        bad = outlier[at]
        if not bad.all():
            bridged[at[bad]] = np.interp(at[bad], at[~bad], gap[at[~bad]])
    return bridged


def _points(time: Array, outlier: Flags, point_starts: Indices) -> tuple[Array, Array, Array]:
    """Return ``point_time``, the mean of all samples if all are outliers, ``point_count`` and ``following``."""
    weight, sizes = (~outlier).astype(float), np.diff(point_starts, append=time.size)
    count = np.add.reduceat(weight, point_starts)
    some = np.maximum(count, 1.0)
    mean = np.add.reduceat(weight * time, point_starts) / some
    mean_of_all = np.add.reduceat(time, point_starts) / sizes
    so_far = np.cumsum(weight)
    last = np.repeat(so_far[point_starts + sizes - 1], sizes)
    following = (last - so_far + weight) / np.repeat(some, sizes)
    return np.where(count > 0.0, mean, mean_of_all), count, following
