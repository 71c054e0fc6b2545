# SPDX-License-Identifier: Apache-2.0
"""``trainid fleet`` and ``trainid fleet report`` through the command line: table, failures, resuming, report."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from shutil import copytree
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest

from test.fleet.surrogate import fleet_rows
from test.hang import HANG_S
from test.report.pages import no_layout
from trainid_ros.cli.main import main
from trainid_ros.explain.result import FoundEffect
from trainid_ros.fleet.table_file import Row, read_table, write_table
from trainid_ros.interface.errors import NoAnswerError

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.fleet.table_file import FleetRun


NAMES = ('T1/one', 'T1/two', 'T2/one', 'T2/two')


@pytest.fixture
def depot(driven_bag: Path, tmp_path: Path) -> Path:
    """Return a folder with bags of two trains and a broken one."""
    for name in NAMES:
        copytree(driven_bag, tmp_path / 'depot' / name)
    (tmp_path / 'depot/T2/broken.mcap').write_text('no bag', encoding='utf-8')
    return tmp_path / 'depot'


def fleet(depot: Path, *options: str, out: str = 't.csv') -> list[str]:
    train, table = depot / 'T1/one/train.yaml', depot.parent / out
    return ['fleet', str(depot), '--train', str(train), '--out', str(table), *options]


def replayed(capsys: pytest.CaptureFixture[str], command: list[str]) -> dict[str, Any]:
    """Return the summary of a run of fleet that succeeds."""
    capsys.readouterr()
    assert main([*command, '--json']) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def reported(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return what ``fleet report`` prints."""
    assert main(['fleet', 'report', *map(str, arguments)]) == 0
    return capsys.readouterr().out


