# SPDX-License-Identifier: Apache-2.0
"""Rows that are kept beside the table, and bags on the workers of a Dask scheduler."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.fleet.bag_row import bag_row
from trainid_ros.fleet.plan import Plan, PlannedBag, Setup, make_plan
from trainid_ros.fleet.run_fleet import TASK_BAGS, known_rows, rows_folder, rows_on_cluster, run_plan
from trainid_ros.fleet.table_file import Row, empty_row, read_table
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence
    from pathlib import Path

BROKEN = PlannedBag('none', error='none: no such bag')


def full_row(bag: PlannedBag) -> Row:
    return empty_row() | {'bag': bag.path, 'start': 1.7e9 + 0.1, 'status': 'VALID', 'w15': 0.1 + 0.2, 'finding': 'ä'}


def made_up(_: Plan, bags: Sequence[PlannedBag], __: Callable[[float], None]) -> Generator[tuple[int, Row], None, None]:
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
    path.rename(path.with_suffix('.json.part'))
    assert list(known_rows(plan, table)) == [plan.key(plan.bags[2])]
    path.with_suffix('.json.part').write_bytes(whole)
    path.with_suffix('.json.part').rename(path)
    assert len(known_rows(plan, table)) == 2


def test_a_stopped_run_leaves_its_rows_in_the_table(plan: Plan, table: Path) -> None:
    def stopped(
        plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]
    ) -> Generator[tuple[int, Row], None, None]:
        yield next(made_up(plan, bags, advance))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_plan(plan, table, {}, stopped, lambda _: None)
    assert [row['bag'] for row in read_table(table)[0]] == [plan.bags[0].path]
    assert list(known_rows(plan, table)) == [plan.key(plan.bags[0])]


def test_rows_that_exist_are_not_made_again(plan: Plan, table: Path) -> None:
    run_plan(plan, table, {}, made_up, lambda _: None)
    known = known_rows(plan, table)
    asked: list[PlannedBag] = []

    def noted(
        plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]
    ) -> Generator[tuple[int, Row], None, None]:
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
