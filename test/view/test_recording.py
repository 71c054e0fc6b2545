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
from trainid_ros.cli.main import main
from trainid_ros.view import telemetry
from trainid_ros.view.tracks import Series

telemetry.switch_off()
pytest.importorskip('rerun')

BAG = Path(__file__).parents[2] / 'bags' / 'tiny'
PLOTS = ('inputs/speed', 'inputs/force', 'inputs/gradient', 'inputs/brake_command')
ESTIMATES = ('resistance', 'speed_model', 'brake_rate')


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
    w, speed = result['resistance'], 45.0 / 3.6
    assert columns['estimates/resistance/value Scalars:scalars'][1][-1] == w['a'] + w['b'] * speed + w['c'] * (
        speed * speed
    )
    rate = result['brake_rate']
    assert columns['estimates/brake_rate/value Scalars:scalars'][1][-1] == rate['value']
    assert columns['estimates/brake_rate/upper Scalars:scalars'][1][-1] == rate['value'] + 2.0 * rate['std']


def test_recordings_of_one_name_are_not_merged(recording: Path, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader  # noqa: PLC0415 - optional

    other = tmp_path / 'tiny.rrd'
    assert main(['view', str(BAG), '--out', str(other)]) == 0
    ids = {entry.recording_id for path in (recording, other) for entry in RrdReader(path).recordings()}
    assert len(ids) == 2
    assert all(name.startswith('tiny ') for name in ids)


def test_the_axis_begins_with_the_earliest_stamp_although_stamps_jump_back() -> None:
    from trainid_ros.view.recording import time_range  # noqa: PLC0415 - after the telemetry is off

    series = Series()
    for stamp in (5_000, 6_000, 1_000, 2_000):
        series.add(stamp, 0.0)
    tracks: Any = SimpleNamespace(inputs={'speed': series, 'force': Series()})
    assert time_range(tracks) == (1_000, 6_000)
    nothing: Any = SimpleNamespace(inputs={'force': Series()})
    assert time_range(nothing) == (0, 0)


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
    from trainid_ros.view.recording import SHARES  # noqa: PLC0415 - after the telemetry is off

    top, middle = 40, picture.shape[1] // 2
    bottom = top + int((picture.shape[0] - 80) * SHARES[0] / sum(SHARES))
    line = np.all(np.abs(picture[top:bottom] * 255.0 - np.array((31, 119, 180))) < 40.0, axis=2)
    columns = (line[:, :middle], len(PLOTS)), (line[:, middle:], len(ESTIMATES))
    return [float(plot.mean()) for column, count in columns for plot in np.array_split(column, count)]
