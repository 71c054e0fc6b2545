# SPDX-License-Identifier: Apache-2.0
"""A fleet from bags to report: cost of a bag, memory of a worker, and which broken trains are found.

Bags are simulated drives of ten minutes, one a day and train (benchmarks/fleet_bags.py). They are replayed by ``trainid
fleet`` in one process, by two workers, and by two workers of Dask; then ``trainid fleet report`` looks for the broken
trains among them. Many more fleets are made of rows instead of bags (benchmarks/fleet_rows.py).
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.days import REPOSITORY
from benchmarks.fleet_bags import FAULTS, Fault, draw_day, draw_train, drive, stated_train, write_bag
from benchmarks.fleet_processes import Cost, cluster, measure_command
from benchmarks.fleet_rows import detection_tables
from benchmarks.tables import Table
from trainid_ros.fleet.table_file import read_table
from trainid_ros.train.train_file import dump_train_file

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.fleet.table_file import Row

# Seeds from here on were not used in development.
FIRST_SEED: Final = 8_800
_FULL_SEEDS: Final = 60
_TRAINS, _DAYS, _RUNS = 50, 20, 4
_LABEL: Final = r'(?P<train>T\d+)/[^/]+$'
_WORKERS: Final = 2


@dataclass(frozen=True, slots=True)
class World:
    """Trains, days and broken trains (by number) of the bags."""

    seed: int
    trains: int
    days: int
    faults: dict[int, Fault]


def measure(seeds: int) -> tuple[Table, ...]:
    """Make the bags, replay them in three ways, and look for the broken trains; fewer seeds make fewer bags."""
    world = draw_world(FIRST_SEED, max(8, min(_TRAINS, _TRAINS * seeds // _FULL_SEEDS)))
    with tempfile.TemporaryDirectory(dir=os.environ.get('TRAINID_BENCH_DIR')) as name:
        folder = Path(name)
        make_bags(world, folder)
        costs, rows = replay_three_ways(folder)
        found = _report(folder)
    return (cost_table(costs, len(rows)), memory_table(costs), found_table(world, found), *detection_tables(seeds))


def draw_world(seed: int, trains: int) -> World:
    """Return a fleet in which one train in 16 breaks, each in another way, on a day in the middle."""
    rng = np.random.default_rng((seed, 0))
    kinds, broken = rng.permutation(FAULTS), rng.permutation(trains)[: max(1, trains // 16)]
    faults = {
        int(number): Fault(str(kinds[k % len(kinds)]), float(rng.random()), int(rng.integers(6, _DAYS - 4)))
        for k, number in enumerate(broken)
    }
    return World(seed, trains, _DAYS, faults)


def make_bags(world: World, folder: Path) -> None:
    """Simulate all drives."""
    (folder / 'train.yaml').write_text(dump_train_file(stated_train()), encoding='utf-8')
    with ProcessPoolExecutor(_WORKERS, mp_context=get_context('spawn')) as pool:
        for future in [pool.submit(_make_train, world, number, folder) for number in range(world.trains)]:
            future.result()


def _make_train(world: World, number: int, folder: Path) -> None:
    train, fault = draw_train(world.seed, number), world.faults.get(number)
    place = folder / 'bags' / f'T{number:02d}'
    place.mkdir(parents=True)
    for day in (draw_day(world.seed, k) for k in range(world.days)):
        broken = fault if fault is not None and day.number >= fault.onset else None
        write_bag(place / f'day{day.number:02d}', drive(world.seed, train, day, broken, _RUNS))


def replay_three_ways(folder: Path) -> tuple[dict[str, Cost], list[Row]]:
    """Return cost by way, and the rows, which are the same in all."""
    costs = {
        'one process': measure_command(_fleet(folder, 'one', '--jobs', '1')),
        'pool of 2 workers': measure_command(_fleet(folder, 'pool', '--jobs', str(_WORKERS))),
    }
    tables = [read_table(folder / f'{name}.parquet')[0] for name in ('one', 'pool')]
    if shutil.which('dask') or (Path(sys.executable).parent / 'dask').exists():
        with cluster(_WORKERS) as (address, processes):
            command = _fleet(folder, 'dask', '--scheduler', address)
            costs['Dask, 2 workers'] = measure_command(command, processes)
        tables.append(read_table(folder / 'dask.parquet')[0])
    if any(table != tables[0] for table in tables):
        raise RuntimeError('the ways of replaying give different rows')
    return costs, tables[0]


def _fleet(folder: Path, name: str, *options: str) -> list[str]:
    paths = (str(folder / 'bags'), '--train', str(folder / 'train.yaml'), '--out', str(folder / f'{name}.parquet'))
    return [sys.executable, '-m', 'trainid_ros.cli.main', 'fleet', *paths, '--label', _LABEL, *options]


def _report(folder: Path) -> dict[str, Any]:
    command = [sys.executable, '-m', 'trainid_ros.cli.main', 'fleet', 'report', str(folder / 'one.parquet')]
    command += ['--json', '--explain', '4', '--out', str(folder / 'report.html')]
    answer = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(answer.stdout)
    return found


def cost_table(costs: dict[str, Cost], bags: int) -> Table:
    """Return CPU time a bag of each way, and its ratio to one process."""
    one = costs['one process'].cpu_s
    limits = {'one process': '', 'pool of 2 workers': '1.1', 'Dask, 2 workers': '1.35'}
    rows = tuple(
        (name, f'{cost.cpu_s / bags:.3f}', f'{cost.cpu_s / one:.2f}', limits[name], f'{cost.wall_s:.0f}')
        for name, cost in costs.items()
    )
    note = (
        f'User and system time of all processes, start and listing included; {bags} bags of about 11 min, written one '
        'by one. For Dask scheduler and workers count from when the command starts. All rows are equal to the bit.'
    )
    return Table(f'CPU time of {bags} bags', ('', 'CPU s a bag', 'ratio', 'wanted', 'wall s'), rows, note)


def memory_table(costs: dict[str, Cost]) -> Table:
    """Return the private memory of the workers."""
    rows = tuple(
        (name, f'{cost.memory_early_mb:.1f}', f'{cost.memory_late_mb:.1f}', f'{cost.memory_most_mb:.1f}')
        for name, cost in costs.items()
        if name != 'one process'
    )
    header = ('private memory of a worker, MB', 'after a fifth of the time', 'at the end', 'most')
    return Table('Memory of a worker', header, rows, 'The largest worker; smaps_rollup, twice a second. Wanted: 60.')


def found_table(world: World, found: dict[str, Any]) -> Table:
    """Return what became of each broken train, and how many others were named."""
    days, by_name = found['days'], {item['train']: item for item in found['found']}
    rows = [_found_row(number, fault, by_name.pop(f'T{number:02d}', None), days) for number, fault in _sorted(world)]
    rows.append(('others named', ', '.join(by_name) or 'none', '', '', '', ''))
    note = (
        f'Real bags of {world.trains} trains on {world.days} days through the commands; rain, wind and temperature hit '
        'all trains of a day. Certain after 2: on the second day with the fault. The cause by the channels comes from '
        'the table, that by the bags from `--explain`.'
    )
    header = ('train', 'fault (size)', 'onset', 'certain after days', 'cause by the channels', 'by the bags')
    return Table('Broken trains in real bags', header, tuple(rows), note)


def _sorted(world: World) -> Sequence[tuple[int, Fault]]:
    return sorted(world.faults.items())


def _found_row(number: int, fault: Fault, item: dict[str, Any] | None, days: Sequence[str]) -> tuple[str, ...]:
    head = (f'T{number:02d}', f'{fault.kind} ({fault.size:.2f})', str(fault.onset))
    if item is None or not item['changes']:
        return (*head, 'not found', '', '')
    after = days.index(item['changes'][0]['certain']) - fault.onset + 1
    cause = max(item['causes'], key=item['causes'].get, default='')
    explained = item.get('explained', {})
    return (*head, str(after), cause, ', '.join(explained.get('effects', {})) or 'nothing new')