def test_one_row_per_bag_and_failures_are_rows(depot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = replayed(capsys, fleet(depot, '--jobs', '2', out='t.parquet'))
    assert (shown['bags'], shown['known'], shown['errors'], shown['trains']) == (5, 0, 1, 2)
    rows, about = read_table(depot.parent / 't.parquet')
    assert [row['bag'] for row in rows] == sorted(str(depot / name) for name in (*NAMES, 'T2/broken.mcap'))
    assert [row['train'] for row in rows] == ['T1', 'T1', 'T2', 'T2', 'T2']
    assert [row['w15'] is None for row in rows] == [bool(row['error']) for row in rows]
    assert about['setup']['train'] == str(depot / 'T1/one/train.yaml')
    plan = json.loads((depot.parent / 't.parquet.plan.json').read_text(encoding='utf-8'))
    assert [bag['path'] for bag in plan['bags']] == [row['bag'] for row in rows]


def test_a_run_goes_on_where_another_was_killed(depot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = depot.parent / 't.csv.rows'
    with subprocess.Popen([sys.executable, '-m', 'trainid_ros.cli.main', *fleet(depot, '--jobs', '1')]) as process:
        while not any(rows.glob('*.json')):
            assert process.poll() is None
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
    done = len(list(rows.glob('*.json')))
    assert replayed(capsys, fleet(depot, '--jobs', '1'))['known'] == done < 4
    first = read_table(depot.parent / 't.csv')
    replayed(capsys, fleet(depot, '--jobs', '1', out='whole.csv'))
    assert first == read_table(depot.parent / 'whole.csv')


def test_what_has_changed_is_replayed_again(depot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = fleet(depot, '--jobs', '1')
    replayed(capsys, command)
    os.utime(next((depot / 'T1/one').glob('*.mcap')), ns=(0, 0))
    assert replayed(capsys, command)['known'] == 3
    train = depot / 'T1/one/train.yaml'
    train.write_text(train.read_text(encoding='utf-8') + '\n', encoding='utf-8')
    assert replayed(capsys, command)['known'] == 0


def test_a_bag_of_two_trains_has_a_row_of_each(
    driven_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = []
    for number in (1, 2):
        tables.append(str(tmp_path / f'{number}.csv'))
        command = ['fleet', str(driven_bag), '--train', str(driven_bag / 'train.yaml'), '--out', tables[-1]]
        main([*command, '--namespace', f'/train_{number}'])
    found: list[tuple[str, str]] = []

    def analyse(rows: list[Row], _: float) -> None:
        found.extend((row['bag'], row['train']) for row in rows)
        raise NoAnswerError

    monkeypatch.setattr('trainid_ros.fleet.analysis.analyse', analyse)
    assert main(['fleet', 'report', *tables, tables[0]]) == 1
    assert found == [(str(driven_bag), 'train_1'), (str(driven_bag), 'train_2')]


@pytest.mark.parametrize(
    ('options', 'problem'),
    [
        (('--label', 'x'), 'has no named group'),
        (('--map', 'none.yaml'), 'none.yaml: cannot be read'),
        (('--out', 't.xlsx'), 'ends with .parquet or .csv'),
        (('--scheduler', 'tcp://127.0.0.1:1'), '--scheduler tcp://127.0.0.1:1: cannot be reached'),
        (('--scheduler', 'bla'), '--scheduler bla: cannot be reached (an address is like tcp://host:8786)'),
    ],
)
def test_bad_usage_is_one_line(
    options: tuple[str, str], problem: str, depot: Path, one_error: Callable[[], str], monkeypatch: Any
) -> None:
    monkeypatch.setattr('trainid_ros.fleet.run_fleet.CONNECT_S', 0.2)
    assert main(fleet(depot, *options)) == 2
    assert problem in one_error()


def test_no_usable_bag_is_bad_input(depot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    only = [str(depot / 'T2/broken.mcap'), *fleet(depot)[2:]]
    assert main(['fleet', *only]) == 2
    assert 'broken.mcap: is not an MCAP file' in capsys.readouterr().err


@pytest.mark.parametrize(('name', 'problem'), [('t.csv', 't.csv: exists already'), ('t.csv.rows', 'File exists')])
def test_files_of_others_are_not_replaced(depot: Path, one_error: Callable[[], str], name: str, problem: str) -> None:
    own = depot.parent / name
    own.write_text('train,depot\n', encoding='utf-8')
    assert main(fleet(depot)) == 2
    assert str(own) in (error := one_error())
    assert problem in error
    assert own.read_text(encoding='utf-8') == 'train,depot\n'


def test_a_table_of_another_plan_is_not_replaced_unasked(depot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    replayed(capsys, fleet(depot, '--jobs', '1'))
    table = (depot.parent / 't.csv').read_bytes()
    fewer = ['fleet', str(depot / 'T1'), *fleet(depot, '--jobs', '1')[2:]]
    assert main(fewer) == 2
    lost = f'3 of its 5 bags are not given now, such as {depot}/T2/broken.mcap'
    assert f't.csv: is the table of another plan: {lost}' in capsys.readouterr().err
    assert main(fleet(depot, '--jobs', '1', '--namespace', '/train_2')) == 2
    assert 'it was made with another train file, mapping' in capsys.readouterr().err
    assert (depot.parent / 't.csv').read_bytes() == table
    copytree(depot / 'T1/one', depot / 'T1/three')
    assert replayed(capsys, fleet(depot, '--jobs', '1'))['known'] == 4  # more bags are no other plan
    assert replayed(capsys, [*fewer, '--replace'])['bags'] == 3


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_says_what_is_done(depot: Path, number: signal.Signals) -> None:
    rows = depot.parent / 't.csv.rows'
    for name in range(40):
        copytree(depot / 'T1/one', depot / f'T1/more_{name}')
    command = [sys.executable, '-m', 'trainid_ros.cli.main', *fleet(depot, '--jobs', '1')]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while not any(rows.glob('*.json')):
            assert process.poll() is None
            time.sleep(0.001)
        process.send_signal(number)
        _, errors = process.communicate()
    assert process.returncode == 128 + number
    done = len(read_table(depot.parent / 't.csv')[0])
    assert 0 < done < 45
    assert f'stopped: {done} of 45 bags are in {depot.parent}/t.csv; the same command goes on\n' in errors


def test_other_labels_replay_nothing(depot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    labels: tuple[tuple[str, ...], ...] = ((), ('--label', r'(?P<line>T\d)/(?P<train>\w+)'))
    assert [replayed(capsys, fleet(depot, '--jobs', '1', *label))['known'] for label in labels] == [0, 4]
    rows, _ = read_table(depot.parent / 't.csv')
    known = [row for row in rows if row['status']]
    assert [(row['line'], row['train']) for row in known] == [tuple(name.split('/')) for name in sorted(NAMES)]
    assert all(row['day'] for row in known)


def test_workers_end_with_a_killed_run(depot: Path) -> None:
    command = [sys.executable, '-m', 'trainid_ros.cli.main', *fleet(depot, '--jobs', '2')]
    with subprocess.Popen(command) as process:
        children = Path(f'/proc/{process.pid}/task/{process.pid}/children')
        while len(workers := children.read_text(encoding='utf-8').split()) < 3:  # with the tracker of resources
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    end = time.monotonic() + HANG_S
    while any(Path(f'/proc/{worker}/cmdline').exists() for worker in workers):
        assert time.monotonic() < end
        time.sleep(0.1)


class Explained(NamedTuple):
    effects: tuple[FoundEffect, ...] = ()


PADS = np.array([0.0, -0.08, 0.0, 0.0])


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / 't.csv'
    write_table(fleet_rows(1, 5, 12, {3: (6, PADS)}), path, {})
    return path


@no_layout()
def test_text_json_and_page_name_the_train(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = table.parent / 'report.html'
    text = reported(capsys, table, '--out', report)
    assert '1 of 5 trains stands out: T03.' in text
    assert 'Changed on 2026-03-07' in text
    assert 'worn or glazed brake pads' in text
    check = 'worn or glazed brake pads: check thickness and surface of the pads'
    assert f'In the depot: {check}' in text
    assert 'Not visible yet:\n  What began on 2026-03-12 or later: a change needs 2 days of data.' in text
    page = report.read_text(encoding='utf-8')
    assert page.count('<section>') == 5
    assert page.count('<h3>In the depot</h3>') == page.count(check) == 1
    # At the end of its line in each of the four channels.
    assert page.count('>T03</text>') == 4
    assert '<a href="#train-3">T03</a>' in page
    assert 'http' not in page.replace('http://www.w3.org', '')
    answer = json.loads(reported(capsys, table, '--json'))
    (found,) = answer['found']
    assert found['check'][0].startswith('check thickness')
    assert len(answer['not_visible']) == 1
    assert (found['train'], found['changes'][0]['day']) == ('T03', '2026-03-07')
    assert found['changes'][0]['steps']['brake_rate']['after'] < found['changes'][0]['steps']['brake_rate']['before']


def test_a_fault_that_has_ended_is_told_with_its_days(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 't.csv'
    write_table(fleet_rows(14, 5, 12, {3: (4, 1.5 * PADS)}, lasts=4), path, {})
    text = reported(capsys, path)
    assert 'Changed on 2026-03-05 until 2026-03-08, certain on 2026-03-06' in text
    assert 'By the channels alone: worn or glazed brake pads' in text


@pytest.mark.parametrize(('trains', 'few'), [(3, True), (4, False)])
def test_a_fleet_too_small_to_find_faults_in_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], trains: int, few: bool
) -> None:
    write_table(fleet_rows(5002, trains, 6), tmp_path / 't.csv', {})
    text = reported(capsys, tmp_path / 't.csv')
    assert ('the weather of a day cannot be told from a dragging brake' in text) is few


def test_bags_that_are_gone_are_no_answer(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = {'setup': {'train': 'bags/tiny/train.yaml', 'mapping': None, 'namespace': '/', 'max_chunk': 1 << 20}}
    table.with_name('t.csv.plan.json').write_text(json.dumps(plan), encoding='utf-8')
    assert 'By its bags: no answer (3/5: no such bag)' in reported(capsys, table, '--explain', '1')


def test_each_bag_is_explained_with_the_setup_of_its_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = fleet_rows(1, 5, 12, {3: (6, PADS)})
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
    text = reported(capsys, tmp_path / 'old.csv', tmp_path / 'new.csv', '--explain', 1)
    assert 'By its bags: no effect that is new' in text
    old, new = ('old.yaml', 'old.csv.map', '/old'), ('new.yaml', 'new.csv.map', '/new')
    assert used == [('3/5', *old), *((f'3/{day}', *new) for day in (6, 7, 8))]


def test_a_cause_in_the_bags_agrees_with_channels_that_name_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / 't.csv'
    write_table(fleet_rows(5001, 5, 12, {3: (6, np.array([0.0, -0.08, 0.12, 0.0]))}), table, {})
    drag = FoundEffect(
        'dragging_brake', 'drag', '', 'physics', (('force', 2.0),), (('force', 0.1),), 50.0, 7.0, 1.0, '', ()
    )
    effects: list[tuple[FoundEffect, ...]] = [(), *[(drag,)] * 3]  # of the bag before, and of three after
    monkeypatch.setattr('trainid_ros.fleet.analysis._explain', lambda _: Explained(effects.pop(0)))
    text = reported(capsys, table, '--explain', 1)
    assert 'By the channels alone: no single known cause (' in text
    assert 'By its bags, which tell apart what the channels do not: dragging_brake (drag) in 3 of 3' in text


def test_a_table_without_trains_is_no_answer_and_none_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ('none.parquet', 'none.csv'):
        assert main(['fleet', 'report', str(tmp_path / name)]) == 2
        assert f'{name}: cannot be read (No such file or directory)' in capsys.readouterr().err
    write_table([row | {'train': None} for row in fleet_rows(1, 3, 3)], tmp_path / 't.csv', {})
    assert main(['fleet', 'report', str(tmp_path / 't.csv')]) == 1
    assert 'too few days of trains to compare: ' in capsys.readouterr().err
