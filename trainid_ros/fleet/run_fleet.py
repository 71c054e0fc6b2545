# SPDX-License-Identifier: Apache-2.0
"""Replay the bags of a plan that have no row yet, on this machine or on a cluster, and write the table.

Each bag is replayed as by ``trainid replay``; a failure is a row too.

Each row is kept in a file beside the table, named by the digest of all that determines it, for the next run.

On a cluster, bags are replayed by the workers of a Dask scheduler. These are processes with one thread each: the replay
is plain Python, and threads would only wait for each other. Bags and train file have the same paths on all machines.
"""

from __future__ import annotations

import json
import math
import re
import socket
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

from trainid_ros.bag.bag_replay import Pipelines, Replay, replay_through
from trainid_ros.bag.reader import BagReader, in_two
from trainid_ros.bag.worker_pool import each_bag, killed_message
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.fleet import table_file as files
from trainid_ros.fleet.table_file import Plan, PlannedBag, Row, Setup
from trainid_ros.inputs.mapped_inputs import MappedInputs, mapped_inputs
from trainid_ros.interface.errors import InputError, TrainIdError
from trainid_ros.interface.files import write_whole
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status, deviations
from trainid_ros.monitor.trains import resistance_at
from trainid_ros.setup.params_file import Setup as NodeSetup
from trainid_ros.setup.params_file import node_setups
from trainid_ros.train.train_file import load_train_file

Rows = Callable[[Plan, Sequence[PlannedBag], Callable[[float], None]], Generator[tuple[int, Row], None, None]]
"""Yields number and row of each bag as they come; calls the function with the number of bags done since."""


def bag_row(setup: Setup, revision: str, bag: PlannedBag, advance: Callable[[float], None]) -> Row:
    """Return the row of a bag; ``advance`` is called with the share done since its last call."""
    row = listed_row(bag, revision)
    if bag.error:
        advance(1.0)
        return row
    try:
        _replay(setup, bag, row, advance)
    except TrainIdError as error:
        row['error'] = str(error)
    except OSError as error:
        row['error'] = f'{error.filename or bag.path}: {error.strerror}'
    return row


def killed_row(revision: str, bag: PlannedBag) -> Row:
    """Return the row of a bag whose process was killed."""
    return listed_row(bag, revision) | {'error': killed_message(Path(bag.path))}


def listed_row(bag: PlannedBag, revision: str) -> Row:
    """Return what the list says of a bag."""
    row = files.empty_row() | {'bag': bag.path, 'start': bag.start_s, 'revision': revision}
    return row | labels_in_row(bag, bag.start_s) | {'error': bag.error or None}


def labels_in_row(bag: PlannedBag, start_s: float | None) -> Row:
    """Return the labels of a bag; ``start_s`` is the time of its first message [s], None if it is not known."""
    labels: Row = {name: getattr(bag, name) or None for name in files.LABELS}
    return labels | {'day': files.day_of(bag.day, start_s, Path(bag.path))}


@lru_cache(maxsize=1)
def prepared(setup: Setup) -> tuple[tuple[NodeSetup, ...], Callable[[], MappedInputs] | None]:
    """Return setups of the nodes and what makes the inputs, read once in each process; InputError if unusable."""
    train_file = load_train_file(setup.train)
    setups = node_setups(train_file, str(setup.train), setup.params, namespace=setup.namespace)
    return setups, mapped_inputs(setup.mapping, setups[0].train_file)


def _replay(setup: Setup, bag: PlannedBag, row: Row, advance: Callable[[float], None]) -> None:
    """Replay a bag and fill its row; InputError if it cannot be used."""
    setups, inputs = prepared(setup)
    opening, reading = in_two(advance)
    with BagReader(Path(bag.path), setup.namespace, setup.max_chunk, inputs, opening=opening) as reader:
        pipelines = Pipelines.of_nodes(setups, reader.mapping)
        before = _dead_time(pipelines)
        count = max(reader.input_count, 1)
        outcome = replay_through(pipelines, reader, lambda n: reading(n / count))
        span = reader.time_range()
    if row['start'] is None and span is not None:  # the bag has no index
        row['start'] = span[0] / NS_PER_S
        row |= labels_in_row(bag, row['start'])
    row |= {'duration_s': outcome.duration_s, 'warnings': '; '.join(reader.warnings) or None}
    row |= _resistance(outcome)
    for name in ('contradiction', 'finding'):
        row[name] = row[name] and reader.mapping.named(row[name])
    brake = outcome.brake_rate.output
    row |= {'brake_status': brake.status.name, 'brake_used': brake.used}
    if brake.used:
        row |= {'brake_rate': brake.estimate.brake_rate, 'brake_rate_std': brake.estimate.brake_rate_std}
    row['mass_factor'] = _known(outcome.speed_model.output.estimate.mass_factor)
    if before is not None and (learned := _dead_time(pipelines)) is not None and learned[1] < before[1]:
        row['dead_time'], row['dead_time_std'] = learned
    if outcome.wheel_ratio is not None:
        row['wheel_ratio'], row['wheel_ratio_std'] = outcome.wheel_ratio


