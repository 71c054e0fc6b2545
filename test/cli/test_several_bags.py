# SPDX-License-Identifier: Apache-2.0
"""Several bags in one command: results in the order of the bags, alone or in processes, whatever happens to one."""

from __future__ import annotations

import json
from argparse import Namespace
from importlib import import_module
from shutil import copytree
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.cli.output import run_per_bag

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


# A module of its own: processes cannot import those of the tests.
WORK = """
import os
import signal
from trainid_ros.cli.output import BagResult

def work(args, bag, advance):
    if bag.name == 'none':
        os.kill(os.getpid(), signal.SIGKILL)
    return BagResult(bag.name)
"""


@pytest.fixture
def bags(driven_bag: Path, tmp_path: Path) -> list[str]:
    """Return two bags with a missing one between them."""
    for name in ('one', 'two'):
        copytree(driven_bag, tmp_path / name)
    return [str(tmp_path / name) for name in ('one', 'none', 'two')]


def replay(bags: list[str], *options: str) -> int:
    return main(['replay', *bags, '--train', f'{bags[0]}/train.yaml', *options])


def without_time(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: value for key, value in result.items() if key != 'wall_s'} for result in results]


def test_info_of_several_bags_is_a_list(bags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', *bags, '--json']) == 2
    captured = capsys.readouterr()
    one, none, two = json.loads(captured.out)
    assert [one['bag'], none, two['bag']] == [bags[0], {'bag': bags[1], 'error': f'{bags[1]}: no such bag'}, bags[2]]
    assert one['usable']
    assert one['messages'] == two['messages'] > 0
    assert captured.err == f'trainid: error: {bags[1]}: no such bag\n'


def test_text_follows_the_order_of_the_bags(bags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', bags[1]]) == 2
    assert capsys.readouterr() == ('', f'trainid: error: {bags[1]}: no such bag\n')
    assert main(['info', bags[2], bags[0]]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f'{bags[2]}: usable; ')
    assert f'\n\n{bags[0]}: usable; ' in text


def test_processes_give_the_same_as_one_bag_at_a_time(bags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert replay(bags, '--json') == 2
    alone = capsys.readouterr()
    assert replay(bags, '--json', '--jobs', '2') == 2
    together = capsys.readouterr()
    assert without_time(json.loads(together.out)) == without_time(json.loads(alone.out))
    assert together.err == alone.err == f'trainid: error: {bags[1]}: no such bag\n'
    assert replay(bags[:1], '--json') == 0
    single = json.loads(capsys.readouterr().out)
    assert without_time([{'bag': bags[0], **single}]) == without_time(json.loads(alone.out))[:1]


def test_a_killed_process_costs_the_result_of_its_own_bag_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'work_of_test_bags.py').write_text(WORK, encoding='utf-8')
    monkeypatch.syspath_prepend(tmp_path)
    args = Namespace(bags=[tmp_path / name for name in ('one', 'none', 'two')], jobs=2, json=False)
    assert run_per_bag(args, import_module('work_of_test_bags').work, 'try') == 2
    captured = capsys.readouterr()
    assert captured.out == 'one\n\ntwo\n'
    killed = 'the process that worked on it was killed (out of memory?)'
    assert captured.err == f'trainid: error: {tmp_path}/none: {killed}\n'


def test_each_bag_gets_its_own_outputs(
    bags: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr('trainid_ros.report.drive_report.render_report', lambda title, _: title)  # figures take long
    out, reports = tmp_path / 'a/out', tmp_path / 'reports'
    assert replay(bags, '--out', str(out), '--report', str(reports)) == 2
    assert sorted(path.name for path in out.iterdir()) == ['one', 'two']
    pages = {path.name: path.read_text(encoding='utf-8') for path in reports.iterdir()}
    assert pages == {'one.html': 'trainid replay: one', 'two.html': 'trainid replay: two'}
    with BagReader(out / 'two') as reader:
        assert 'trainid/resistance' in {topic.name for topic in reader.topics()}
    assert capsys.readouterr().out.startswith(f'{bags[0]}: ')


def test_outputs_are_not_of_several_bags(bags: list[str], tmp_path: Path, one_error: Callable[[], str]) -> None:
    copytree(bags[0], tmp_path / 'other/one')
    for given, options, problem in (
        ([bags[0], str(tmp_path / 'other/one')], ('--out', str(tmp_path / 'out')), '2 bags have the name one'),
        (bags, ('--truth', f'{bags[0]}/truth.yaml'), '--truth'),
        (bags[:1] * 2, ('--out', 'e.csv'), 'e.csv: is the table of one bag, but several bags are given'),
    ):
        assert replay(given, *options) == 2
        assert problem in one_error()
    assert not (tmp_path / 'out').exists()


def test_what_no_bag_can_use_is_reported_once(bags: list[str], one_error: Callable[[], str]) -> None:
    assert main(['replay', *bags, '--train', 'none.yaml']) == 2
    assert 'none.yaml' in one_error()
