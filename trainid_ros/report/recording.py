# SPDX-License-Identifier: Apache-2.0
"""The columns of a replay or a live run: inputs, estimates and their status on one time axis.

A :class:`Recorder` observes a replay, or receives what a live driver does. The :class:`Recording` it returns is what
reports draw; a :class:`Panel` describes one of their plots. :func:`write_recording` writes it for the Rerun viewer
(.rrd), with events.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeAlias, TypeVar
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.files import write_whole
from trainid_ros.interface.records import KM_H, NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import (
    AdhesionEstimate,
    BrakeRateEstimate,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
)
from trainid_ros.monitor.trains import VIEWED, ShownEstimate

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from trainid_ros.bag.bag_replay import AnyOutput, Pipelines
    from trainid_ros.bag.reader import LoggedRecord

Array: TypeAlias = NDArray[np.float64]
T = TypeVar('T')

CAPACITY: Final = 4096
"""Samples kept of each column for a report, by default."""
STANDSTILL: Final = 'standstill'
PULLING: Final = 'traction'
COASTING: Final = 'coast'
BRAKING: Final = 'brake'
CONTRADICTED: Final = 'contradiction'
GAP: Final = 'gap'
REJECTED: Final = 'rejected'
# Why samples are left out of a healthy drive.
_USUAL: Final = frozenset(
    (Reason.NONE, Reason.STANDSTILL, Reason.BRAKING, Reason.NOT_BRAKING, Reason.THINNED, Reason.BRAKE_UNCERTAIN)
)
_SHOWN_FIELDS: Final[dict[type[Record], str]] = {
    SpeedRecord: 'speed', ForceRecord: 'force', GradientRecord: 'gradient', BrakeRecord: 'target_acceleration'
}  # fmt: skip


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
    faults: tuple[Span, ...]  # Contradictions of the inputs, gaps, and samples rejected for what is wrong with them

    @property
    def time_s(self) -> Array:
        """Times since the start [s]."""
        return self.time_ns / NS_PER_S

    def __getitem__(self, kept: slice) -> Track:
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
    adhesion: Track  # Output of the adhesion

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
        # A step of more than 600 s needs a sample on its other side.
        near = any(abs(stamp_ns - known) <= 600 * NS_PER_S for known in (self._newest_ns, self._sample_ns) if known)
        if stamp_ns <= 0 or not (near or self._newest_ns == 0):
            return False
        self._newest_ns = stamp_ns
        return True


class _Thinned(Generic[T]):
    """A stream of unknown length: when full, pairs of items are merged, and the stride doubles."""

    def __init__(self, capacity: int, merge: Callable[[T, T], T] = lambda _, later: later) -> None:
        self._capacity, self._merge = capacity, merge
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


class Labels:
    """A label over time; equal ones in a row are stored once."""

    def __init__(self) -> None:
        self.changes: list[tuple[int, str | None]] = []  # stamps [ns], each with the new label, None for none

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
        self._kept: _Thinned[AnyOutput] = _Thinned(capacity)
        self._tested: _Thinned[tuple[float, ...]] = _Thinned(
            capacity, lambda first, later: max(later, first, key=itemgetter(1))
        )  # Stamps and ratios
        self.statuses, self._faults = Labels(), Labels()
        self._newest_ns = 0
        self._innovation: float | None = None

    def add(self, output: AnyOutput) -> None:
        self._kept.add(output)
        self.statuses.add(output.stamp_ns, output.status.name)
        self._add_fault(output)
        estimate = output.estimate
        if isinstance(estimate, SpeedModelEstimate | AdhesionEstimate) or not estimate.innovation_variance > 0.0:
            return
        # Outputs may repeat the last innovation.
        if estimate.innovation != self._innovation:
            self._tested.add((output.stamp_ns, float(estimate.test_ratio)))
        self._innovation = estimate.innovation

    def _add_fault(self, output: AnyOutput) -> None:
        stamp_ns, rejection = output.stamp_ns, output.last_rejection
        reason = rejection.reason if rejection is not None and rejection.stamp_ns == stamp_ns else Reason.NONE
        if reason is Reason.GAP:
            self._faults.add(self._newest_ns or stamp_ns, GAP)
            self._faults.add(stamp_ns, None)
        elif reason is Reason.CONTRADICTION:
            self._faults.add(stamp_ns, CONTRADICTED)
        else:
            self._faults.add(stamp_ns, None if reason in _USUAL else REJECTED)
        self._newest_ns = stamp_ns

    def track(self, start_ns: int, end_ns: int) -> Track:
        kept = self._kept.items()
        return Track(
            np.array([output.stamp_ns for output in kept], dtype=np.int64) - start_ns,
            tuple(output.estimate for output in kept),
            np.array([output.status.is_usable for output in kept], dtype=np.bool_),
            _series(self._tested.items(), 1, start_ns),
            self.statuses.spans(start_ns, end_ns),
            self._faults.spans(start_ns, end_ns),
        )


def _series(rows: Sequence[tuple[float, ...]], width: int, start_ns: int) -> Series:
    values = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, width)
    return Series(np.array([int(row[0]) for row in rows], dtype=np.int64) - start_ns, values)


class Recorder:
    """Collects a recording, of each column a number of samples: memory is bounded for any duration."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._start_ns = self._newest_ns = 0
        self._speed_stamps, self._other_stamps = PlausibleStamps(), PlausibleStamps()
        self._inputs: dict[type, _Thinned[tuple[float, ...]]] = {kind: _Thinned(capacity) for kind in _SHOWN_FIELDS}
        self._newest = dict.fromkeys(_SHOWN_FIELDS, 0.0)  # the newest value of each input
        self._greatest_force = 0.0
        self._modes, self._observable = Labels(), Labels()
        estimates = (ResistanceEstimate, SpeedModelEstimate, BrakeRateEstimate, AdhesionEstimate)
        self.outputs: dict[type, _Outputs] = {kind: _Outputs(capacity) for kind in estimates}

    def on_record(self, entry: LoggedRecord) -> None:
        """Add an input of a replay."""
        self.add_record(entry.record)

    def add_record(self, record: Record) -> None:
        """Add an input; one without a stamp is left out, and one with an implausible stamp is not shown."""
        stamp_ns, kind = record.stamp_ns, type(record)
        if stamp_ns <= 0 or kind not in _SHOWN_FIELDS:
            return
        value = self._newest[kind] = getattr(record, _SHOWN_FIELDS[kind])
        if isinstance(record, ForceRecord):
            self._greatest_force = max(self._greatest_force, abs(value))
        # A time base of its own of another input must not hide the speed.
        stamps = self._speed_stamps if isinstance(record, SpeedRecord) else self._other_stamps
        if not stamps.accept(stamp_ns):
            return
        gradient = (self._newest[GradientRecord],) if isinstance(record, SpeedRecord) else ()
        self._inputs[kind].add((stamp_ns, value, *gradient))
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
        resistance, speed_model, brake_rate, adhesion = (
            outputs.track(start_ns, end_ns) for outputs in self.outputs.values()
        )
        modes, observable = (labels.spans(start_ns, end_ns) for labels in (self._modes, self._observable))
        return Recording(
            start_ns, (end_ns - start_ns) / NS_PER_S, speed, force, gradient, command, modes,
            resistance, speed_model, brake_rate, observable, adhesion,
        )  # fmt: skip

    def _extend(self, stamp_ns: int) -> None:
        self._start_ns = self._start_ns or stamp_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)

    def _mode(self, speed: float) -> str:
        if speed < 0.3:  # m/s
            return STANDSTILL
        if self._newest[BrakeRecord] < 0.0:
            return BRAKING
        # Auxiliaries draw some power while a train coasts.
        return PULLING if self._newest[ForceRecord] > 0.02 * self._greatest_force else COASTING


