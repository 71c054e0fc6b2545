# SPDX-License-Identifier: Apache-2.0
"""A row holds what ``trainid replay`` prints; rows are kept, and made on a cluster too."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.cli.main import main
from trainid_ros.fleet.mixed_model import has_estimate, is_known
from trainid_ros.fleet.run_fleet import (
    TASK_BAGS,
    bag_row,
    killed_row,
    known_rows,
    rows_folder,
    rows_on_cluster,
    run_plan,
)
from trainid_ros.fleet.table_file import COLUMNS, NAMES, Plan, PlannedBag, Row, Setup, empty_row, make_plan
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.results import Status
from trainid_ros.train.train_file import dump_train_file, load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence
    from pathlib import Path

    Rows = Generator[tuple[int, Row], None, None]

KINDS = {'text': str, 'float': float, 'int': int, 'time': float}


def test_numbers_are_those_of_replay(tiny: Path, setup: Setup, capsys: pytest.CaptureFixture[str]) -> None:
    done: list[float] = []
    bag = PlannedBag(str(tiny), start_s=1.0, train='T1', day='2026-01-31')
    row = bag_row(setup, 'r1', bag, done.append)
    assert sum(done) == pytest.approx(1.0)
    assert main(['replay', str(tiny), '--train', str(setup.train), '--json']) == 0
    shown = json.loads(capsys.readouterr().out)
    w = shown['resistance']
    assert [row[name] for name in 'abc'] == [w[name] for name in 'abc']
    assert [row[f'{name}_std'] for name in 'abc'] == w['std']
    assert row['w15'] == w['a'] + w['b'] * 15 + w['c'] * 225
    assert (row['brake_rate'], row['brake_rate_std']) == (shown['brake_rate']['value'], shown['brake_rate']['std'])
    assert {'value': row['wheel_ratio'], 'std': row['wheel_ratio_std']} == shown['wheel_ratio']
    assert (row['used'], row['status'], row['duration_s']) == (shown['used'], w['status'], shown['duration_s'])
    assert {name: row[f'rejected_{name.lower()}'] for name in shown['rejected']} == shown['rejected']
    assert row['rejected'] == sum(shown['rejected'].values())
    assert sum(row[f'share_{status.name.lower()}'] for status in Status) == pytest.approx(1.0)
    assert row['share_valid'] > 0.0
    assert (row['train'], row['day'], row['line'], row['revision']) == ('T1', '2026-01-31', None, 'r1')
    assert tuple(row) == NAMES
    for column in COLUMNS:
        assert row[column.name] is None or type(row[column.name]) is KINDS[column.kind], column.name


def test_a_force_that_counts_twice_is_a_contradiction(tiny: Path, setup: Setup, tmp_path: Path) -> None:
    mapping = tmp_path / 'map.yaml'
    mapping.write_text('force: {topic: ato/force, field: force, gain: 2.0}\n', encoding='utf-8')
    wrong, right = (
        bag_row(replace(setup, mapping=path), 'r1', PlannedBag(str(tiny), train='T1', day='2026-01-31'), lambda _: None)
        for path in (mapping, None)
    )
    assert 'ato/force, ato/mass or train.mass is off: the train follows 0.5 times the force' in wrong['contradiction']
    assert (is_known(wrong), has_estimate(wrong)) == (False, True)
    assert (right['contradiction'], is_known(right)) == (None, True)


def test_a_dead_time_is_that_of_the_train(tiny: Path, setup: Setup, tmp_path: Path) -> None:
    true = load_train_file(setup.train)
    found = []
    for name, delay, timing_std in (('late', 0.68, 0.12), ('soon', 0.52, 0.12), ('exact', 0.68, 0.0)):
        train = tmp_path / f'{name}.yaml'
        stated = replace(true.brake, delay=delay, timing_std=timing_std)
        train.write_text(dump_train_file(replace(true, brake=stated)), encoding='utf-8')
        row = bag_row(replace(setup, train=train), 'r1', PlannedBag(str(tiny)), lambda _: None)
        found.append((row['dead_time'], row['dead_time_std']))
    for value, std in found[:2]:
        assert std < 0.04  # stated were 0.08 s
        assert abs(value - true.brake.delay) < 3.0 * std
    assert found[2] == (None, None)


def test_failures_are_rows(tmp_path: Path, setup: Setup) -> None:
    bag = PlannedBag(str(tmp_path / 'none'), train='T1')
    row = bag_row(setup, 'r1', bag, lambda _: None)
    assert (row['train'], row['status'], row['error']) == ('T1', None, f'{bag.path}: no such bag')
    assert bag_row(setup, 'r1', replace(bag, error='is empty'), lambda _: None)['error'] == 'is empty'
    assert 'killed' in killed_row('r1', bag)['error']


BROKEN = PlannedBag('none', error='none: no such bag')


def full_row(bag: PlannedBag) -> Row:
    return empty_row() | {'bag': bag.path, 'start': 1.7e9 + 0.1, 'status': 'VALID', 'w15': 0.1 + 0.2, 'finding': 'ä'}


def made_up(_: Plan, bags: Sequence[PlannedBag], __: Callable[[float], None]) -> Rows:
    """Yield rows with numbers, of a broken bag without."""
    yield from ((k, full_row(bag) | ({'status': None} if bag.error else {})) for k, bag in enumerate(bags))


@pytest.fixture
def table(tmp_path: Path) -> Path:
    rows_folder(tmp_path / 't.csv').mkdir()
    return tmp_path / 't.csv'


@pytest.fixture
def plan(setup: Setup) -> Plan:
    return make_plan(setup, (PlannedBag('/depot/T1/night'), BROKEN, PlannedBag('/depot/T2/night')))


def test_rows_are_kept_by_bag_and_failures_are_tried_again(plan: Plan, table: Path) -> None:
    assert known_rows(plan, table) == {}
    written = run_plan(plan, table, {}, made_up, lambda _: None)
    first, broken, second = plan.bags  # bags of equal names are not taken for each other
    kept = known_rows(plan, table)
    assert kept == {plan.key(bag): full_row(bag) | {'day': '2023-11-14'} for bag in (first, second)}
    assert [row['bag'] for row in written] == [bag.path for bag in (first, broken, second)]
    other = replace(plan, revision='another')
    assert known_rows(other, table) == {}


def test_what_a_kill_or_a_loss_of_power_leaves_is_no_row(plan: Plan, table: Path) -> None:
    run_plan(plan, table, {}, made_up, lambda _: None)
    path = rows_folder(table) / f'{plan.key(plan.bags[0])}.json'
    whole = path.read_bytes()
    damaged = [*(whole[:end] for end in range(len(whole))), bytes(len(whole)), b'\xff', b'']
    for content in damaged:
        path.write_bytes(content)
        assert list(known_rows(plan, table)) == [plan.key(plan.bags[2])]
    part = path.rename(path.with_suffix('.json.part'))
    assert list(known_rows(plan, table)) == [plan.key(plan.bags[2])]
    part.write_bytes(whole)
    part.rename(path)
    assert len(known_rows(plan, table)) == 2


def test_rows_that_exist_are_not_made_again(plan: Plan, table: Path) -> None:
    run_plan(plan, table, {}, made_up, lambda _: None)
    known = known_rows(plan, table)
    asked: list[PlannedBag] = []

    def noted(plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]) -> Rows:
        asked.extend(bags)
        return made_up(plan, bags, advance)

    run_plan(plan, table, known, noted, lambda _: None)
    assert asked == [BROKEN]


@pytest.fixture
def cluster(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Return a cluster in this process, with threads for workers: it starts fast."""
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=request.param, processes=False, dashboard_address=None, protocol='tcp'
    ) as found:
        yield found


@pytest.mark.parametrize('cluster', [1], indirect=True)
def test_rows_are_those_of_this_machine(cluster: Any, tiny: Path, setup: Setup) -> None:
    bags = (PlannedBag(str(tiny), start_s=1.0, train='T1'), *[BROKEN] * TASK_BAGS)
    plan, done = make_plan(setup, bags), list[float]()
    with rows_on_cluster(cluster.scheduler_address) as rows:
        found = dict(rows(plan, bags, done.append))
    assert sorted(done) == [1, TASK_BAGS]
    assert found == {number: bag_row(setup, plan.revision, bag, lambda _: None) for number, bag in enumerate(bags)}


@pytest.mark.parametrize('cluster', [2], indirect=True)
def test_workers_with_threads_are_refused(cluster: Any) -> None:
    with (
        pytest.raises(InputError, match='has 2 threads; start it with --nthreads 1'),
        rows_on_cluster(cluster.scheduler_address),
    ):
        pass
