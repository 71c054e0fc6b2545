# SPDX-License-Identifier: Apache-2.0
"""A recording holds the numbers of the replay, and the viewer draws it without telling anybody."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from test.chromium import Chromium, find_chromium, ink
from test.hang import HANG_S
from test.report.conftest import BRAKE, START_NS
from trainid_ros.bag.bag_replay import AnyOutput, Pipelines, replay_through
from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.interface.records import SpeedRecord
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, SpeedModelEstimate, Status
from trainid_ros.monitor.trains import SHOWN, resistance_at
from trainid_ros.report.recording import (
    SHARES,
    USED,
    ViewRecorder,
    estimate_panel,
    input_panels,
    switch_off_telemetry,
    time_range,
)
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.train.train_file import load_train_file

switch_off_telemetry()
pytest.importorskip('rerun')

BAG = Path(__file__).parents[2] / 'bags' / 'tiny'
PLOTS = ('inputs/speed', 'inputs/force', 'inputs/gradient', 'inputs/brake_command')
ESTIMATES = ('resistance', 'speed_model', 'brake_rate')
NAMES = {ResistanceEstimate: 'resistance', SpeedModelEstimate: 'speed model', BrakeRateEstimate: 'brake rate'}


@pytest.fixture(scope='module')
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('view') / 'tiny.rrd'
    assert main(['view', str(BAG), '--out', str(path)]) == 0
    return path


def test_a_name_that_rerun_does_not_open_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['view', str(BAG), '--out', str(tmp_path / 'x.txt')]) != 0
    assert 'x.txt: the name of a recording must end in .rrd' in capsys.readouterr().err


@pytest.fixture(scope='module')
def columns(recording: Path) -> dict[str, Any]:
    """Return times [s] and values by path and component."""
    from rerun.chunk import RrdReader  # noqa: PLC0415 - optional

    found: dict[str, Any] = {}
    for chunk in RrdReader(recording).stream():
        if chunk.is_static or not chunk.entity_path.startswith(('/inputs', '/estimates', '/status', '/events')):
            continue
        batch = chunk.to_record_batch()
        times = np.array(batch.column('time').to_numpy(zero_copy_only=False)).astype('timedelta64[ns]').astype(float)
        for name in batch.schema.names:
            if name.partition(':')[0] in {'Scalars', 'StateChange', 'TextLog'}:
                values = [item[0] for item in batch.column(name).to_pylist()]
                found[f'{chunk.entity_path[1:]} {name}'] = (times * 1e-9, values)
    return found


def test_all_is_there_on_one_axis(columns: dict[str, Any]) -> None:
    for path in (*PLOTS, *(f'estimates/{name}/{part}' for name in ESTIMATES for part in ('value', 'upper', 'lower'))):
        times, values = columns[f'{path} Scalars:scalars']
        assert len(values) > 1000
        assert 0.0 <= times[0] < 1.0
        assert 300.0 < times[-1] < 400.0
        assert np.all(np.isfinite(values))
    for name in ESTIMATES:
        assert 'VALID' in columns[f'status/{name} StateChange:state'][1]
    assert 'resistance: CONVERGING to VALID' in columns['events TextLog:text'][1]


def test_numbers_are_those_of_replay(columns: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['replay', str(BAG), '--train', str(BAG / 'train.yaml'), '--json']) == 0
    result = json.loads(capsys.readouterr().out)
    w, rate, speed = result['resistance'], result['brake_rate'], 45.0 / 3.6
    for name, expected in (
        ('resistance/value', w['a'] + w['b'] * speed + w['c'] * (speed * speed)),
        ('brake_rate/value', rate['value']),
        ('brake_rate/upper', rate['value'] + 2.0 * rate['std']),
    ):
        assert columns[f'estimates/{name} Scalars:scalars'][1][-1] == expected


def test_recordings_of_one_name_are_not_merged(recording: Path, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader  # noqa: PLC0415 - optional

    other = tmp_path / 'tiny.rrd'
    assert main(['view', str(BAG), '--out', str(other)]) == 0
    ids = {entry.recording_id for path in (recording, other) for entry in RrdReader(path).recordings()}
    assert len(ids) == 2
    assert all(name.startswith('tiny ') for name in ids)


def test_the_axis_begins_with_the_earliest_stamp_although_stamps_jump_back() -> None:
    recorder, _ = empty()
    assert time_range(recorder.finish()) == (0, 0)
    for stamp in (5_000, 6_000, 1_000, 2_000):
        recorder.add_record(SpeedRecord(stamp, 0.0, 0.0))
    assert time_range(recorder.finish()) == (-4_000, 1_000)


@pytest.fixture(scope='module')
def recorder() -> ViewRecorder:
    file, settings = load_train_file(BAG / 'train.yaml'), EstimatorSettings()
    pipelines = Pipelines.of(file, settings)
    collected = ViewRecorder(pipelines)
    with BagReader(BAG) as reader:
        replay_through(pipelines, reader, None, (collected,))
    return collected


@pytest.fixture(scope='module')
def outputs() -> list[AnyOutput]:
    seen: list[AnyOutput] = []
    observer: Any = SimpleNamespace(on_record=lambda _: None, on_output=lambda output, _: seen.append(output))
    with BagReader(BAG) as reader:
        replay_through(
            Pipelines.of(load_train_file(BAG / 'train.yaml'), EstimatorSettings()), reader, None, (observer,)
        )
    return [output for output in seen if output.stamp_ns > 0]


def test_estimates_are_those_of_the_replay_to_the_bit(recorder: ViewRecorder, outputs: list[AnyOutput]) -> None:
    recording = recorder.finish()
    for kind, track in zip(NAMES, (recording.resistance, recording.speed_model, recording.brake_rate), strict=True):
        expected = [(item.stamp_ns, item.estimate) for item in outputs if isinstance(item.estimate, kind)]
        assert [*zip((recording.start_ns + track.time_ns).tolist(), track.estimates, strict=True)] == expected


def test_the_band_is_that_of_one_speed(recorder: ViewRecorder, outputs: list[AnyOutput]) -> None:
    panel = estimate_panel(SHOWN[0], recorder.finish().resistance)
    assert panel.label == 'resistance: w at 45 km/h [N/kN]'
    last = [item.estimate for item in outputs if isinstance(item.estimate, ResistanceEstimate)][-1]
    assert panel.std is not None
    assert (panel.value[-1], panel.std[-1]) == resistance_at(last, 45.0 / 3.6)


def test_status_changes_are_states_and_events(recorder: ViewRecorder, outputs: list[AnyOutput]) -> None:
    statuses = [item.status.name for item in outputs if isinstance(item.estimate, BrakeRateEstimate)]
    changes = [after for before, after in zip(['', *statuses], statuses, strict=False) if before != after]
    assert [text for _, text in recorder.outputs[BrakeRateEstimate].statuses.changes] == changes
    events = [item.text for item in recorder.events if item.text.startswith('brake rate: ')]
    assert len(events) == len(changes) > 3
    assert events[0] == f'brake rate: {changes[0]}'
    assert events[1] == f'brake rate: {changes[0]} to {changes[1]}'


def test_samples_have_reasons_and_inputs_the_units_of_the_plots(recorder: ViewRecorder) -> None:
    assert {USED, 'BRAKING', 'STANDSTILL'} <= {text for _, text in recorder.rejected['resistance'].changes}
    panels = input_panels(recorder.finish())
    assert 70.0 < panels['speed'].value.max() < 90.0
    assert 100.0 < panels['force'].value.max() < 400.0
    assert panels['brake_command'].value.min() < -0.3


def empty(finding: str = '') -> tuple[ViewRecorder, Any]:
    stream = SimpleNamespace(finding=finding)
    pipelines: Any = SimpleNamespace(resistance=SimpleNamespace(stream=stream))
    return ViewRecorder(pipelines), stream


def test_findings_are_events() -> None:
    recorder, stream = empty()
    for k, finding in enumerate(('', 'ato/speed looks like km/h', 'ato/speed looks like km/h', '')):
        stream.finding = finding
        recorder.on_output(Output(START_NS + k, BRAKE, Status.CONVERGING, 0, 0, None))
    found = [(item.stamp_ns - START_NS, item.is_bad, item.text) for item in recorder.events[1:]]
    assert found == [
        (1, True, 'inputs contradict each other: ato/speed looks like km/h'),
        (3, False, 'inputs agree again: ato/speed looks like km/h'),
    ]


def test_without_estimates_there_is_no_line() -> None:
    panel = estimate_panel(SHOWN[0], empty()[0].finish().resistance)
    assert (panel.label, panel.value.tolist()) == ('resistance', [])


def test_telemetry_is_off_for_children(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {'FORCE_RERUN_ANALYTICS': '1', 'CI': '', 'TELEMETRY_ENABLED': 'true'}
    monkeypatch.setattr(os, 'environ', os.environ | before)
    switch_off_telemetry()
    assert os.environ['CI'] == 'true'
    assert os.environ['TELEMETRY_ENABLED'] == 'false'
    assert 'FORCE_RERUN_ANALYTICS' not in os.environ


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return int(probe.getsockname()[1])


@contextmanager
def served(recording: Path, log: Path) -> Iterator[str]:
    """Serve a recording on this machine; yield the address of its page."""
    data, page = free_port(), free_port()
    ports = ['--bind', '127.0.0.1', '--port', str(data), '--web-viewer-port', str(page)]
    with log.open('wb') as file:
        process = subprocess.Popen(
            [sys.executable, '-m', 'rerun', '--serve-web', *ports, str(recording)],
            stdout=file,
            stderr=file,
            env=os.environ | {'RUST_LOG': 'info,re_analytics=debug'},
            start_new_session=True,
        )
        try:
            while b'Hosting a web-viewer' not in log.read_bytes():
                assert process.poll() is None, log.read_text()
                time.sleep(0.05)
            yield f'http://127.0.0.1:{page}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data}%2Fproxy&renderer=webgl&theme=light'
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
def test_a_browser_draws_every_view(recording: Path, tmp_path: Path) -> None:
    program, log = find_chromium(), tmp_path / 'server.log'
    browser = Chromium(program, tmp_path / 'profile')
    try:
        with served(recording, log) as url:
            browser.call('Emulation.setDeviceMetricsOverride', width=960, height=800, deviceScaleFactor=1, mobile=False)
            browser.open(url)
            end = time.monotonic() + HANG_S
            while min(blue := views_with_line(browser.picture())) < 0.002:
                assert time.monotonic() < end, f'share of the pixels of a line in each plot: {blue}'
                time.sleep(1.0)
            assert ink(browser.picture()) > 0.05
    finally:
        browser.close()
    assert 'Analytics disabled' in log.read_text(encoding='utf-8')


def views_with_line(picture: Any) -> list[float]:
    """Return the share of the pixels with the colour of lines in each plot: four on the left, three on the right."""
    top, middle = 40, picture.shape[1] // 2
    bottom = top + int((picture.shape[0] - 80) * SHARES[0] / sum(SHARES))
    line = np.all(np.abs(picture[top:bottom] * 255.0 - np.array((31, 119, 180))) < 40.0, axis=2)
    columns = (line[:, :middle], len(PLOTS)), (line[:, middle:], len(ESTIMATES))
    return [float(plot.mean()) for column, count in columns for plot in np.array_split(column, count)]
