# SPDX-License-Identifier: Apache-2.0
"""Resistance estimators on measured trips of an electric car, compared with a regression on the same trips.

The data are those of Steinstraeter, Buberger, Trifonov, "Battery and Heating Data in Real Driving Cycles", IEEE
DataPort 2020, doi 10.21227/6jr9-5235; they are not part of the repository. A folder holds ``trips.csv`` and one npz
file per trip, whose columns are stored as differences in steps. Neither brake pedal nor mass is recorded, so samples
count only while the accelerator pedal is pressed, and the mass is nominal.

Usage: python -m benchmarks.measured_car [FOLDER [ALGORITHM]]
"""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from benchmarks.days import REPOSITORY
from benchmarks.tables import Table, as_text, columns
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import ResistanceEstimate, Status
from trainid_ros.setup.pipelines import RESISTANCE, EstimatorSettings, resistance_pipeline
from trainid_ros.stream.samples import SAMPLE_PERIOD
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import TrainFile, load_train_file

Array = NDArray[np.float64]

FOLDER: Final = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'bmw_i3'
DRIVER: Final = 80.0
MASS: Final = 1370.0 + DRIVER
# Ratio of gear and final drive, and rolling radius [m].
_GEAR, _RADIUS = 9.665, 0.3397
# Above this period the gradient is taken from the elevation, below it from the accelerometer [s].
_CROSSOVER_S: Final = 30.0
_PERIOD: Final = 0.1
# Standard deviations of the smoothing of speed and acceleration, and of the elevation in steps of 1 m [samples].
_SMOOTH, _SMOOTH_ELEVATION = 5.0, 10.0
_SLOWEST: Final = 1.0
# The pedal counts as pressed above this [%]; brake command used where the brake may act [m/s^2].
_PEDAL: Final = 1.0
_MAY_BRAKE: Final = -0.1
_SPEED: Final = 20.0
# An estimate that knows w to this share is fit for the comparison, which allows as much; the default is 5 % [1].
WANTED: Final = {'valid_share': 0.1}
_SEASONS: Final = (('summer', 'A', 312.0), ('winter', 'B', 421.0))
# The regression: samples per window, samples with the pedal pressed before it, least speed [m/s], least windows.
_WINDOW, _BEFORE, _WINDOW_SPEED, _FEWEST = 40, 10, 3.0, 11
# Tukey's biweight: limit in robust standard deviations, MAD factor, iterations.
_BIWEIGHT, _MAD, _ROUNDS = 4.685, 1.4826, 30


@dataclass(frozen=True, slots=True)
class Trip:
    """A trip in SI units at 10 Hz; the acceleration is that of the accelerometer, including g sin(gradient)."""

    name: str
    start_ns: int
    speed: Array
    elevation: Array
    acceleration: Array
    force: Array
    pedal: NDArray[np.bool_]

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the samples [ns]."""
        return self.start_ns + np.round(np.arange(self.speed.size) * _PERIOD * NS_PER_S).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Regression:
    """Force of resistance at 20 m/s [N] with its standard deviation, effective mass of each trip [kg], windows."""

    force: float
    std: float
    masses: dict[str, float]
    windows: int

    def __str__(self) -> str:
        return f'{self.force:.0f} ± {self.std:.0f}'


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of an algorithm on the trips of a season."""

    scale: tuple[float, float]  # Force scale with its standard deviation, NaN if not estimated
    to_valid: float  # Time in motion with the pedal pressed until the estimate is first VALID [min], infinite if never
    valid: float  # Share of the samples in motion with the pedal pressed at which it is
    trips: dict[str, tuple[float, float]]  # Resistance at 20 m/s after each trip, with its standard deviation [N]

    @property
    def mean(self) -> float:
        """Mean of the resistances at 20 m/s after the trips [N], weighted by their variances."""
        weights = [1.0 / (std * std) for _, std in self.trips.values()]
        weighted = (w * force for w, (force, _) in zip(weights, self.trips.values(), strict=True))
        return math.fsum(weighted) / math.fsum(weights)

    def rms_error(self, reference: float) -> float:
        """Return the rms of the errors after the trips from the right value [N], in their standard deviations [1]."""
        errors = [(force - reference) / std for force, std in self.trips.values()]
        return math.sqrt(math.fsum(error * error for error in errors) / len(errors))


def stated_car() -> TrainFile:
    """Return the train file: nominal mass with driver, resistance by coast-down, 10 % uncertainty of mass and force."""
    return load_train_file(REPOSITORY / 'config' / 'trains' / 'bmw_i3.yaml')


def trip_names(folder: Path, season: str) -> tuple[str, ...]:
    """Return the names of the trips of a season, 'A' summer or 'B' winter, by date."""
    with (folder / 'trips.csv').open(encoding='utf-8', newline='') as file:
        rows = [row for row in csv.DictReader(file) if row['trip'].startswith(f'Trip{season}')]
    return tuple(row['trip'] for row in sorted(rows, key=lambda row: _start_ns(row['start'])))


