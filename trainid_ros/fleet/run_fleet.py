# SPDX-License-Identifier: Apache-2.0
"""Replay the bags of a plan that have no row yet, on this machine or on a cluster, and write the table.

Each row is kept in a file beside the table, whose name is the digest of all that determines it. A run that was stopped
or killed is repeated: the rows that exist are taken.

On a cluster, bags are replayed by the workers of a Dask scheduler. These are processes with one thread each: the replay
is plain Python, and threads would only wait for each other. Bags and train file have the same paths on all machines.
"""

from __future__ import annotations

import json
import re
import socket
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.worker_pool import each_bag
from trainid_ros.fleet.bag_row import bag_row, killed_row, labels_in_row
from trainid_ros.fleet.table_file import empty_row, write_table
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence
    from pathlib import Path

    from trainid_ros.fleet.plan import Plan, PlannedBag, Setup
    from trainid_ros.fleet.table_file import Row

    Rows = Callable[[Plan, Sequence[PlannedBag], Callable[[float], None]], Generator[tuple[int, Row], None, None]]
    """Yields number and row of each bag as they come; calls the function with the number of bags done since."""

TASK_BAGS: Final = 20
"""Bags of a task: together they take seconds, beside which the milliseconds of the scheduler do not count."""
CONNECT_S: Final = 8.0
"""Time for a scheduler to answer [s]."""
_ADDRESS: Final = re.compile(r'(?:(?:tcp|tls)://)?(?P<host>[^:/]+|\[[0-9a-fA-F:]+\]):(?P<port>\d{1,5})/?')


def rows_folder(table: Path) -> Path:
    """Return the folder with the rows of a table as they come, each in a file named by the key of its bag."""
    return table.with_name(f'{table.name}.rows')


def known_rows(plan: Plan, table: Path) -> dict[str, Row]:
    """Return the rows of earlier runs by key: of bags that are still the same, replayed in the same way.

    They get the labels of the plan, which may be others than before. A bag that could not be replayed is tried again.
    """
    rows: dict[str, Row] = {}
    for bag in plan.bags:
        path = _row_file(table, plan.key(bag))
        try:
            row = empty_row() | json.loads(path.read_text(encoding='utf-8'))
        except (FileNotFoundError, ValueError):  # a loss of power may leave anything
            continue
        rows[path.stem] = row | labels_in_row(bag, row['start'])
    return rows


def _row_file(table: Path, key: str) -> Path:
    return rows_folder(table) / f'{key}.json'


def run_plan(plan: Plan, table: Path, known: dict[str, Row], rows: Rows, advance: Callable[[float], None]) -> list[Row]:
    """Write the table of a plan and return its rows, in the order of the plan.

    Whatever ends the work, such as Ctrl-C, the table holds the rows that are there.

    Args:
        plan: The plan.
        table: The table.
        known: Rows of earlier runs by key.
        rows: What replays bags.
        advance: Called with the number of bags done since its last call.

    Raises:
        InputError: A file cannot be written.
    """
    keys = [plan.key(bag) for bag in plan.bags]
    left = [(key, bag) for key, bag in zip(keys, plan.bags, strict=True) if key not in known]
    done = dict(known)
    try:
        with closing(rows(plan, [bag for _, bag in left], advance)) as found:
            for number, row in found:
                key, _ = left[number]
                done[key] = row  # first: a row with a file is in the table, wherever a signal ends this
                if row['status']:
                    _keep(row, _row_file(table, key))
    finally:
        written = [done[key] for key in keys if key in done]
        write_table(written, table, plan.to_json() | {'bags': len(plan.bags)})
    return written


def _keep(row: Row, path: Path) -> None:
    write_whole(path, lambda part: part.write_text(json.dumps(row, allow_nan=False), encoding='utf-8'))


def rows_here(jobs: int) -> Rows:
    """Return what replays bags in processes of this machine."""

    def rows(
        plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]
    ) -> Generator[tuple[int, Row], None, None]:
        work, killed = partial(bag_row, plan.setup, plan.revision), partial(killed_row, plan.revision)
        return each_bag(work, bags, jobs, advance, killed)

    return rows


@contextmanager
def rows_on_cluster(address: str) -> Iterator[Rows]:
    """Connect to a scheduler; yield what replays bags there.

    Raises:
        InputError: There is none, it has no workers, or workers with several threads.
    """
    from distributed import Client  # noqa: PLC0415 - optional

    try:
        _check_address(address)  # a client goes on trying after its time, and says so at length
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except Exception as error:  # what is not a scheduler may answer anything
        raise InputError(f'--scheduler {address}: cannot be reached ({" ".join(str(error).split())[:200]})') from None
    with client:
        _check_workers(client, address)
        yield lambda plan, bags, advance: _rows(client, plan, bags, advance)


def _check_address(address: str) -> None:
    """Raise OSError or ValueError if nothing listens at an address."""
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise ValueError('an address is like tcp://host:8786')
    socket.create_connection((match['host'].strip('[]'), int(match['port'])), CONNECT_S).close()


def _check_workers(client: Any, address: str) -> None:
    workers = client.scheduler_info(n_workers=-1)['workers']
    if not workers:
        raise InputError(
            f'--scheduler {address}: has no workers; start some: dask worker {address} --nthreads 1 --nworkers auto'
        )
    for name, worker in workers.items():
        if worker['nthreads'] > 1:
            raise InputError(
                f'--scheduler {address}: worker {name} has {worker["nthreads"]} threads; start it with --nthreads 1'
            )


def _rows(
    client: Any, plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]
) -> Generator[tuple[int, Row], None, None]:
    """Yield number and row of each bag, task by task as they end."""
    from distributed import as_completed  # noqa: PLC0415

    items = list(enumerate(bags))
    tasks = [items[first : first + TASK_BAGS] for first in range(0, len(items), TASK_BAGS)]
    futures = {
        client.submit(task_rows, plan.setup, plan.revision, [bag for _, bag in task], pure=False): task
        for task in tasks
    }
    for future in as_completed(list(futures), loop=client.loop):
        task = futures.pop(future)
        if future.status == 'finished':
            rows: list[Row] = future.result()
        else:  # its worker was killed, and those that tried again
            rows = [killed_row(plan.revision, bag) for _, bag in task]
        advance(len(task))
        yield from zip([number for number, _ in task], rows, strict=True)


def task_rows(setup: Setup, revision: str, bags: Sequence[PlannedBag]) -> list[Row]:
    """Return the rows of the bags of one task."""
    return [bag_row(setup, revision, bag, lambda _: None) for bag in bags]
