# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import io
import json
import math
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
import pytest

from test.report.conftest import BRAKE
from trainid_ros.cli.output import (
    check_output,
    print_json,
    progress,
    show,
    table,
    to_plain,
    warn,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.results import Output, Status
from trainid_ros.interface.text import in_ascii
from trainid_ros.report import HTML_START
from trainid_ros.report.page import page


class Colour(IntEnum):
    RED = 3


@dataclass(frozen=True, slots=True)
class Outer:
    values: tuple[float, ...]
    colour: Colour
    path: Path


def test_all_permitted_types_become_json_types() -> None:
    value = {
        'output': Output(7, BRAKE, Status.VALID, 3, 1, None),
        'outer': {'inner': Outer((1.0, math.nan, -math.inf), Colour.RED, Path('a/b'))},
        'array': np.array([[1.0, math.inf]]),
        'scalars': [np.float64(0.5), np.int32(4), np.bool_(True), True, None],
        Colour.RED: 1,
    }
    assert to_plain(value) == {
        'output': {
            'stamp_ns': 7,
            'estimate': dataclasses.asdict(BRAKE),
            'status': 'VALID',
            'used': 3,
            'rejected': 1,
            'last_rejection': None,
        },
        'outer': {'inner': {'values': [1.0, None, None], 'colour': 'RED', 'path': 'a/b'}},
        'array': [[1.0, None]],
        'scalars': [0.5, 4, True, True, None],
        'RED': 1,
    }


def test_json_is_printed_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({'x': float('inf'), 'name': 'Zürich'})
    text = capsys.readouterr().out
    assert text.count('\n') == 1
    assert json.loads(text) == {'x': None, 'name': 'Zürich'}
    with pytest.raises(TypeError, match='object has no JSON form'):
        to_plain({'x': object()})


def test_table_aligns_text_left_and_numbers_right() -> None:
    assert table([('name', 'n'), ('a', '1'), ('longer', '22')], numbers=(1,)) == 'name     n\na        1\nlonger  22'


def test_progress_is_shown_on_a_terminal_and_leaves_standard_output_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = []
    for is_terminal in (False, True):
        monkeypatch.setattr('sys.stderr.isatty', lambda is_terminal=is_terminal: is_terminal)
        monkeypatch.setenv('TERM', 'xterm')
        with progress('working', 10) as advance:
            advance(5)
        out, err = capsys.readouterr()
        assert out == ''
        shown.append(err)
    assert shown[0] == ''
    assert 'working' in shown[1]


HOSTILE = 'x\x1b]0;owned\x07\x1b[2J\x9b31m\u202ey\udcff'
ESCAPED = r'x\x1b]0;owned\x07\x1b[2J\x9b31m\u202ey\udcff'


def test_names_cannot_control_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    show(f'Zürich {HOSTILE}\nline')
    warn(f'{HOSTILE}\n{HOSTILE}')
    warn(InputError(f'{HOSTILE}: x'), 'error')
    out, err = capsys.readouterr()
    assert out == f'Zürich {ESCAPED}\nline\n'
    assert err == f'trainid: warning: {ESCAPED} {ESCAPED}\ntrainid: error: {ESCAPED}: x\n'
    print_json({HOSTILE: HOSTILE})
    text = capsys.readouterr().out
    assert text.rstrip('\n').isprintable()
    assert json.loads(text) == {HOSTILE: HOSTILE}


def test_an_output_replaces_nothing_but_an_earlier_one(tmp_path: Path) -> None:
    train, report, link = tmp_path / 'T.yaml', tmp_path / 'report.html', tmp_path / 'link.html'
    train.write_text('train: {}', encoding='utf-8')
    check_output(report, (train, None, tmp_path / 'missing'), HTML_START)
    report.write_text(page('drive', '', 'end'), encoding='utf-8')
    check_output(report, (train,), HTML_START)
    foreign = tmp_path / 'mine.html'
    foreign.write_text('<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>mine', encoding='utf-8')
    (tmp_path / 'empty.html').touch()
    check_output(tmp_path / 'empty.html', (train,), HTML_START)
    link.symlink_to(train)
    for path, inputs, reason in (
        (train, (train,), 'is an input and would be overwritten'),
        (link, (train,), 'is an input and would be overwritten'),
        (report, (report,), 'is an input and would be overwritten'),
        (train, (), 'exists and was not written by trainid'),
        (foreign, (), 'exists and was not written by trainid'),
        (tmp_path, (), 'exists and is not a file'),
    ):
        with pytest.raises(InputError, match=f'{path}: {reason}'):
            check_output(path, inputs, HTML_START)


def test_what_a_terminal_without_unicode_lacks_is_written_in_ascii(monkeypatch: pytest.MonkeyPatch) -> None:
    assert in_ascii('– 1.0 ± 0.1 m/s² ‰ ä') == '- 1.0 +- 0.1 m/s^2 permille ?'
    for encoding, text, written in (
        ('ascii', '1.0 ± 0.1', '1.0 +- 0.1'),
        ('latin-1', '1.0 ± 0.1', '1.0 ± 0.1'),
        ('latin-1', '‰ ± é', 'permille +- ?'),
        ('utf-8', '‰ ± é', '‰ ± é'),
    ):
        stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr('sys.stdout', stream)
        show(text)
        print_json({'text': text})
        stream.flush()
        first, second = stream.buffer.getvalue().decode(encoding).splitlines()
        assert first == written
        assert json.loads(second) == {'text': text}
