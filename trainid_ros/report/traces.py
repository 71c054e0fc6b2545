# SPDX-License-Identifier: Apache-2.0
"""Time series of measurements and estimates, thinned to the resolution of a plot.

Replay and live drivers push the same records and outputs into a :class:`TraceRecorder`; the
:class:`Traces` it returns are the only input of the plots.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from trainid_ros.bag.plausible_stamps import PlausibleStamps
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, SpeedModelEstimate, Status

AnyOutput: TypeAlias = Output[ResistanceEstimate] | Output[SpeedModelEstimate] | Output[BrakeRateEstimate]
Array: TypeAlias = NDArray[np.float64]
Row: TypeAlias = tuple[float, ...]

CAPACITY: Final = 4096
STANDSTILL: Final = 'standstill'
PULLING: Final = 'traction'
COASTING: Final = 'coast'
BRAKING: Final = 'brake'
_STANDING_SPEED: Final = 0.3
# Share of the greatest force up to which a train coasts: auxiliaries draw some power then.
_TRACTION_SHARE: Final = 0.02


@dataclass(frozen=True, slots=True)
class Span:
    """A period [s since the start] with one label."""

    start_s: float
    end_s: float
    label: str


@dataclass(frozen=True, slots=True)
class DriveTrace:
    """Motion of the train: time [s], speed [m/s], gradient [per mille], and the driving modes."""

    time_s: Array
    speed: Array
    gradient: Array
    modes: tuple[Span, ...]


@dataclass(frozen=True, slots=True)
class ResistanceTrace:
    """The resistance over time."""

    time_s: Array  # Time since the start [s], shape (n,)
    theta: Array  # a, b, c [N/kN, v in m/s], shape (n, 3)
    covariance: Array  # Their covariance, shape (n, 3, 3)
    speed: Array  # Speed at that time [m/s], shape (n,)
    usable: NDArray[np.bool_]  # True where the status was VALID or HOLDING, shape (n,)
    ratio_time_s: Array  # Times of the test ratios [s], shape (k,)
    ratio: Array  # Greatest test ratio around each of these times [1], shape (k,)
    speed_range: tuple[float, float]  # Slowest and fastest speed learned from at the end [m/s]; (0, 0) = none
    statuses: tuple[Span, ...]  # Status over time


@dataclass(frozen=True, slots=True)
class SpeedModelTrace:
    """AM-VFF-RLS over time [s]: Davis parameters (n, 3) [N/kN], mass factor [1] and prediction error [m/s]."""

    time_s: Array
    davis: Array
    mass_factor: Array
    error: Array
    statuses: tuple[Span, ...]


@dataclass(frozen=True, slots=True)
class BrakeTrace:
    """GSMA over time [s]; rate, standard deviation and test ratio are dimensionless, rate 1 = nominal."""

    time_s: Array
    rate: Array
    std: Array
    usable: NDArray[np.bool_]
    ratio_time_s: Array
    ratio: Array
    observable: tuple[Span, ...]
    statuses: tuple[Span, ...]


@dataclass(frozen=True, slots=True)
class Traces:
    """All time series of one drive; times are relative to ``start_ns``."""

    start_ns: int
    duration_s: float
    drive: DriveTrace
    resistance: ResistanceTrace
    speed_model: SpeedModelTrace
    brake_rate: BrakeTrace


def _later(_: Row, second: Row) -> Row:
    return second


def _greater(first: Row, second: Row) -> Row:
    return first if first[1] > second[1] else second


class _Thinned:
    """Rows of a stream of unknown length: when full, pairs of rows are merged, and the stride doubles."""

    def __init__(self, width: int, merge: Callable[[Row, Row], Row] = _later) -> None:
        self._width = width
        self._merge = merge
        self._rows: list[Row] = []
        self._stride = 1
        self._count = 0
        self._pending: Row = ()

    def add(self, row: Row) -> None:
        self._pending = self._merge(self._pending, row) if self._count else row
        self._count += 1
        if self._count < self._stride:
            return
        self._rows.append(self._pending)
        self._count = 0
        if len(self._rows) == CAPACITY:
            pairs = zip(self._rows[::2], self._rows[1::2], strict=True)
            self._rows = [self._merge(first, second) for first, second in pairs]
            self._stride *= 2

    def array(self) -> Array:
        """Return the rows including an incomplete last one, shape (n, width)."""
        rows = [*self._rows, self._pending] if self._count else self._rows
        return np.array(rows, dtype=np.float64).reshape(len(rows), self._width)


class _Spans:
    """A label over time, stored as spans."""

    def __init__(self) -> None:
        self._spans: list[Span] = []
        self._label: str | None = None
        self._start = 0.0

    def add(self, time_s: float, label: str | None) -> None:
        """Set the label from a time on, None for no label."""
        if label == self._label:
            return
        if self._label is not None and time_s > self._start:
            self._spans.append(Span(self._start, time_s, self._label))
        self._label, self._start = label, time_s

    def finish(self, end_s: float) -> tuple[Span, ...]:
        """Return all spans; the last one ends at ``end_s``."""
        last = () if self._label is None or end_s <= self._start else (Span(self._start, end_s, self._label),)
        return (*self._spans, *last)


class TraceRecorder:
    """Collects traces during a drive; memory is bounded for any duration."""

    def __init__(self) -> None:
        self._start_ns = 0
        self._newest_s = 0.0
        self._speed_stamps = PlausibleStamps()
        self._force = self._command = self._gradient = self._greatest_force = 0.0
        self._drive, self._modes = _Thinned(3), _Spans()
        self._resistance, self._resistance_ratio, self._resistance_status = (
            _Thinned(15),
            _Thinned(2, _greater),
            _Spans(),
        )
        self._speed_model, self._speed_model_status = _Thinned(6), _Spans()
        self._brake, self._brake_ratio, self._brake_status = _Thinned(4), _Thinned(2, _greater), _Spans()
        self._observable = _Spans()
        self._speed_range = (0.0, 0.0)
        self._innovations: dict[type, float] = {}

    def on_record(self, record: Record) -> None:
        """Add an input; records without a stamp, and speeds far from the others in time, are left out."""
        if record.stamp_ns <= 0:
            return
        match record:
            case SpeedRecord():
                self._add_speed(record)
            case ForceRecord():
                self._force = record.force
                self._greatest_force = max(self._greatest_force, abs(record.force))
            case BrakeRecord():
                self._command = record.target_acceleration
            case GradientRecord():
                self._gradient = record.gradient
            case _:
                pass

    def on_output(self, output: AnyOutput) -> None:
        """Add the output of an estimator; outputs without a sample are left out."""
        if output.stamp_ns <= 0:
            return
        self._speed_stamps.follow(output.stamp_ns)
        time_s = self._time(output.stamp_ns)
        match output.estimate:
            case ResistanceEstimate() as estimate:
                self._add_resistance(time_s, estimate, output.status)
            case SpeedModelEstimate() as estimate:
                self._add_speed_model(time_s, estimate, output.status)
            case BrakeRateEstimate() as estimate:
                self._add_brake(time_s, estimate, output.status)

    def finish(self) -> Traces:
        """Return the traces collected."""
        return Traces(
            start_ns=self._start_ns,
            duration_s=self._newest_s,
            drive=self._finish_drive(),
            resistance=self._finish_resistance(),
            speed_model=self._finish_speed_model(),
            brake_rate=self._finish_brake(),
        )

    def _time(self, stamp_ns: int) -> float:
        if self._start_ns == 0:
            self._start_ns = stamp_ns
        time_s = (stamp_ns - self._start_ns) / NS_PER_S
        self._newest_s = max(self._newest_s, time_s)
        return time_s

    def _add_speed(self, record: SpeedRecord) -> None:
        # Only plausible stamps may extend the time axis; the estimators check all others.
        if not np.isfinite(record.speed) or not self._speed_stamps.accept(record.stamp_ns):
            return
        time_s = self._time(record.stamp_ns)
        self._drive.add((time_s, record.speed, self._gradient))
        self._modes.add(time_s, self._mode(record.speed))

    def _mode(self, speed: float) -> str:
        if speed < _STANDING_SPEED:
            return STANDSTILL
        if self._command < 0.0:
            return BRAKING
        return PULLING if self._force > _TRACTION_SHARE * self._greatest_force else COASTING

    def _add_resistance(self, time_s: float, estimate: ResistanceEstimate, status: Status) -> None:
        theta = (estimate.a, estimate.b, estimate.c)
        usable = float(status in (Status.VALID, Status.HOLDING))
        self._resistance.add((time_s, *theta, *estimate.covariance, estimate.speed, usable))
        self._resistance_status.add(time_s, status.name)
        self._speed_range = (estimate.speed_min, estimate.speed_max)
        if estimate.innovation_variance > 0.0 and self._is_new(estimate):
            self._resistance_ratio.add((time_s, estimate.test_ratio))

    def _add_speed_model(self, time_s: float, estimate: SpeedModelEstimate, status: Status) -> None:
        davis = (estimate.a, estimate.b, estimate.c)
        self._speed_model.add((time_s, *davis, estimate.mass_factor, estimate.prediction_error))
        self._speed_model_status.add(time_s, status.name)

    def _add_brake(self, time_s: float, estimate: BrakeRateEstimate, status: Status) -> None:
        usable = float(status in (Status.VALID, Status.HOLDING))
        self._brake.add((time_s, estimate.brake_rate, estimate.brake_rate_std, usable))
        self._brake_status.add(time_s, status.name)
        self._observable.add(time_s, 'observable' if estimate.observable else None)
        if estimate.innovation_variance > 0.0 and self._is_new(estimate):
            self._brake_ratio.add((time_s, estimate.test_ratio))

    def _is_new(self, estimate: ResistanceEstimate | BrakeRateEstimate) -> bool:
        """Return False if an output only repeats the last innovation."""
        before = self._innovations.get(type(estimate))
        self._innovations[type(estimate)] = estimate.innovation
        return before != estimate.innovation

    def _finish_drive(self) -> DriveTrace:
        rows = self._drive.array()
        return DriveTrace(rows[:, 0], rows[:, 1], rows[:, 2], self._modes.finish(self._newest_s))

    def _finish_resistance(self) -> ResistanceTrace:
        rows, ratios = self._resistance.array(), self._resistance_ratio.array()
        return ResistanceTrace(
            time_s=rows[:, 0],
            theta=rows[:, 1:4],
            covariance=rows[:, 4:13].reshape(len(rows), 3, 3),
            speed=rows[:, 13],
            usable=rows[:, 14] > 0.0,
            ratio_time_s=ratios[:, 0],
            ratio=ratios[:, 1],
            speed_range=self._speed_range,
            statuses=self._resistance_status.finish(self._newest_s),
        )

    def _finish_speed_model(self) -> SpeedModelTrace:
        rows = self._speed_model.array()
        statuses = self._speed_model_status.finish(self._newest_s)
        return SpeedModelTrace(rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5], statuses)

    def _finish_brake(self) -> BrakeTrace:
        rows, ratios = self._brake.array(), self._brake_ratio.array()
        return BrakeTrace(
            time_s=rows[:, 0],
            rate=rows[:, 1],
            std=rows[:, 2],
            usable=rows[:, 3] > 0.0,
            ratio_time_s=ratios[:, 0],
            ratio=ratios[:, 1],
            observable=self._observable.finish(self._newest_s),
            statuses=self._brake_status.finish(self._newest_s),
        )