RRD_START: Final = 'RRF2'
"""How a recording starts."""
USED: Final = 'used'
SHARES: Final = (6.0, 1.9, 1.7)
"""Heights of inputs beside estimates, of status beside samples, and of the events."""
_COLOURS: Final = {
    'VALID': 0x2CA02CFF,
    'HOLDING': 0x17BECFFF,
    'CONVERGING': 0xFFBF00FF,
    'UNINITIALIZED': 0xC7C7C7FF,
    'STALE': 0xD62728FF,
    'FAULT': 0x8C0000FF,
    USED: 0x2CA02CFF,
}
_NAMES: Final = {item.topic.estimate: item.name for item in VIEWED}


def switch_off_telemetry() -> None:
    """Switch the telemetry of Rerun off, in this process and its children; call it before rerun is imported.

    Beside a command that changes a file in the home of the user, its library and viewer know only these variables.
    """
    os.environ['CI'] = 'true'
    os.environ['TELEMETRY_ENABLED'] = 'false'
    os.environ.pop('FORCE_RERUN_ANALYTICS', None)


class Event(NamedTuple):
    """Something that happened: when [ns], whether it is bad, and what."""

    stamp_ns: int
    is_bad: bool
    text: str


class ViewRecorder(Recorder):
    """Collects a replay without a bound, with what the viewer shows besides numbers."""

    def __init__(self, pipelines: Pipelines) -> None:
        super().__init__(capacity=sys.maxsize)
        self._stream = pipelines.resistance.stream
        self.rejected = {name: Labels() for name in _NAMES.values()}  # why the newest sample was not used
        self.events: list[Event] = []  # changes of status, and contradictions between the inputs
        self._finding = ''

    def on_output(self, output: AnyOutput, log_ns: int = 0) -> None:
        """Add the output of an estimator, and what changed with it."""
        stamp_ns, status = output.stamp_ns, output.status
        if stamp_ns <= 0:
            return
        name, statuses = _NAMES[type(output.estimate)], self.outputs[type(output.estimate)].statuses.changes
        count = len(statuses)
        super().on_output(output, log_ns)
        if len(statuses) > count:
            text = f'{statuses[-2][1]} to {status.name}' if count else status.name
            self.events.append(Event(stamp_ns, status in (Status.STALE, Status.FAULT), f'{name}: {text}'))
        rejection = output.last_rejection
        is_newest = rejection is not None and rejection.stamp_ns == stamp_ns
        self.rejected[name].add(stamp_ns, rejection.reason.name if rejection is not None and is_newest else USED)
        if (finding := self._stream.finding) != self._finding:
            text = f'inputs contradict each other: {finding}' if finding else f'inputs agree again: {self._finding}'
            self.events.append(Event(stamp_ns, bool(finding), text))
            self._finding = finding


