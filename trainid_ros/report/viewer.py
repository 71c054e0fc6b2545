# SPDX-License-Identifier: Apache-2.0
"""A replay as a recording for the Rerun viewer (.rrd): inputs, estimates, status and events on one time axis."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from uuid import uuid4

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import write_whole
from trainid_ros.interface.results import Status
from trainid_ros.monitor.trains import SHOWN, ShownEstimate
from trainid_ros.report.recording import Labels, Panel, Recorder, Recording, Track, input_panels

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from trainid_ros.bag.bag_replay import AnyOutput, Pipelines

RRD_START: Final = 'RRF2'
"""How a recording starts."""
USED: Final = 'used'
_AXIS: Final = 'time'
_BAND_STD: Final = 2.0
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
_NAMES: Final = {item.topic.estimate: item.name for item in SHOWN}


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
    """Collects a replay without a bound, with what the viewer shows besides numbers.

    Attributes:
        rejected: Why the newest sample was not used, by name of the estimate.
        events: Changes of status, and contradictions between the inputs.
    """

    def __init__(self, pipelines: Pipelines) -> None:
        """Set the estimators that run."""
        super().__init__(capacity=sys.maxsize)
        self._stream = pipelines.resistance.stream
        self.rejected = {name: Labels() for name in _NAMES.values()}
        self.events: list[Event] = []
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
    return Panel(f'{label}, ± {_BAND_STD:g} std', label, track.time_ns, value, std)


def time_range(recording: Recording) -> tuple[int, int]:
    """Return the earliest and the latest time of the inputs [ns]; where stamps jump back, not those at the ends."""
    seen = [panel.time_ns for panel in input_panels(recording).values() if len(panel.time_ns)]
    return min((int(time.min()) for time in seen), default=0), max((int(time.max()) for time in seen), default=0)


def write_recording(recorder: ViewRecorder, title: str, path: Path) -> None:
    """Write a recording, given what was collected and its title; InputError if the file cannot be written."""
    switch_off_telemetry()
    import rerun as rr  # noqa: PLC0415 - optional, and its telemetry must be off first

    recording = recorder.finish()
    panels = {f'inputs/{name}': panel for name, panel in input_panels(recording).items()}
    tracks = (recording.resistance, recording.speed_model, recording.brake_rate)
    for shown, track in zip(SHOWN, tracks, strict=True):
        panels[f'estimates/{_path(shown.name)}'] = estimate_panel(shown, track)
    # Rerun merges recordings of the same id, as those of two bags of one name would have.
    stream = rr.RecordingStream('trainid', recording_id=f'{title} {uuid4()}')
    # Through memory: where Rerun cannot write a file it prints lines of its own and leaves half of it.
    memory = stream.memory_recording()
    stream.send_recording_name(title)
    begin_ns, end_ns = time_range(recording)
    stream.send_blueprint(_layout(panels, end_ns - begin_ns))
    _Writer(stream, recording.start_ns, begin_ns).write(recorder, panels)
    stream.flush()
    content = memory.drain_as_bytes()
    stream.disconnect()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror})') from None
    write_whole(path, lambda part: part.write_bytes(content))


class _Writer:
    """Sends panels and labels to a stream of Rerun, on an axis of time since the first input."""

    def __init__(self, stream: Any, start_ns: int, begin_ns: int) -> None:
        import rerun as rr  # noqa: PLC0415 - as above

        self._rr = rr
        self._stream = stream
        self._start_ns = start_ns
        self._begin_ns = begin_ns

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
        for edge, sign in (('upper', 1.0), ('lower', -1.0)):
            limit = panel.value + sign * _BAND_STD * panel.std
            self._line(f'{path}/{edge}', panel, limit, f'{panel.label} {sign * _BAND_STD:+.0f} std', is_edge=True)
        self._line(f'{path}/value', panel, panel.value, panel.label)

    def _line(self, path: str, panel: Panel, values: NDArray[np.float64], name: str, *, is_edge: bool = False) -> None:
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
            self._stream.send_columns(path, [self._rr.TimeColumn(_AXIS, duration=since)], columns)


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
        rrb.TimePanel(timeline=_AXIS, state='collapsed', play_state='paused'),
        collapse_panels=True,
    )


def _path(name: str) -> str:
    return name.replace(' ', '_')