def _resistance(outcome: Replay) -> Row:
    result = outcome.resistance
    w = result.output.estimate
    findings = outcome.findings
    outputs = max(1, sum(result.statuses))
    row: Row = {
        'status': result.output.status.name,
        'used': result.output.used,
        'rejected': result.output.rejected,
        'contradiction': outcome.contradiction.finding or None,
        'finding': '; '.join(findings) or None,
        **{files.reason_column(reason): count for reason, count in result.rejections},
        **{files.share_column(status): result.statuses[status] / outputs for status in Status},
    }
    if reason := outcome.why_no_resistance():
        return row | {'error': reason}
    row |= {name: getattr(w, name) for name in ('a', 'b', 'c', 'speed_min', 'speed_max')}
    row |= {f'{name}_std': std for name, std in zip('abc', deviations(w.covariance), strict=True)}
    for v in files.SPEEDS:
        row[f'w{v}'], row[f'w{v}_std'] = resistance_at(w, v)
    for name in ('force_scale', 'force_scale_std', 'force_delay', 'force_delay_std'):
        row[name] = _known(getattr(w, name))
    return row


def _dead_time(pipelines: Pipelines) -> tuple[float, float] | None:
    """Return dead time of the brake and its standard deviation [s], None of an estimator that does not have them."""
    estimator = pipelines.brake_rate.estimator
    if not isinstance(estimator, BrakeRateEstimator):
        return None
    return estimator.state.timing.delay, estimator.state.timing.delay_std


def _known(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


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
        key = plan.key(bag)
        try:
            row = files.empty_row() | json.loads((rows_folder(table) / f'{key}.json').read_text(encoding='utf-8'))
        except (FileNotFoundError, ValueError):  # a loss of power may leave anything
            continue
        rows[key] = row | labels_in_row(bag, row['start'])
    return rows


def run_plan(plan: Plan, table: Path, known: dict[str, Row], rows: Rows, advance: Callable[[float], None]) -> list[Row]:
    """Write the table of a plan and return its rows, in the order of the plan; InputError if a file cannot be written.

    Whatever ends the work, such as Ctrl-C, the table holds the rows that are there. ``known`` are rows of earlier runs
    by key; ``advance`` is called with the number of bags done since its last call.
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
                    text = json.dumps(row, allow_nan=False)
                    write = partial(Path.write_text, data=text, encoding='utf-8')
                    write_whole(rows_folder(table) / f'{key}.json', write)
    finally:
        written = [done[key] for key in keys if key in done]
        files.write_table(written, table, plan.to_json() | {'bags': len(plan.bags)})
    return written


def rows_here(
    jobs: int, plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]
) -> Generator[tuple[int, Row], None, None]:
    """Replay bags in a number of processes of this machine."""
    work, killed = partial(bag_row, plan.setup, plan.revision), partial(killed_row, plan.revision)
    return each_bag(work, bags, jobs, advance, killed)


@contextmanager
def rows_on_cluster(address: str) -> Iterator[Rows]:
    """Connect to a scheduler and yield what replays bags there; InputError if that is of no use.

    It may not be there, have no workers, or workers with several threads.
    """
    from distributed import Client  # noqa: PLC0415 - optional

    try:
        _check_address(address)  # a client goes on trying after its time, and says so at length
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except Exception as error:  # what is not a scheduler may answer anything
        raise InputError(f'--scheduler {address}: cannot be reached ({" ".join(str(error).split())[:200]})') from None
    with client:
        workers = client.scheduler_info(n_workers=-1)['workers']
        start = f'dask worker {address} --nthreads 1 --nworkers auto'
        if not workers:
            raise InputError(f'--scheduler {address}: has no workers; start some: {start}')
        for name, worker in workers.items():
            if worker['nthreads'] > 1:
                has = f'worker {name} has {worker["nthreads"]} threads'
                raise InputError(f'--scheduler {address}: {has}; start it with --nthreads 1')
        yield partial(_rows, client)


def _check_address(address: str) -> None:
    """Raise OSError or ValueError if nothing listens at an address."""
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise ValueError('an address is like tcp://host:8786')
    socket.create_connection((match['host'].strip('[]'), int(match['port'])), CONNECT_S).close()


def _rows(
    client: Any, plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]
) -> Generator[tuple[int, Row], None, None]:
    """Yield number and row of each bag, task by task as they end."""
    from distributed import as_completed  # noqa: PLC0415

    futures = {}
    for first in range(0, len(bags), TASK_BAGS):
        task = bags[first : first + TASK_BAGS]
        futures[client.submit(_task_rows, plan.setup, plan.revision, task, pure=False)] = first, task
    for future in as_completed(list(futures), loop=client.loop):
        first, task = futures.pop(future)
        if future.status == 'finished':
            rows: list[Row] = future.result()
        else:  # its worker was killed, and those that tried again
            rows = [killed_row(plan.revision, bag) for bag in task]
        advance(len(task))
        yield from enumerate(rows, first)


def _task_rows(setup: Setup, revision: str, bags: Sequence[PlannedBag]) -> list[Row]:
    return [bag_row(setup, revision, bag, lambda _: None) for bag in bags]
