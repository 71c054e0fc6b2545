# SPDX-License-Identifier: Apache-2.0
"""Writes tracks as a recording of Rerun (.rrd), with the layout of its views."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final
from uuid import uuid4

import numpy as np

from trainid_ros.fleet.plan import write_whole
from trainid_ros.interface.errors import InputError
from trainid_ros.view.telemetry import switch_off

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from trainid_ros.view.tracks import Series, Tracks

RRD_START: Final = 'RRF2'
"""How a recording starts."""
_AXIS: Final = 'time'
_BAND_STD: Final = 2.0
_BLUE: Final = (31, 119, 180)
_PALE: Final = (125, 150, 175)
_PLOTS: Final = {
    'speed': 'speed [km/h]',
    'force': 'force [kN]',
    'gradient': 'gradient [‰]',
    'brake_command': 'brake command [m/s²]',
}
SHARES: Final = (6.0, 1.9, 1.7)
"""Heights of inputs beside estimates, of status beside samples, and of the events."""
_COLOURS: Final = {
    'VALID': 0x2CA02CFF,
    'HOLDING': 0x17BECFFF,
    'CONVERGING': 0xFFBF00FF,
    'UNINITIALIZED': 0xC7C7C7FF,
    'STALE': 0xD62728FF,
    'FAULT': 0x8C0000FF,
    'used': 0x2CA02CFF,
}


def write_recording(tracks: Tracks, title: str, path: Path) -> None:
    """Write a recording.

    Args:
        tracks: What was collected.
        title: Name of the recording.
        path: File to write; its folder is created.

    Raises:
        InputError: The file cannot be written.
    """
    switch_off()
    import rerun as rr  # noqa: PLC0415 - optional, and its telemetry must be off first

    # Rerun merges recordings of the same id, as those of two bags of one name would have.
    stream = rr.RecordingStream('trainid', recording_id=f'{title} {uuid4()}')
    # Through memory: where Rerun cannot write a file it prints lines of its own and leaves half of it.
    memory = stream.memory_recording()
    stream.send_recording_name(title)
    stream.send_blueprint(_layout(tracks))
    _Writer(stream, time_range(tracks)[0]).write(tracks)
    stream.flush()
    content = memory.drain_as_bytes()
    stream.disconnect()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror})') from None
    write_whole(path, lambda part: part.write_bytes(content))


class _Writer:
    """Sends tracks to a stream of Rerun, on an axis of time since the first stamp."""

    def __init__(self, stream: Any, begin_ns: int) -> None:
        import rerun as rr  # noqa: PLC0415 - as above

        self._rr = rr
        self._stream = stream
        self._begin_ns = begin_ns

    def write(self, tracks: Tracks) -> None:
        for name, title in _PLOTS.items():
            series = tracks.inputs[name]
            self._line(f'inputs/{name}', series.stamps, np.array(series.values), title, _BLUE)
        for name in tracks.estimates:
            self._band(f'estimates/{_path(name)}', tracks.title(name), tracks.series(name))
            self._states(f'status/{_path(name)}', tracks.status[name].changes)
            self._states(f'samples/{_path(name)}', tracks.rejected[name].changes)
        levels = ['ERROR' if event.is_bad else 'INFO' for event in tracks.events]
        columns = self._rr.TextLog.columns(text=[event.text for event in tracks.events], level=levels)
        self._send('events', [event.stamp_ns for event in tracks.events], columns)

    def _band(self, path: str, title: str, series: Series) -> None:
        value, std = np.array(series.values).reshape(-1, 2).T
        for edge, sign in (('upper', 1.0), ('lower', -1.0)):
            limit = value + sign * _BAND_STD * std
            self._line(f'{path}/{edge}', series.stamps, limit, f'{title} {sign * _BAND_STD:+.0f} std', _PALE)
        self._line(f'{path}/value', series.stamps, value, title, _BLUE)

    def _line(
        self, path: str, stamps: Sequence[int], values: NDArray[np.float64], title: str, colour: tuple[int, int, int]
    ) -> None:
        self._stream.log(
            path,
            self._rr.SeriesLines(names=title, colors=[colour], widths=1.0 if colour == _PALE else 2.0),
            static=True,
        )
        self._send(path, stamps, self._rr.Scalars.columns(scalars=values))

    def _states(self, path: str, changes: Sequence[tuple[int, str]]) -> None:
        colours = {text: _COLOURS.get(text, 0x7F7F7FFF) for text in sorted({text for _, text in changes})}
        configuration = self._rr.StateConfiguration(
            values=[*colours], labels=[*colours], colors=np.array([*colours.values()], dtype=np.uint32)
        )
        self._stream.log(path, configuration, static=True)
        self._send(
            path, [time for time, _ in changes], self._rr.StateChange.columns(state=[text for _, text in changes])
        )

    def _send(self, path: str, stamps: Sequence[int], columns: Any) -> None:
        if len(stamps):
            since = (np.array(stamps, dtype=np.int64) - self._begin_ns).astype('timedelta64[ns]')
            self._stream.send_columns(path, [self._rr.TimeColumn(_AXIS, duration=since)], columns)


def _layout(tracks: Tracks) -> Any:
    """Return the blueprint: inputs beside estimates, with axes that show everything, then states and events."""
    import rerun.blueprint as rrb  # noqa: PLC0415 - as above

    # Linked axes would begin with a minute around the cursor.
    begin_ns, end_ns = time_range(tracks)
    whole = rrb.TimeRange(_boundary(0), _boundary(end_ns - begin_ns))
    axis = rrb.TimeAxis(view_range=whole, link='Independent')
    legend = rrb.PlotLegend(visible=False)
    inputs = [
        rrb.TimeSeriesView(origin=f'inputs/{name}', name=title, axis_x=axis, plot_legend=legend)
        for name, title in _PLOTS.items()
    ]
    estimates = [
        rrb.TimeSeriesView(
            origin=f'estimates/{_path(name)}',
            name=f'{tracks.title(name)}, ± 2 std',
            axis_x=axis,
            plot_legend=legend,
        )
        for name in tracks.estimates
    ]
    lanes = {'status': 'status', 'samples': 'why the newest sample was not used'}
    states = [rrb.StateTimelineView(origin=origin, name=name, time_view=axis) for origin, name in lanes.items()]
    events = rrb.TextLogView(origin='events', name='events')
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(rrb.Vertical(*inputs), rrb.Vertical(*estimates)),
            rrb.Horizontal(*states),
            events,
            row_shares=SHARES,
        ),
        rrb.TimePanel(timeline=_AXIS, state='collapsed', play_state='paused'),
        collapse_panels=True,
    )


def _boundary(time_ns: int) -> Any:
    import rerun as rr  # noqa: PLC0415 - as above

    return rr.TimeRangeBoundary.absolute(seconds=time_ns * 1e-9)


def time_range(tracks: Tracks) -> tuple[int, int]:
    """Return the earliest and the latest stamp of the inputs [ns]; where stamps jump back, not those at the ends."""
    seen = [series.stamps for series in tracks.inputs.values() if series.stamps]
    return min(map(min, seen), default=0), max(map(max, seen), default=0)


def _path(name: str) -> str:
    return name.replace(' ', '_')