def load_trip(folder: Path, name: str) -> Trip:
    with (folder / 'trips.csv').open(encoding='utf-8', newline='') as file:
        start = next(row['start'] for row in csv.DictReader(file) if row['trip'] == name)
    with np.load(folder / f'{name}.npz') as data:
        steps = zip(data['names'].tolist(), data['steps'].tolist(), strict=True)
        columns = {column: np.cumsum(data[column]) * step for column, step in steps}
    return Trip(
        name=name,
        start_ns=_start_ns(start),
        speed=columns['speed_kmh'] / 3.6,
        elevation=columns['elevation_m'],
        acceleration=columns['acc_long'],
        force=wheel_force(columns['motor_torque_nm']),
        pedal=columns['throttle'] > _PEDAL,
    )


def _start_ns(text: str) -> int:
    # Dates are written 2019-12-07_17-49-35 and 2019_12_09_07-58-11.
    numbers = [int(part) for part in text.replace('_', '-').split('-')]
    year, month, day, hour, minute, second = numbers
    return round(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()) * NS_PER_S


def wheel_force(torque: Array) -> Array:
    """Return the force at the wheels [N] of a motor torque [N m], without losses."""
    return np.asarray(_GEAR * torque / _RADIUS)


def gradient(trip: Trip) -> Array:
    """Return the gradient [per mille]: accelerometer less dv/dt for short periods, elevation for long ones.

    Not causal: smoothing and crossover use future samples, as a map would provide the road ahead.
    """
    slope = _smooth(trip.acceleration, _SMOOTH) / G - acceleration(trip) / G
    climb = np.gradient(_smooth(trip.elevation, _SMOOTH_ELEVATION), _PERIOD)
    speed = np.maximum(_slow(trip.speed), _SLOWEST)
    return np.asarray(1000.0 * (slope + (_slow(climb) - _slow(slope * trip.speed)) / speed))


def acceleration(trip: Trip) -> Array:
    """Return dv/dt [m/s^2]."""
    return np.asarray(np.gradient(_smooth(trip.speed, _SMOOTH), _PERIOD))


def _smooth(values: Array, width: float) -> Array:
    return np.asarray(gaussian_filter1d(values, width))


def _slow(values: Array) -> Array:
    """Return the low-frequency part: a first-order low-pass, forward and backward."""
    gain = 1.0 - math.exp(-_PERIOD / _CROSSOVER_S)

    def forward(x: Array) -> Array:
        out, _ = lfilter([gain], [1.0, gain - 1.0], x, zi=[(1.0 - gain) * x[0]])
        return np.asarray(out)

    return forward(forward(values)[::-1])[::-1]


def records(trip: Trip) -> Iterator[Record]:
    """Yield the records of a trip.

    While the pedal is released a brake of unknown effort may act: that is what emergency braking says.
    """
    position = np.cumsum(trip.speed) * _PERIOD
    command = np.where(trip.pedal, 0.0, _MAY_BRAKE)
    columns = (trip.stamps_ns, trip.speed, position, trip.force, gradient(trip), command)
    for stamp, speed, at, force, slope, brake in zip(*(column.tolist() for column in columns), strict=True):
        yield SpeedRecord(stamp, max(speed, 0.0), at)
        yield ForceRecord(stamp, force)
        yield GradientRecord(stamp, slope, 0.0, False)
        yield BrakeRecord(stamp, brake, brake < 0.0)


def regress(trips: Sequence[Trip]) -> Regression:
    """Return resistance and masses by robust least squares on windows with the pedal pressed.

    ``F = m (dv/dt + g i) + A + B v + C v^2`` with one effective mass m per trip and A, B, C common to all.
    """
    parts = [(trip.name, part) for trip in trips if len(part := _windows(trip)) >= _FEWEST]
    X = np.vstack([_rows(part, i, len(parts)) for i, (_, part) in enumerate(parts)])
    y = np.concatenate([part[:, 3] for _, part in parts])
    weight = np.ones(y.size)
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        theta = np.linalg.lstsq(X * root[:, None], y * root, rcond=None)[0]
        error = np.abs(y - X @ theta)
        std = _MAD * float(np.median(error))
        weight = (1.0 - np.minimum(error / (_BIWEIGHT * std), 1.0) ** 2) ** 2
    at = np.zeros(theta.size)
    at[-3:] = 1.0, _SPEED, _SPEED**2
    P = std**2 * np.linalg.inv((X * weight[:, None]).T @ X)
    masses = {name: float(mass) for (name, _), mass in zip(parts, theta, strict=False)}
    return Regression(float(at @ theta), math.sqrt(at @ P @ at), masses, y.size)