def estimate_panel(shown: ShownEstimate, track: Track) -> Panel:
    """Return the panel of an estimate; a resistance is shown at the middle of the speeds learned from at the end."""
    if not track.estimates:
        return Panel(shown.name, shown.name, track.time_ns, np.empty(0), np.empty(0))
    newest = track.estimates[-1]
    value, std = np.array([shown.value(estimate, newest) for estimate in track.estimates]).T
    unit = f' [{shown.unit}]' if shown.unit else ''
    label = f'{shown.name}: {shown.quantity(newest)}{unit}'
    return Panel(f'{label}, ± 2 std', label, track.time_ns, value, std)


def time_range(recording: Recording) -> tuple[int, int]:
    """Return the earliest and the latest time of the inputs [ns]; where stamps jump back, not those at the ends."""
    seen = np.concatenate([panel.time_ns for panel in input_panels(recording).values()])
    return (int(seen.min()), int(seen.max())) if seen.size else (0, 0)


def write_recording(recorder: ViewRecorder, title: str, path: Path) -> None:
    """Write a recording, given what was collected and its title; InputError if the file cannot be written."""
    switch_off_telemetry()
    import rerun as rr  # noqa: PLC0415 - optional, and its telemetry must be off first

    recording = recorder.finish()
    panels = {f'inputs/{name}': panel for name, panel in input_panels(recording).items()}
    tracks = (recording.resistance, recording.speed_model, recording.brake_rate, recording.adhesion)
    for shown, track in zip(VIEWED, tracks, strict=True):
        panels[f'estimates/{_path(shown.name)}'] = estimate_panel(shown, track)
    # Rerun merges recordings of the same id, as those of two bags of one name would have.
    stream = rr.RecordingStream('trainid', recording_id=f'{title} {uuid4()}')
    # Through memory: where Rerun cannot write a file it prints lines of its own and leaves half of it.
    memory = stream.memory_recording()
    stream.send_recording_name(title)
    begin_ns, end_ns = time_range(recording)
    stream.send_blueprint(_layout(panels, end_ns - begin_ns))
    _Writer(rr, stream, recording.start_ns, begin_ns).write(recorder, panels)
    stream.flush()
    content = memory.drain_as_bytes()
    stream.disconnect()

    def write(part: Path) -> None:
        part.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)

    write_whole(path, write)


