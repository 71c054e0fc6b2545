# SPDX-License-Identifier: Apache-2.0
"""What the demo refuses before it starts anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import pytest

from trainid_ros.cli import demo
from trainid_ros.cli.main import main
from trainid_ros.report import HTML_START


@pytest.fixture(autouse=True)
def _nothing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> NoReturn:
        pytest.fail('a chapter ran')

    for name in ('_live', '_hidden'):
        monkeypatch.setattr(demo, name, fail)


@pytest.mark.parametrize('only', [(), ('--only', 'explain'), ('--only', 'yizhuang')])
@pytest.mark.parametrize('inside', ['', 'deeper'])
def test_a_file_as_output_folder_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], only: tuple[str, ...], inside: str
) -> None:
    out = tmp_path / 'out'
    out.write_text('my own file', encoding='utf-8')
    assert main(['demo', *only, '--out', str(out / inside)]) == 2
    _, err = capsys.readouterr()
    assert err.count('\n') == 1
    assert 'cannot be written' in err
    assert out.read_text(encoding='utf-8') == 'my own file'


@pytest.mark.parametrize('only', [(), ('--only', 'explain')])
def test_a_page_of_somebody_else_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], only: tuple[str, ...]
) -> None:
    page = tmp_path / 'explain' / 'report.html'
    page.parent.mkdir()
    page.write_text('my own page', encoding='utf-8')
    assert main(['demo', *only, '--out', str(tmp_path)]) == 2
    assert f'{page}: exists and was not written by trainid' in capsys.readouterr().err
    assert page.read_text(encoding='utf-8') == 'my own page'


def test_only_the_chapters_played_need_their_folders(tmp_path: Path) -> None:
    (tmp_path / 'explain').write_text('my own file', encoding='utf-8')
    (tmp_path / 'report.html').write_text(f'{HTML_START}an earlier report', encoding='utf-8')
    with pytest.raises(pytest.fail.Exception, match='a chapter ran'):
        main(['demo', '--only', 'yizhuang', '--out', str(tmp_path)])
