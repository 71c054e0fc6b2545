# SPDX-License-Identifier: Apache-2.0
"""``trainid simulate --fleet`` writes the bags of a fleet, and says how to make its page."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from trainid_ros.cli.main import main
from trainid_ros.fleet.table_file import find_bags, label_rule, list_bags
from trainid_ros.sim.worlds import WORLDS, world_train
from trainid_ros.train.train_file import dump_train_file


def call(out: Path, *options: str) -> int:
    return main(['simulate', str(out), '--runs', '1', *options])


def test_bags_have_train_and_day_and_the_next_command_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'my fleet'
    fault = 'T02:wheel_diameter:ratio=1.02:2'
    assert call(out, '--fleet', '2', '--days', '2', '--fault', fault) == 0
    text = capsys.readouterr().out
    bags = list_bags(find_bags([out]), label_rule(None))
    days = ('2026-01-01', '2026-01-02')
    assert [(bag.train, bag.day) for bag in bags] == [(train, day) for train in ('T01', 'T02') for day in days]
    assert all((Path(bag.path) / 'truth.yaml').is_file() for bag in bags)
    assert '2 trains, 2 days, 4 bags; faults: T02' in text
    replay, report = text.splitlines()[-1].removeprefix('next: ').split(' && ')
    assert shlex.split(replay)[2:5] == [str(out), '--train', str(out / 'train.yaml')]
    assert shlex.split(report)[:4] == ['trainid', 'fleet', 'report', shlex.split(replay)[-1]]
    assert [item.name for item in tmp_path.iterdir()] == [out.name]
    assert call(out, '--fleet', '2') == 2


@pytest.mark.parametrize(
    ('options', 'problem'),
    [
        (('--days', '3'), '--days needs --fleet N'),
        (('--fault', 'T01:brake_scale:ratio=0.8:2'), '--fault needs --fleet N'),
        (('--fleet', '2', '--days', '0'), '--days = 0 must be >= 1'),
        (('--fleet', '2', '--effect', 'headwind:speed=3'), '--effect is of a single bag'),
        (('--fleet', '2', '--fault', 'T03:brake_scale:ratio=0.8:2'), 'the trains are T01 to T02'),
    ],
)
def test_wrong_options_leave_nothing_behind(
    tmp_path: Path, options: tuple[str, ...], problem: str, one_error: Callable[[], str]
) -> None:
    assert call(tmp_path / 'fleet', *options) == 2
    assert problem in one_error()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('options', [(), ('--fleet', '1', '--days', '1')], ids=['bag', 'fleet'])
def test_effects_on_runs_that_the_drive_does_not_have_are_named(
    tmp_path: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    path, text = tmp_path / 'T.yaml', dump_train_file(world_train(WORLDS['metro']))
    effect = '{name: mass_error, parameters: {ratio: 1.15}, runs: [1, 40, 41]}'
    path.write_text(text.replace('effects: []', f'effects: [{effect}]'), encoding='utf-8')
    assert call(tmp_path / 'out', '--train', str(path), *options) == 0
    assert capsys.readouterr().err == ('trainid: warning: effect mass_error: the drive has 1 run, not runs 40, 41\n')


@pytest.mark.long
def test_the_printed_commands_make_a_page_that_names_the_faults(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    faults = {'T02': 'wheel_diameter:ratio=1.02', 'T04': 'brake_scale:ratio=0.85'}
    given = [word for train, effect in faults.items() for word in ('--fault', f'{train}:{effect}:4')]
    assert call(tmp_path / 'fleet', '--fleet', '6', '--days', '6', '--json', *given) == 0
    for command in json.loads(capsys.readouterr().out)['next']:
        assert main(shlex.split(command)[1:]) == 0
    text = (tmp_path / 'fleet' / 'report.html').read_text(encoding='utf-8')
    for cause in ('wrong wheel diameter: measure the wheels', 'worn or glazed brake pads: check thickness'):
        assert cause in text