def _windows(trip: Trip) -> Array:
    """Return specific gravity and inertia force [m/s^2], mean v, mean v^2 and mean force of each window."""
    slope, down = gradient(trip), trip.pedal & (trip.speed > _WINDOW_SPEED)
    rows = []
    for begin in range(2 * _BEFORE, trip.speed.size - _WINDOW, _WINDOW):
        if down[begin - _BEFORE : begin + _WINDOW].all():
            part = slice(begin, begin + _WINDOW)
            v = trip.speed[part]
            rate = (trip.speed[begin + _WINDOW] - v[0]) / (_WINDOW * _PERIOD)
            specific = rate + G * slope[part].mean() / 1000.0
            rows.append((specific, v.mean(), np.square(v).mean(), trip.force[part].mean()))
    return np.array(rows).reshape(-1, 4)


def _rows(part: Array, index: int, trips: int) -> Array:
    rows = np.zeros((len(part), trips + 3))
    rows[:, index] = part[:, 0]
    rows[:, -3:] = np.column_stack([np.ones(len(part)), part[:, 1], part[:, 2]])
    return rows


def identify(trips: Sequence[Trip], algorithm: str, **changes: float) -> Outcome:
    """Run a resistance algorithm with changed settings over trips by date, as one stream of records with real gaps."""
    settings = EstimatorSettings(resistance=RESISTANCE.choose(algorithm, **changes))
    pipeline = resistance_pipeline(stated_car(), settings)
    moving = valid = 0
    to_valid, after = math.inf, {}
    for trip in trips:
        pedal = dict(zip(trip.stamps_ns.tolist(), trip.pedal.tolist(), strict=True))
        for record in records(trip):
            for output in pipeline.push(record):
                if output.estimate.speed < _SLOWEST or not pedal.get(output.stamp_ns, False):
                    continue
                moving += 1
                fit = output.status is Status.VALID
                valid += fit
                if fit and math.isinf(to_valid):
                    to_valid = moving / (60.0 / SAMPLE_PERIOD)
        after[trip.name] = force_at(pipeline.estimator.estimate(_SPEED))
    estimate = pipeline.estimator.estimate(_SPEED)
    return Outcome((estimate.force_scale, estimate.force_scale_std), to_valid, valid / max(moving, 1), after)


def force_at(estimate: ResistanceEstimate) -> tuple[float, float]:
    """Return resistance and standard deviation at the estimate's speed, in the force unit of the motor [N].

    The specific resistance refers to the true weight, of which only the ratio to the force gain is known:
    ``(1 + kappa) F / (M g) = w`` with the nominal mass M.
    """
    scale = 1.0 if math.isnan(estimate.force_scale) else estimate.force_scale
    weight = MASS * G / (1000.0 * scale)
    return weight * estimate.resistance, weight * estimate.resistance_std


def measure(folder: Path | str = FOLDER, algorithm: str = '') -> tuple[Table, ...]:
    """Return tables of resistance by season and after each trip."""
    folder, algorithm = Path(folder), algorithm or RESISTANCE.default
    rows, trip_rows = [], []
    for season, letter, reference in _SEASONS:
        trips = [load_trip(folder, name) for name in trip_names(folder, letter)]
        regression, found, default = regress(trips), identify(trips, algorithm, **WANTED), identify(trips, algorithm)
        halves = regress(trips[: len(trips) // 2]), regress(trips[len(trips) // 2 :])
        after = {name: f'{force:.0f} ± {std:.0f}' for name, (force, std) in found.trips.items()}
        scale, scale_std = found.scale
        rows.append(
            (
                season,
                f'{reference:.0f}',
                str(regression),
                ', '.join(map(str, halves)),
                list(after.values())[-1],
                f'{found.mean:.0f}',
                f'{found.rms_error(reference):.2f}',
                '-' if math.isnan(scale) else f'{scale:.3f} ± {scale_std:.3f}',
                *_fitness(found),
                *_fitness(default),
            )
        )
        trip_rows += [(name, text, f'{regression.masses.get(name, math.nan):.0f}') for name, text in after.items()]
    header = columns(
        f'season | reference, N | regression, N | of the halves, N | {algorithm}, last, N | mean, N | '
        'rms error in std | force scale | to VALID at 10 %, min | VALID | at 5 %, min | VALID'
    )
    note = (
        'Resistance at 20 m/s. Minutes and shares count samples in motion with the accelerator pedal pressed; VALID '
        'where the standard deviation is below 10 % of the resistance, and below 5 %, the default. '
        'The mean is that of the estimates after each trip, weighted by their variances; the errors are those after '
        'each trip against the reference. '
        'The regression estimates effective masses, which include force gain and rotating masses.'
    )
    trip_header = ('after trip', f'{algorithm}, N', 'mass by regression, kg')
    return Table('Measured car', header, tuple(rows), note), Table('By trip', trip_header, tuple(trip_rows))


def _fitness(found: Outcome) -> tuple[str, str]:
    """Return time until VALID [min] and share of VALID."""
    return '-' if math.isinf(found.to_valid) else f'{found.to_valid:.1f}', f'{found.valid:.0%}'


if __name__ == '__main__':
    print('\n\n'.join(as_text(table) for table in measure(*sys.argv[1:3])))
