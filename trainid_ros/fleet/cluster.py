# SPDX-License-Identifier: Apache-2.0
"""Replay the bags of a fleet on the workers of a Dask scheduler.

Workers are processes with one thread each: the replay is plain Python, and threads would only wait for each other. Bags
and train file have the same paths on all machines.
"""

from __future__ import annotations

import re
import socket
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.errors import InputError
from trainid_ros.fleet.bag_row import bag_row, killed_row

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence

    from trainid_ros.fleet.columns import Row
    from trainid_ros.fleet.plan import Plan, PlannedBag, Setup
    from trainid_ros.fleet.run_fleet import Rows

TASK_BAGS: Final = 20
"""Bags of a task: together they take seconds, beside which the milliseconds of the scheduler do not count."""
CONNECT_S: Final = 8.0
_ADDRESS: Final = re.compile(r'(?:(?:tcp|tls)://)?(?P<host>[^:/]+|\[[0-9a-fA-F:]+\]):(?P<port>\d{1,5})/?')


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
        msg = f'--scheduler {address}: cannot be reached ({" ".join(str(error).split())[:200]})'
        raise InputError(msg) from None
    with client:
        _check_workers(client, address)
        yield lambda plan, bags, advance: _rows(client, plan, bags, advance)


def _check_address(address: str) -> None:
    """Raise OSError or ValueError if nothing listens at an address."""
    match = _ADDRESS.fullmatch(address)
    if match is None:
        msg = 'an address is like tcp://host:8786'
        raise ValueError(msg)
    socket.create_connection((match['host'].strip('[]'), int(match['port'])), CONNECT_S).close()


def _check_workers(client: Any, address: str) -> None:
    workers = client.scheduler_info(n_workers=-1)['workers']
    if not workers:
        msg = f'--scheduler {address}: has no workers; start some: dask worker {address} --nthreads 1 --nworkers auto'
        raise InputError(msg)
    for name, worker in workers.items():
        if worker['nthreads'] > 1:
            msg = f'--scheduler {address}: worker {name} has {worker["nthreads"]} threads; start it with --nthreads 1'
            raise InputError(msg)


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
