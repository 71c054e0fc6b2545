# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.cli.output import print_json, progress, table, to_plain
from trainid_ros.results import BrakeRateEstimate, Output, Status

BRAKE = BrakeRateEstimate(0.93, 0.02, 1.5, 12.0, -0.5, -0.6, 77.5, True, 0.01, 0.002, 0.3)


class Colour(IntEnum):
    RED = 3


@dataclass(frozen=True, slots=True)
class Inner:
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Outer:
    inner: Inner
    colour: Colour
    path: Path


def test_all_permitted_types_become_json_types() -> None:
    value = {
        'output': Output(7, BRAKE, Status.VALID, 3, 1, None),
        'outer': Outer(Inner((1.0, math.nan, -math.inf)), Colour.RED, Path('a/b')),
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
        'outer': {'inner': {'values': [1.0, None, None]}, 'colour': 'RED', 'path': 'a/b'},
        'array': [[1.0, None]],
        'scalars': [0.5, 4, True, True, None],
        'RED': 1,
    }


def test_json_is_printed_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({'x': float('inf'), 'name': 'Zürich'})
    text = capsys.readouterr().out
    assert text.count('\n') == 1
    assert json.loads(text) == {'x': None, 'name': 'Zürich'}


def test_value_without_json_form_is_rejected() -> None:
    with pytest.raises(TypeError, match='object has no JSON form'):
        to_plain({'x': object()})


def test_table_aligns_text_left_and_numbers_right() -> None:
    assert table([('name', 'n'), ('a', '1'), ('longer', '22')], numbers=(1,)) == 'name     n\na        1\nlonger  22'


def test_progress_prints_nothing_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with progress('work', 10) as advance:
        advance(5)
    assert capsys.readouterr() == ('', '')


def test_progress_on_a_terminal_leaves_standard_output_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('sys.stderr.isatty', lambda: True)
    monkeypatch.setenv('TERM', 'xterm')
    with progress('working', 10) as advance:
        advance(5)
    captured = capsys.readouterr()
    assert captured.out == ''
    assert 'working' in captured.err
