# SPDX-License-Identifier: Apache-2.0
"""``trainid fit``: the agreed JSON, parts of a bag, exit codes and one-line errors."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.main import main
from trainid_ros.interface.records import ForceRecord, GradientRecord

if TYPE_CHECKING:
    from pathlib import Path

KEYS = {'a', 'b', 'c', 'std', 'iterations', 'mse', 'converged', 'speed_range'}


def call(bag: Path, *options: str, train: Path | None = None) -> int:
    return main(['fit', str(bag), '--train', str(train or bag / 'train.yaml'), *options])


def test_json_has_the_agreed_fields_and_plausible_values(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(driven_bag, '--json') == 0
    out, err = capsys.readouterr()
    answer: dict[str, Any] = json.loads(out)
    assert (out.count('\n'), err) == (1, '')
    assert set(answer) == KEYS
    assert answer['converged'] is True
    assert len(answer['std']) == 3
    slow, fast = answer['speed_range']
    assert 0.0 < slow < 8.0
    assert 12.0 < fast < 25.0
    v = 0.5 * (slow + fast)
    w = answer['a'] + v * (answer['b'] + answer['c'] * v)
    assert w == pytest.approx(1.5 + 0.02 * v + 0.001 * v * v, abs=1.0)


def test_summary_shows_parameters_and_noise(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(driven_bag) == 0
    out = capsys.readouterr().out
    assert all(text in out for text in ('N/kN per (m/s)^2', 'w at ', 'speed noise', 'iterations', '1 pieces'))


def test_a_part_without_motion_gives_no_answer(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(driven_bag, '--duration', '0.8', '--json') == 1
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert set(answer) == KEYS
    assert answer['a'] is None
    assert answer['std'] == [None] * 3
    assert err.count('\n') == 1
    assert 'too few to fit' in err


def test_a_part_changes_the_fit(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answers = []
    for options in ((), ('--start', '0', '--duration', '1e4'), ('--duration', '30'), ('--start', '25')):
        assert call(driven_bag, '--json', *options) == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0] == answers[1]
    assert answers[2]['a'] != answers[0]['a'] != answers[3]['a']


@pytest.mark.parametrize('options', [('--start', '999'), ('--duration', '0')])
def test_a_part_outside_the_bag_is_bad_input(
    driven_bag: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(driven_bag, *options) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert options[0] in err


def test_a_missing_topic_or_train_is_bad_input(
    tmp_path: Path, driven_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagReader(driven_bag) as reader, BagWriter(tmp_path / 'blind') as writer:
        for record in reader.records():
            if not isinstance(record, GradientRecord):
                writer.write_record(record)
    assert call(tmp_path / 'blind', train=driven_bag / 'train.yaml') == 2
    assert 'ato/gradient' in capsys.readouterr().err
    assert call(driven_bag, train=tmp_path / 'none.yaml') == 2
    assert 'none.yaml' in capsys.readouterr().err


def test_forces_in_kn_give_no_answer(tmp_path: Path, driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagReader(driven_bag) as reader, BagWriter(tmp_path / 'kn') as writer:
        for record in reader.records():
            if isinstance(record, ForceRecord):
                writer.write_record(replace(record, force=1e-3 * record.force))
            else:
                writer.write_record(record)
    assert call(tmp_path / 'kn', '--json', train=driven_bag / 'train.yaml') == 1
    out, err = capsys.readouterr()
    assert json.loads(out)['a'] is None
    assert err.count('\n') == 1
    assert 'ato/force is in kN' in err


@pytest.mark.parametrize('value', ['-1', 'x', 'nan'])
def test_times_must_be_numbers(driven_bag: Path, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        call(driven_bag, '--start', value)
    assert caught.value.code == 2
    assert 'must be a number' in capsys.readouterr().err
