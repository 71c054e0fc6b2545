# SPDX-License-Identifier: Apache-2.0
"""``trainid view``: what it needs, and what it leaves alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from trainid_ros.cli.main import main
from trainid_ros.view import telemetry


def test_without_rerun_one_line_names_the_extra(driven_bag: Path, tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rerun'] = None; from trainid_ros.cli.main import main; "
        f"sys.exit(main(['view', {str(driven_bag)!r}, '--out', 'x.rrd']))"
    )
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    package = "the viewer needs the Python package rerun: pip install 'trainid_ros[view]'"
    assert done.stderr == f'trainid: error: {package}\n'
    assert not list(tmp_path.iterdir())


def test_telemetry_is_off_for_children(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv('CI', raising=False)
    monkeypatch.setenv('FORCE_RERUN_ANALYTICS', '1')
    monkeypatch.setattr(os, 'environ', os.environ.copy())
    telemetry.switch_off()
    assert os.environ['CI'] == 'true'
    assert 'FORCE_RERUN_ANALYTICS' not in os.environ


class TestWithRerun:
    """What the command says beside its recording."""

    @pytest.fixture(autouse=True)
    def _needs_rerun(self) -> None:
        telemetry.switch_off()
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
            return SimpleNamespace(returncode=7)

        monkeypatch.setenv('DISPLAY', ':0')
        monkeypatch.setattr('trainid_ros.cli.view.subprocess.run', run)
        assert main(['view', str(driven_bag)]) == 7
        ((command, start, telemetry_off),) = opened
        assert command[:5] == [sys.executable, '-m', 'rerun', '--bind', '127.0.0.1']
        assert start == b'RRF2'
        assert telemetry_off == 'true'
        assert not Path(command[-1]).exists()

    def test_a_bag_without_train_file_needs_one(
        self, driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        shutil.copytree(driven_bag, tmp_path / 'bag')
        (tmp_path / 'bag' / 'train.yaml').unlink()
        assert main(['view', str(tmp_path / 'bag'), '--out', str(tmp_path / 'x.rrd')]) == 2
        assert 'there is no train.yaml beside it: give --train' in capsys.readouterr().err
        assert main(['view', str(tmp_path / 'none'), '--out', str(tmp_path / 'x.rrd')]) == 2
        assert 'none: no such bag' in capsys.readouterr().err

    def test_only_recordings_are_written_over(
        self, driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = tmp_path / 'a' / 'x.rrd'
        for _ in range(2):
            assert main(['view', str(driven_bag), '--out', str(out)]) == 0
        assert capsys.readouterr().out.count('x.rrd: open it with: rerun ') == 2
        out.write_text('notes', encoding='utf-8')
        assert main(['view', str(driven_bag), '--out', str(out)]) == 2
        assert out.read_text(encoding='utf-8') == 'notes'

    def test_a_file_that_cannot_be_written_is_named(
        self, driven_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / 'file').touch()
        assert main(['view', str(driven_bag), '--out', str(tmp_path / 'file' / 'x.rrd')]) == 2
        assert 'cannot be written' in capsys.readouterr().err
