# SPDX-License-Identifier: Apache-2.0
"""The columns of a replay or a live run: inputs, estimates and their status on one time axis.

A :class:`Recorder` observes a replay, or receives what a live driver does. The :class:`Recording` it returns is what
reports draw and what is sent to the Rerun viewer; a :class:`Panel` describes one of their plots.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.records import KM_H, NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import BrakeRateEstimate, ResistanceEstimate, SpeedModelEstimate, Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.bag.bag_replay import AnyOutput
    from trainid_ros.bag.reader import LoggedRecord

Array: TypeAlias = NDArray[np.float64]
T = TypeVar('T')

CAPACITY: Final = 4096
"""Samples kept of each column for a report, by default."""
STANDSTILL: Final = 'standstill'
PULLING: Final = 'traction'
COASTING: Final = 'coast'
BRAKING: Final = 'brake'
_STANDSTILL_SPEED: Final = 0.3  # m/s
# Fraction of the greatest force up to which a train coasts: auxiliaries draw some power then.
_COASTING_FORCE: Final = 0.02
# A larger step of the stamps needs a sample on its other side.
_MAX_STEP_NS: Final = 600 * NS_PER_S


class Span(NamedTuple):
    """A period [s since the start] with one label."""

    start_s: float
    end_s: float
    label: str


class Series(NamedTuple):
    """Numbers over time: times since the start [ns], shape (n,), and values, shape (n, columns)."""

    time_ns: NDArray[np.int64]
    values: Array

    @property
    def time_s(self) -> Array:
        """Times since the start [s]."""
        return self.time_ns / NS_PER_S


@dataclass(frozen=True, slots=True)
class Track:
    """One estimate over time."""

    time_ns: NDArray[np.int64]  # Times since the start [ns], shape (n,)
    estimates: tuple[Any, ...]  # The estimate at each of these times
    usable: NDArray[np.bool_]  # True where the status was VALID or HOLDING, shape (n,)
    ratios: Series  # Test ratios [1] of the innovations; of samples merged into one the greatest
    statuses: tuple[Span, ...]  # Status over time

    @property
    def time_s(self) -> Array:
        """Times since the start [s]."""
        return self.time_ns / NS_PER_S

    def __getitem__(self, kept: slice) -> Track:
        """Return a part of the estimates."""
        return replace(self, time_ns=self.time_ns[kept], estimates=self.estimates[kept], usable=self.usable[kept])

    def column(self, name: str) -> Array:
        """Return a field of the estimate over time, shape (n,)."""
        return np.array([getattr(estimate, name) for estimate in self.estimates], dtype=np.float64)

    @property
    def theta(self) -> Array:
        """Davis parameters a, b, c [N/kN, v in m/s], shape (n, 3)."""
        return np.stack([self.column(name) for name in 'abc'], axis=-1)

    @property
    def covariance(self) -> Array:
        """Covariance of a, b, c of the resistance, shape (n, 3, 3)."""
        return np.array([estimate.covariance for estimate in self.estimates], dtype=np.float64).reshape(-1, 3, 3)

    @property
    def speed_range(self) -> tuple[float, float]:
        """Slowest and fastest speed that the resistance was learned from [m/s]; (0, 0) for none."""
        return (self.estimates[-1].speed_min, self.estimates[-1].speed_max) if self.estimates else (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Recording:
    """What was recorded of one drive; times are relative to ``start_ns``."""

    start_ns: int  # Stamp of the first speed or estimate [ns]
    duration_s: float  # Time to the last one [s]
    speed: Series  # Speed [m/s], and the newest gradient by then [per mille]
    force: Series  # Force [N]
    gradient: Series  # Gradient [per mille]
    brake_command: Series  # Brake command [m/s^2]
    modes: tuple[Span, ...]  # Driving modes
    resistance: Track  # Output of the resistance estimator
    speed_model: Track  # Output of AM-VFF-RLS
    brake_rate: Track  # Output of GSMA
    observable: tuple[Span, ...]  # Periods in which braking provides information on the brake rate

    def drive(self) -> tuple[NDArray[np.int64], Array, Array]:
        """Return time [ns], speed [m/s] and gradient [per mille] where the speed is known."""
        known = np.isfinite(self.speed.values[:, 0])
        speed, gradient = self.speed.values[known].T
        return self.speed.time_ns[known], speed, gradient


class Panel(NamedTuple):
    """One plot over time, for a report or the Rerun viewer."""

    title: str  # Heading
    label: str  # Quantity with its unit
    time_ns: NDArray[np.int64]  # Times since the start [ns]
    value: Array  # The quantity
    std: Array | None = None  # Its standard deviation, None to show none
    usable: NDArray[np.bool_] | None = None  # Where the value axis must show the whole band
    prior: float | None = None  # Value of the train file, None for none
    truth: Array | None = None  # True values, None if unknown


def input_panels(recording: Recording) -> dict[str, Panel]:
    """Return the panels of the inputs by name."""
    speed, force = recording.speed, recording.force
    shown = (
        ('speed', 'speed [km/h]', speed.time_ns, KM_H * speed.values),
        ('force', 'force [kN]', force.time_ns, force.values / 1000.0),
        ('gradient', 'gradient [‰]', *recording.gradient),
        ('brake_command', 'brake command [m/s²]', *recording.brake_command),
    )
    return {name: Panel(label, label, time_ns, values[:, 0]) for name, label, time_ns, values in shown}


class PlausibleStamps:
    """Stamps near the last plausible one, or near the newest sample: a wrong one must not stretch the time axis.

    The stream that makes the samples follows a step of the time base, such as a pause, once several topics show it.
    """

    def __init__(self) -> None:
        self._newest_ns = self._sample_ns = 0

    def follow(self, sample_ns: int) -> None:
        """Follow the stamp of a sample, which the stream has accepted."""
        self._sample_ns = sample_ns

    def accept(self, stamp_ns: int) -> bool:
        """Return whether an input with a stamp is to be shown."""
        near = any(abs(stamp_ns - known) <= _MAX_STEP_NS for known in (self._newest_ns, self._sample_ns) if known)
        if stamp_ns <= 0 or not (near or self._newest_ns == 0):
            return False
        self._newest_ns = stamp_ns
        return True


class _Thinned(Generic[T]):
    """A stream of unknown length: when full, pairs of items are merged, and the stride doubles."""

    def __init__(self, capacity: int, merge: Callable[[T, T], T]) -> None:
        self._capacity = capacity
        self._merge = merge
        self._items: list[T] = []
        self._stride = 1
        self._pending: list[T] = []  # the items of an incomplete stride, merged
        self._count = 0

    def add(self, item: T) -> None:
        self._pending = [self._merge(self._pending[0], item) if self._pending else item]
        self._count += 1
        if self._count < self._stride:
            return
        self._items += self._pending
        self._pending, self._count = [], 0
        if len(self._items) == self._capacity:
            self._items = [self._merge(*pair) for pair in zip(self._items[::2], self._items[1::2], strict=True)]
            self._stride *= 2

    def items(self) -> list[T]:
        return self._items + self._pending


def _later(_: T, second: T) -> T:
    return second


def _greater_ratio(first: AnyOutput, second: AnyOutput) -> AnyOutput:
    return first if _ratio(first) > _ratio(second) else second


def _ratio(output: Any) -> float:
    return float(output.estimate.test_ratio)


class Labels:
    """A label over time; equal ones in a row are stored once.

    Attributes:
        changes: Stamps [ns] of the changes, each with the new label, None for no label.
    """

    def __init__(self) -> None:
        self.changes: list[tuple[int, str | None]] = []

    def add(self, stamp_ns: int, label: str | None) -> bool:
        """Set the label from a stamp on; return whether it is a new one."""
        if label == (self.changes[-1][1] if self.changes else None):
            return False
        self.changes.append((stamp_ns, label))
        return True

    def spans(self, start_ns: int, end_ns: int) -> tuple[Span, ...]:
        """Return all spans of time since a start; the last one ends at ``end_ns``."""
        return tuple(
            Span((begin - start_ns) / NS_PER_S, (end - start_ns) / NS_PER_S, label)
            for (begin, label), (end, _) in pairwise([*self.changes, (end_ns, None)])
            if label is not None and end > begin
        )


class _Outputs:
    """The outputs of one estimator."""

    def __init__(self, capacity: int) -> None:
        self.kept: _Thinned[AnyOutput] = _Thinned(capacity, _later)
        self.tested: _Thinned[AnyOutput] = _Thinned(capacity, _greater_ratio)
        self.statuses = Labels()
        self._innovation: float | None = None

    def add(self, output: AnyOutput) -> None:
        self.kept.add(output)
        self.statuses.add(output.stamp_ns, output.status.name)
        estimate = output.estimate
        if isinstance(estimate, SpeedModelEstimate) or not estimate.innovation_variance > 0.0:
            return
        # Outputs may repeat the last innovation.
        if estimate.innovation != self._innovation:
            self.tested.add(output)
        self._innovation = estimate.innovation

    def track(self, start_ns: int, end_ns: int) -> Track:
        kept = self.kept.items()
        return Track(
            np.array([output.stamp_ns for output in kept], dtype=np.int64) - start_ns,
            tuple(output.estimate for output in kept),
            np.array([output.status in (Status.VALID, Status.HOLDING) for output in kept], dtype=np.bool_),
            _series([(output.stamp_ns, _ratio(output)) for output in self.tested.items()], 1, start_ns),
            self.statuses.spans(start_ns, end_ns),
        )


def _series(rows: Sequence[tuple[float, ...]], width: int, start_ns: int) -> Series:
    values = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, width)
    return Series(np.array([int(row[0]) for row in rows], dtype=np.int64) - start_ns, values)


class Recorder:
    """Collects a recording; with a capacity, memory is bounded for any duration."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        """Set the number of samples to keep of each column."""
        self._start_ns = self._newest_ns = 0
        self._speed_stamps, self._other_stamps = PlausibleStamps(), PlausibleStamps()
        kinds = (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord)
        self._inputs: dict[type, _Thinned[tuple[float, ...]]] = {kind: _Thinned(capacity, _later) for kind in kinds}
        self._force = self._command = self._gradient = self._greatest_force = 0.0
        self._modes, self._observable = Labels(), Labels()
        estimates = (ResistanceEstimate, SpeedModelEstimate, BrakeRateEstimate)
        self.outputs: dict[type, _Outputs] = {kind: _Outputs(capacity) for kind in estimates}

    def on_record(self, entry: LoggedRecord) -> None:
        """Add an input of a replay."""
        self.add_record(entry.record)

    def add_record(self, record: Record) -> None:
        """Add an input; one without a stamp is left out, and one with an implausible stamp is not shown."""
        stamp_ns = record.stamp_ns
        if stamp_ns <= 0:
            return
        # A time base of its own of another input must not hide the speed.
        stamps = self._speed_stamps if isinstance(record, SpeedRecord) else self._other_stamps
        match record:
            case SpeedRecord():
                row: tuple[float, ...] = (stamp_ns, record.speed, self._gradient)
            case ForceRecord():
                self._force = record.force
                self._greatest_force = max(self._greatest_force, abs(record.force))
                row = (stamp_ns, record.force)
            case BrakeRecord():
                self._command = record.target_acceleration
                row = (stamp_ns, self._command)
            case GradientRecord():
                self._gradient = record.gradient
                row = (stamp_ns, self._gradient)
            case _:
                return
        if not stamps.accept(stamp_ns):
            return
        self._inputs[type(record)].add(row)
        if isinstance(record, SpeedRecord) and np.isfinite(record.speed):
            self._extend(stamp_ns)
            self._modes.add(stamp_ns, self._mode(record.speed))

    def on_output(self, output: AnyOutput, log_ns: int = 0) -> None:  # noqa: ARG002 - the axis has the stamps
        """Add the output of an estimator; outputs without a sample are left out."""
        if output.stamp_ns <= 0:
            return
        self._speed_stamps.follow(output.stamp_ns)
        self._other_stamps.follow(output.stamp_ns)
        self._extend(output.stamp_ns)
        estimate = output.estimate
        self.outputs[type(estimate)].add(output)
        if isinstance(estimate, BrakeRateEstimate):
            self._observable.add(output.stamp_ns, 'observable' if estimate.observable else None)

    def finish(self) -> Recording:
        """Return what was collected."""
        start_ns, end_ns = self._start_ns, self._newest_ns
        speed, force, gradient, command = (
            _series(kept.items(), width, start_ns)
            for kept, width in zip(self._inputs.values(), (2, 1, 1, 1), strict=True)
        )
        resistance, speed_model, brake_rate = (outputs.track(start_ns, end_ns) for outputs in self.outputs.values())
        modes, observable = (labels.spans(start_ns, end_ns) for labels in (self._modes, self._observable))
        length_s = (end_ns - start_ns) / NS_PER_S
        return Recording(
            start_ns, length_s, speed, force, gradient, command, modes, resistance, speed_model, brake_rate, observable
        )

    def _extend(self, stamp_ns: int) -> None:
        """Extend the time axis."""
        self._start_ns = self._start_ns or stamp_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)

    def _mode(self, speed: float) -> str:
        if speed < _STANDSTILL_SPEED:
            return STANDSTILL
        if self._command < 0.0:
            return BRAKING
        return PULLING if self._force > _COASTING_FORCE * self._greatest_force else COASTING
