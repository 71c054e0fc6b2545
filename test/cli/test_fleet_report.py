# SPDX-License-Identifier: Apache-2.0
"""``trainid fleet report`` through the command line."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

from test.fleet.surrogate import fleet_rows
from trainid_ros.cli.main import main
from trainid_ros.explain.result import FoundEffect
from trainid_ros.fleet.table_file import write_table

if TYPE_CHECKING:
    from pathlib import Path

    from trainid_ros.fleet.plan import FleetRun


class Explained(NamedTuple):
    effects: tuple[FoundEffect, ...] = ()


PADS = np.array([0.0, -0.08, 0.0, 0.0])


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / 't.csv'
    write_table(fleet_rows(1, 8, 12, {3: (6, PADS)}), path, {})
    return path


def test_text_json_and_page_name_the_train(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = table.parent / 'report.html'
    assert main(['fleet', 'report', str(table), '--out', str(report)]) == 0
    text = capsys.readouterr().out
    assert '1 of 8 trains stands out: T03.' in text
    assert 'Changed on 2026-03-07' in text
    assert 'worn or glazed brake pads' in text
    page = report.read_text(encoding='utf-8')
    assert page.count('<section>') == 8
    assert '<a href="#train-3">T03</a>' in page
    assert 'http' not in page.replace('http://www.w3.org', '')
    assert main(['fleet', 'report', str(table), '--json']) == 0
    (found,) = json.loads(capsys.readouterr().out)['found']
    assert (found['train'], found['changes'][0]['day']) == ('T03', '2026-03-07')
    assert found['changes'][0]['steps']['brake_rate']['after'] < found['changes'][0]['steps']['brake_rate']['before']


def test_a_fault_that_has_ended_is_told_with_its_days(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 't.csv'
    write_table(fleet_rows(14, 8, 12, {3: (4, 1.5 * PADS)}, lasts=4), path, {})
    assert main(['fleet', 'report', str(path)]) == 0
    text = capsys.readouterr().out
    assert 'Changed on 2026-03-05 until 2026-03-08, certain on 2026-03-06' in text
    assert 'By the channels alone: worn or glazed brake pads' in text


@pytest.mark.parametrize(('trains', 'few'), [(3, True), (4, False)])
def test_a_fleet_too_small_to_find_faults_in_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], trains: int, few: bool
) -> None:
    write_table(fleet_rows(5002, trains, 6), tmp_path / 't.csv', {})
    assert main(['fleet', 'report', str(tmp_path / 't.csv')]) == 0
    assert ('the weather of a day cannot be told from a dragging brake' in capsys.readouterr().out) is few


def test_bags_that_are_gone_are_no_answer(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = {'setup': {'train': 'bags/tiny/train.yaml', 'mapping': None, 'namespace': '/', 'max_chunk': 1 << 20}}
    table.with_name('t.csv.plan.json').write_text(json.dumps(plan), encoding='utf-8')
    assert main(['fleet', 'report', str(table), '--explain', '1']) == 0
    assert 'By its bags: no answer (3/5: no such bag)' in capsys.readouterr().out


def test_each_bag_is_explained_with_the_setup_of_its_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = fleet_rows(1, 8, 12, {3: (6, PADS)})
    for name, days in (('old.csv', range(6)), ('new.csv', range(6, 12))):
        write_table([row for row in rows if int(row['bag'].partition('/')[2]) in days], tmp_path / name, {})
        files = {'train': str(tmp_path / name.replace('csv', 'yaml')), 'mapping': f'{name}.map'}
        plan = {'setup': {**files, 'namespace': f'/{name[:3]}', 'max_chunk': 1 << 20}}
        (tmp_path / f'{name}.plan.json').write_text(json.dumps(plan), encoding='utf-8')
    used = []

    def explain(run: FleetRun) -> Explained:
        assert run.setup is not None
        used.append((run.row['bag'], run.setup.train.name, str(run.setup.mapping), run.setup.namespace))
        return Explained()

    monkeypatch.setattr('trainid_ros.fleet.analysis._explain', explain)
    assert main(['fleet', 'report', str(tmp_path / 'old.csv'), str(tmp_path / 'new.csv'), '--explain', '1']) == 0
    assert 'By its bags: no effect that is new' in capsys.readouterr().out
    old, new = ('old.yaml', 'old.csv.map', '/old'), ('new.yaml', 'new.csv.map', '/new')
    assert used == [('3/5', *old), *((f'3/{day}', *new) for day in (6, 7, 8))]


def test_a_cause_in_the_bags_agrees_with_channels_that_name_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / 't.csv'
    write_table(fleet_rows(5001, 8, 12, {3: (6, np.array([0.0, -0.08, 0.12, 0.0]))}), table, {})
    drag = FoundEffect('dragging_brake', 'drag', '', 'physics', (('force', 2.0),), (('force', 0.1),), 50.0, '', ())
    effects: list[tuple[FoundEffect, ...]] = [(), *[(drag,)] * 3]  # of the bag before, and of three after
    monkeypatch.setattr('trainid_ros.fleet.analysis._explain', lambda _: Explained(effects.pop(0)))
    assert main(['fleet', 'report', str(table), '--explain', '1']) == 0
    text = capsys.readouterr().out
    assert 'By the channels alone: no single known cause (' in text
    assert 'By its bags, which tell apart what the channels do not: dragging_brake (drag) in 3 of 3' in text


@pytest.mark.parametrize('name', ['none.parquet', 'none.csv'])
def test_a_table_that_is_not_there_is_an_error(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['fleet', 'report', str(tmp_path / name)]) == 2
    assert f'{name}: cannot be read (No such file or directory)' in capsys.readouterr().err


def test_a_table_without_trains_is_no_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_table([row | {'train': None} for row in fleet_rows(1, 3, 3)], tmp_path / 't.csv', {})
    assert main(['fleet', 'report', str(tmp_path / 't.csv')]) == 1
    assert 'too few days of trains to compare: ' in capsys.readouterr().err
