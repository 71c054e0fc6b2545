# SPDX-License-Identifier: Apache-2.0
"""``trainid fit``: the agreed JSON, parts of a bag, exit codes and one-line errors."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.cli.main import main
from trainid_ros.interface.records import ForceRecord, GradientRecord

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from test.cli.conftest import Change

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
    assert (answer['a'], answer['std']) == (None, [None] * 3)
    assert ('too few to fit' in err, err.count('\n')) == (True, 1)


def test_a_part_changes_the_fit(driven_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answers = []
    for options in ((), ('--start', '0', '--duration', '1e4'), ('--duration', '30'), ('--start', '25')):
        assert call(driven_bag, '--json', *options) == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0] == answers[1]
    assert answers[2]['a'] != answers[0]['a'] != answers[3]['a']


@pytest.mark.parametrize('options', [('--start', '999'), ('--duration', '0')])
def test_a_part_outside_the_bag_is_bad_input(
    driven_bag: Path, options: tuple[str, ...], one_error: Callable[[], str]
) -> None:
    assert call(driven_bag, *options) == 2
    assert options[0] in one_error()


def test_a_missing_topic_or_train_is_bad_input(driven_bag: Path, changed: Change, one_error: Callable[[], str]) -> None:
    blind = changed(lambda record: None if isinstance(record, GradientRecord) else record)
    assert call(blind, train=driven_bag / 'train.yaml') == 2
    assert 'ato/gradient' in one_error()
    assert call(driven_bag, train=driven_bag / 'none.yaml') == 2
    assert 'none.yaml' in one_error()


def test_forces_in_kn_give_no_answer(driven_bag: Path, changed: Change, capsys: pytest.CaptureFixture[str]) -> None:
    path = changed(lambda item: replace(item, force=1e-3 * item.force) if isinstance(item, ForceRecord) else item)
    assert call(path, '--json', train=driven_bag / 'train.yaml') == 1
    out, err = capsys.readouterr()
    assert json.loads(out)['a'] is None
    assert ('ato/force is in kN' in err, err.count('\n')) == (True, 1)


@pytest.mark.parametrize('value', ['-1', 'x', 'nan'])
def test_times_must_be_numbers(driven_bag: Path, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        call(driven_bag, '--start', value)
    assert caught.value.code == 2
    assert 'must be a number' in capsys.readouterr().err