@dataclass(frozen=True, slots=True)
class _Writer:
    """Sends panels and labels to a stream of Rerun, on an axis of time since the first input."""

    _rr: Any  # Its library
    _stream: Any
    _start_ns: int
    _begin_ns: int

    def write(self, recorder: ViewRecorder, panels: dict[str, Panel]) -> None:
        for path, panel in panels.items():
            self._panel(path, panel)
        for kind, name in _NAMES.items():
            self._states(f'status/{_path(name)}', recorder.outputs[kind].statuses)
            self._states(f'samples/{_path(name)}', recorder.rejected[name])
        levels = ['ERROR' if event.is_bad else 'INFO' for event in recorder.events]
        columns = self._rr.TextLog.columns(text=[event.text for event in recorder.events], level=levels)
        times = np.array([event.stamp_ns for event in recorder.events], dtype=np.int64) - self._start_ns
        self._send('events', times, columns)

    def _panel(self, path: str, panel: Panel) -> None:
        if panel.std is None:
            self._line(path, panel, panel.value, panel.label)
            return
        for edge, factor in (('upper', 2.0), ('lower', -2.0)):
            limit = panel.value + factor * panel.std
            self._line(f'{path}/{edge}', panel, limit, f'{panel.label} {factor:+.0f} std', is_edge=True)
        self._line(f'{path}/value', panel, panel.value, panel.label)

    def _line(self, path: str, panel: Panel, values: Array, name: str, *, is_edge: bool = False) -> None:
        colour, width = ((125, 150, 175), 1.0) if is_edge else ((31, 119, 180), 2.0)
        self._stream.log(path, self._rr.SeriesLines(names=name, colors=[colour], widths=width), static=True)
        self._send(path, panel.time_ns, self._rr.Scalars.columns(scalars=values))

    def _states(self, path: str, labels: Labels) -> None:
        texts = [str(text) for _, text in labels.changes]
        colours = {text: _COLOURS.get(text, 0x7F7F7FFF) for text in sorted(set(texts))}
        configuration = self._rr.StateConfiguration(
            values=[*colours], labels=[*colours], colors=np.array([*colours.values()], dtype=np.uint32)
        )
        self._stream.log(path, configuration, static=True)
        times = np.array([stamp_ns for stamp_ns, _ in labels.changes], dtype=np.int64) - self._start_ns
        self._send(path, times, self._rr.StateChange.columns(state=texts))

    def _send(self, path: str, time_ns: NDArray[np.int64], columns: Any) -> None:
        if len(time_ns):
            since = (time_ns - self._begin_ns).astype('timedelta64[ns]')
            self._stream.send_columns(path, [self._rr.TimeColumn('time', duration=since)], columns)


def _layout(panels: dict[str, Panel], length_ns: int) -> Any:
    """Return the blueprint: inputs beside estimates, with axes that show everything, then states and events."""
    import rerun as rr  # noqa: PLC0415 - as above
    import rerun.blueprint as rrb  # noqa: PLC0415 - as above

    # Linked axes would begin with a minute around the cursor.
    begin, end = (rr.TimeRangeBoundary.absolute(seconds=time_ns * 1e-9) for time_ns in (0, length_ns))
    axis = rrb.TimeAxis(view_range=rrb.TimeRange(begin, end), link='Independent')
    legend = rrb.PlotLegend(visible=False)
    columns: dict[str, list[Any]] = {'inputs': [], 'estimates': []}
    for path, panel in panels.items():
        view = rrb.TimeSeriesView(origin=path, name=panel.title, axis_x=axis, plot_legend=legend)
        columns[path.partition('/')[0]].append(view)
    lanes = {'status': 'status', 'samples': 'why the newest sample was not used'}
    states = [rrb.StateTimelineView(origin=origin, name=name, time_view=axis) for origin, name in lanes.items()]
    rows = (
        rrb.Horizontal(*(rrb.Vertical(*views) for views in columns.values())),
        rrb.Horizontal(*states),
        rrb.TextLogView(origin='events', name='events'),
    )
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=SHARES),
        rrb.TimePanel(timeline='time', state='collapsed', play_state='paused'),
        collapse_panels=True,
    )


def _path(name: str) -> str:
    return name.replace(' ', '_')
