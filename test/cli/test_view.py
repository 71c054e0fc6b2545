# SPDX-License-Identifier: Apache-2.0
"""``trainid view``: what it needs, and what it leaves alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from trainid_ros.cli.main import main
from trainid_ros.report.recording import switch_off_telemetry


def test_without_rerun_one_line_names_the_extra(driven_bag: Path, tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rerun'] = None; from trainid_ros.cli.main import main; "
        f"sys.exit(main(['view', {str(driven_bag)!r}, '--out', 'x.rrd']))"
    )
    done = subprocess.run([sys.executable, '-c', code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    package = "the viewer needs the Python package rerun: pip install 'trainid_ros[view]'"
    assert done.stderr == f'trainid: error: {package}\n'
    assert not list(tmp_path.iterdir())


class TestWithRerun:
    """What the command says beside its recording."""

    @pytest.fixture(autouse=True)
    def _needs_rerun(self) -> None:
        switch_off_telemetry()
        pytest.importorskip('rerun')

    def test_without_a_display_it_says_what_to_do(
        self, driven_bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        for name in ('DISPLAY', 'WAYLAND_DISPLAY'):
            monkeypatch.delenv(name, raising=False)
        assert main(['view', str(driven_bag)]) == 2
        assert 'no display to open the viewer on: give --out FILE.rrd' in capsys.readouterr().err

    def test_the_viewer_opens_a_recording_without_telemetry(
        self, driven_bag: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened = []

        def run(command: list[str], **_: object) -> object:
            opened.append((command, Path(command[-1]).read_bytes()[:4], os.environ.get('CI')))
            return SimpleNamespace(returncode=0)

        monkeypatch.setenv('DISPLAY', ':0')
        monkeypatch.setattr('trainid_ros.cli.replay.subprocess.run', run)
        assert main(['view', str(driven_bag)]) == 0
        ((command, start, telemetry_off),) = opened
        assert command[:5] == [sys.executable, '-m', 'rerun', '--bind', '127.0.0.1']
        assert start == b'RRF2'
        assert telemetry_off == 'true'
        assert not Path(command[-1]).exists()

    def test_a_display_that_does_not_answer_is_named_in_one_line(
        self, driven_bag: Path, monkeypatch: pytest.MonkeyPatch, one_error: Callable[[], str]
    ) -> None:
        said = 'INFO a line of Rerun\nError: winit at mod.rs:788: Failed to open connection to X server\n\n'
        ended = SimpleNamespace(returncode=1, stderr=said)
        monkeypatch.setenv('DISPLAY', ':99')
        monkeypatch.setattr('trainid_ros.cli.replay.subprocess.run', lambda *_, **__: ended)
        assert main(['view', str(driven_bag)]) == 2
        wanted = 'cannot run on this display: Failed to open connection to X server; give --out FILE.rrd'
        assert wanted in one_error()

    def test_a_full_disk_leaves_nothing(self, driven_bag: Path, tmp_path: Path) -> None:
        code = (
            'import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)); '
            'from trainid_ros.cli.main import main; '
            f"sys.exit(main(['view', {str(driven_bag)!r}, '--out', 'x.rrd']))"
        )
        command = [sys.executable, '-B', '-c', code]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert done.stderr == 'trainid: error: x.rrd: cannot be written (File too large)\n'
        assert not list(tmp_path.iterdir())

    def test_what_is_missing_is_named(self, driven_bag: Path, tmp_path: Path, one_error: Callable[[], str]) -> None:
        shutil.copytree(driven_bag, tmp_path / 'bag')
        (tmp_path / 'bag' / 'train.yaml').unlink()
        (tmp_path / 'file').touch()
        for bag, out, problem in (
            (tmp_path / 'bag', 'x.rrd', 'there is no train.yaml beside it: give --train'),
            (tmp_path / 'none', 'x.rrd', 'none: no such bag'),
            (driven_bag, 'file/x.rrd', 'cannot be written'),
        ):
            assert main(['view', str(bag), '--out', str(tmp_path / out)]) == 2
            assert problem in one_error()

    def test_only_recordings_are_written_over(
        self, driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = tmp_path / 'a b' / 'x.rrd'
        for _ in range(2):
            assert main(['view', str(driven_bag), '--out', str(out)]) == 0
        assert capsys.readouterr().out.count(f"x.rrd: open it with: rerun '{out}'") == 2
        out.write_text('notes', encoding='utf-8')
        assert main(['view', str(driven_bag), '--out', str(out)]) == 2
        assert out.read_text(encoding='utf-8') == 'notes'
