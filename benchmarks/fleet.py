# SPDX-License-Identifier: Apache-2.0
"""A fleet from bags to report: cost of a bag, memory of a worker, and which broken trains are found.

Bags are simulated drives of ten minutes, one a day and train (benchmarks/fleet_bags.py). They are replayed by ``trainid
fleet`` in one process, by two workers, and by two workers of Dask; then ``trainid fleet report`` looks for the broken
trains among them.

Many more fleets are made of rows of a table instead of bags, with the errors of real replays. A library of simulated
drives is replayed by the estimators first: healthy trains on several days, and each fault small and large. From it come
the errors of a row (values of all channels with their stated standard deviations, less level of the train and effect of
the day), the step that each fault makes in each channel at both sizes, and the errors of rows with that fault. A row of
a surrogate fleet is mean + level of the train + effect of the day + step of the fault + errors of one row of the
library, so that errors keep their tails and what they have in common across channels.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.days import REPOSITORY, write_bag
from benchmarks.fleet_bags import FAULTS, Fault, drive, stated_train
from benchmarks.processes import TRAINID, Cost, cluster, measure_command
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from trainid_ros.bag.bag_replay import Odometer
from trainid_ros.bag.types import table_of
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.fleet.analysis import FleetView, TrainView, analyse
from trainid_ros.fleet.mixed_model import CHANNELS
from trainid_ros.fleet.table_file import Row, empty_row, read_table
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.sim.worlds import draw_day, draw_train
from trainid_ros.train.train_file import dump_train_file

Array = NDArray[np.float64]
# Seeds from here on were not used in development.
FIRST_SEED: Final = 8_800
_FULL_SEEDS: Final = 60
# Of the bags: trains, days, and runs a drive.
_BAG_TRAINS, _BAG_DAYS, _RUNS = 50, 20, 4
_LABEL: Final = r'(?P<train>T\d+)/[^/]+$'
_WORKERS: Final = 2
_LIBRARY_SEED, _FLEET_SEED = 9_950, 83_000
_LIBRARY_TRAINS, _LIBRARY_DAYS = 24, 8
_TRAINS, _DAYS, _WITHIN = 50, 30, 3
_LIMIT: Final = 20_000.0
_WEAK: Final = 1.0 / 3.0
_SMALL_TRAINS, _SMALL_DAYS, _SMALL_STEP = 5, 6, 1.6  # the step in N/kN at 15 m/s
_CAUSES: Final = dict(zip(FAULTS, ('dragging_brake', 'brake_scale', 'wheel_diameter', 'mass_error'), strict=True))


@dataclass(frozen=True, slots=True)
class World:
    """Trains, days and broken trains (by number) of the bags."""

    seed: int
    trains: int
    days: int
    faults: dict[int, Fault]


def measure(seeds: int) -> tuple[Table, ...]:
    """Make the bags, replay them in three ways, and look for the broken trains; fewer seeds make fewer bags."""
    world = draw_world(FIRST_SEED, max(8, min(_BAG_TRAINS, _BAG_TRAINS * seeds // _FULL_SEEDS)))
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
        int(number): Fault(str(kinds[k % len(kinds)]), float(rng.random()), int(rng.integers(6, _BAG_DAYS - 4)))
        for k, number in enumerate(broken)
    }
    return World(seed, trains, _BAG_DAYS, faults)


def make_bags(world: World, folder: Path) -> None:
    """Simulate all drives."""
    (folder / 'train.yaml').write_text(dump_train_file(stated_train()), encoding='utf-8')
    over_seeds(partial(_make_train, world, folder), range(world.trains), jobs=_WORKERS)


def _make_train(world: World, folder: Path, number: int) -> None:
    train, fault = draw_train(world.seed, number), world.faults.get(number)
    place = folder / 'bags' / f'T{number:02d}'
    place.mkdir(parents=True)
    for day in (draw_day(world.seed, k) for k in range(world.days)):
        broken = fault if fault is not None and day.number >= fault.onset else None
        write_bag(place / f'day{day.number:02d}', drive(world.seed, train, day, broken, _RUNS).records)


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
    return [*TRAINID, 'fleet', *paths, '--label', _LABEL, *options]


def _report(folder: Path) -> dict[str, Any]:
    command = [*TRAINID, 'fleet', 'report', str(folder / 'one.parquet'), '--json', '--explain', '4']
    command += ['--out', str(folder / 'report.html')]
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
    broken = sorted(world.faults.items())
    rows = [_found_row(number, fault, by_name.pop(f'T{number:02d}', None), days) for number, fault in broken]
    rows.append(('others named', ', '.join(by_name) or 'none', '', '', '', ''))
    note = (
        f'Real bags of {world.trains} trains on {world.days} days through the commands; rain, wind and temperature hit '
        'all trains of a day. Certain after 2: on the second day with the fault. The cause by the channels comes from '
        'the table, that by the bags from `--explain`.'
    )
    header = ('train', 'fault (size)', 'onset', 'certain after days', 'cause by the channels', 'by the bags')
    return Table('Broken trains in real bags', header, tuple(rows), note)


def _found_row(number: int, fault: Fault, item: dict[str, Any] | None, days: Sequence[str]) -> tuple[str, ...]:
    head = (f'T{number:02d}', f'{fault.kind} ({fault.size:.2f})', str(fault.onset))
    if item is None or not item['changes']:
        return (*head, 'not found', '', '')
    after = days.index(item['changes'][0]['certain']) - fault.onset + 1
    cause = max(item['causes'], key=item['causes'].get, default='')
    explained = item.get('explained', {})
    return (*head, str(after), cause, ', '.join(explained.get('effects', {})) or 'nothing new')


def detection_tables(seeds: int) -> tuple[Table, ...]:
    """Look for broken trains in as many fleets as seeds."""
    library = make_library(max(6, min(_LIBRARY_TRAINS, _LIBRARY_TRAINS * seeds // _FULL_SEEDS)))
    trials = [
        (score, _FLEET_SEED + first + k)
        for score, first, count in (
            (score_fleet, 0, seeds),
            (score_weak, 2000, seeds),
            (score_rain, 5000, max(1, seeds // 4)),
            (score_nights, 9000, max(1, seeds // 15)),
            (score_small, 12_000, seeds),
            (score_few, 15_000, seeds),
        )
        for k in range(count)
    ]
    found: dict[Scored, list[Score]] = {}
    for (score, _), result in zip(trials, over_seeds(partial(_scored, library), trials, jobs=2), strict=True):
        found.setdefault(score, []).append(result)
    scores, weak, rain, nights, small, few = found.values()
    return (
        _found_table(scores, weak, library),
        _small_table(small),
        _false_table([*scores, *weak], rain, nights, [*small, *few]),
    )


def _scored(library: Library, trial: tuple[Scored, int]) -> Score:
    score, seed = trial
    return score(library, seed)


@dataclass(frozen=True, slots=True)
class Library:
    """What the rows of fleets are made of; channels in the order of CHANNELS."""

    mean: Array  # Mean, shape (4,)
    level_std: Array  # Standard deviation of the levels of trains, shape (4,)
    wet: Array  # Mean effect of a wet day, shape (4,)
    day_std: Array  # Standard deviation of the effects of dry days, shape (4,)
    errors: Array  # Errors of healthy rows and their stated standard deviations, shape (n, 8)
    steps: dict[str, Array]  # Step of each fault at sizes 0 and 1, shape (2, 4)
    fault_errors: dict[str, Array]  # Errors of rows with each fault, as ``errors``


def make_library(trains: int) -> Library:
    days = [replace(draw_day(_LIBRARY_SEED, d), is_wet=False) for d in range(_LIBRARY_DAYS)]
    found = over_seeds(_train_rows, range(trains), jobs=2)
    healthy = np.array([rows for rows, _ in found])  # (trains, days, 8)
    value, stated = healthy[..., :4], healthy[..., 4:]
    mean, level, day = value.mean(axis=(0, 1)), value.mean(axis=1), value.mean(axis=0)
    error = value - level[:, None] - day[None] + mean
    error *= np.sqrt(error[..., 0].size / ((trains - 1.0) * (len(days) - 1.0)))
    wet = np.array([draw_day(_LIBRARY_SEED, d).is_wet for d in range(_LIBRARY_DAYS)])
    steps, fault_errors = {}, {}
    for kind in FAULTS:
        rows = np.array([faulty[kind] for _, faulty in found])  # (trains, sizes, 8)
        step = rows[..., :4] - level[:, None] - day[None, :2] + mean
        steps[kind] = step.mean(axis=0)
        fault_errors[kind] = np.concatenate([step - steps[kind], rows[..., 4:]], axis=-1).reshape(-1, 8)
    dry = day[~wet] - day[~wet].mean(axis=0)
    wet_step = day[wet].mean(axis=0) - day[~wet].mean(axis=0) if wet.any() else np.array([0.2, -0.03, 0.0, 0.0])
    errors = np.concatenate([error, stated], axis=-1).reshape(-1, 8)
    return Library(mean, level.std(axis=0, ddof=1), wet_step, dry.std(axis=0, ddof=1), errors, steps, fault_errors)


def _train_rows(number: int) -> tuple[Array, dict[str, Array]]:
    """Return the values of a train on each day, shape (days, 8), and with each fault at both sizes, shape (2, 8)."""
    train = draw_train(_LIBRARY_SEED, number)
    days = [draw_day(_LIBRARY_SEED, d) for d in range(_LIBRARY_DAYS)]
    healthy = np.array([_values(drive(_LIBRARY_SEED, train, day, None, _RUNS)) for day in days])
    faulty = {
        kind: np.array(
            # Another drive of the same day, so that the errors are others.
            [_values(drive(_LIBRARY_SEED, train, days[k], Fault(kind, float(k), 0), _RUNS, 1 + f)) for k in (0, 1)]
        )
        for f, kind in enumerate(FAULTS)
    }
    return healthy, faulty


def _values(simulation: Any) -> Array:
    """Return the values of the channels as in a row of the table, then their standard deviations, shape (8,)."""
    train_file, settings, odometer = stated_train(), EstimatorSettings(), Odometer()
    w, brake = resistance_pipeline(train_file, settings), brake_rate_pipeline(train_file, settings)
    rows = [record.row() for record in simulation.records]
    PipelineGroup((w, brake)).push_rows(rows)
    odometer.add(table_of([(record.stamp_ns, row) for record, row in zip(simulation.records, rows, strict=True)]))
    found, rate = w.current().estimate, brake.current().estimate
    phi = np.array([1.0, 15.0, 225.0])
    std = float(np.sqrt(phi @ np.array(found.covariance).reshape(3, 3) @ phi))
    wheel = odometer.ratio or (np.nan, np.nan)
    value = (float(phi @ (found.a, found.b, found.c)), rate.brake_rate, found.force_scale, wheel[0])
    return np.array([*value, std, rate.brake_rate_std, found.force_scale_std, wheel[1]])


@dataclass(frozen=True, slots=True)
class Fleet:
    """Rows of a fleet, and its broken trains by name."""

    rows: list[Row]
    faults: dict[str, Fault]

    def until(self, days: int) -> FleetView:
        return analyse([row for row in self.rows if int(row['day'][-2:]) <= days], _LIMIT)

    @property
    def whole(self) -> FleetView:
        return analyse(self.rows, _LIMIT)


def make_fleet(
    library: Library, seed: int, *, all_wet_from: int = _DAYS, broken: bool = True, share: float = 1.0
) -> Fleet:
    """Return a fleet in which one or two trains break, by a share of the usual steps; it rains from some day on."""
    rng = np.random.default_rng(seed)
    faults = _draw_faults(rng) if broken else {}
    level = library.mean + library.level_std * rng.standard_normal((_TRAINS, 4))
    wet = (rng.random(_DAYS) < 0.2) | (np.arange(_DAYS) >= all_wet_from)
    amount = 1.0 + 0.3 * rng.standard_normal(_DAYS)
    day = library.day_std * rng.standard_normal((_DAYS, 4)) + np.outer(wet * amount, library.wet)

    def step(number: int, d: int) -> tuple[Array, Array]:
        fault = faults.get(number)
        if fault is None or d < fault.onset:
            return library.errors, np.zeros(4)
        small, large = library.steps[fault.kind]
        return library.fault_errors[fault.kind], share * (small + fault.size * (large - small))

    return Fleet(_rows(rng, level, day, step), {f'T{number:02d}': fault for number, fault in faults.items()})


def make_small_fleet(library: Library, seed: int, *, broken: bool) -> Fleet:
    """Return a small fleet, in which the brake of one train may drag on three days."""
    rng = np.random.default_rng(seed)
    onset, bad = int(rng.integers(2, _SMALL_DAYS - _WITHIN + 1)), int(rng.integers(_SMALL_TRAINS))
    kind = FAULTS[0]
    level = library.mean + library.level_std * rng.standard_normal((_SMALL_TRAINS, 4))
    wet = (rng.random(_SMALL_DAYS) < 0.2) * (1.0 + 0.3 * rng.standard_normal(_SMALL_DAYS))
    day = library.day_std * rng.standard_normal((_SMALL_DAYS, 4)) + np.outer(wet, library.wet)

    def step(number: int, d: int) -> tuple[Array, Array]:
        if not (broken and number == bad and onset <= d < onset + _WITHIN):
            return library.errors, np.zeros(4)
        large = library.steps[kind][1]
        return library.fault_errors[kind], large * (_SMALL_STEP / large[0])

    return Fleet(_rows(rng, level, day, step), {f'T{bad:02d}': Fault(kind, 1.0, onset)} if broken else {})


def _rows(
    rng: np.random.Generator, level: Array, day: Array, step: Callable[[int, int], tuple[Array, Array]]
) -> list[Row]:
    """Return the rows of all trains and days; ``step`` gives the errors to draw from and the step of the fault."""
    rows = []
    for number in range(len(level)):
        for d in range(len(day)):
            errors, added = step(number, d)
            drawn = errors[rng.integers(len(errors))]
            rows.append(_row(number, d, level[number] + day[d] + added + drawn[:4], drawn[4:]))
    return rows


def _draw_faults(rng: np.random.Generator) -> dict[int, Fault]:
    """Return faults of one or two trains, by number."""
    return {
        int(number): Fault(str(rng.choice(FAULTS)), float(rng.random()), int(rng.integers(4, _DAYS - _WITHIN + 1)))
        for number in rng.choice(_TRAINS, size=rng.integers(1, 3), replace=False)
    }


def _row(train: int, day: int, value: Array, std: Array) -> Row:
    row = empty_row() | {'bag': f'{train}/{day}', 'train': f'T{train:02d}', 'day': f'2026-01-{day + 1:02d}'}
    row['status'] = 'VALID'
    for k, channel in enumerate(CHANNELS):
        if np.isfinite(value[k]):
            row |= {channel.name: float(value[k]), f'{channel.name}_std': float(std[k])}
    return row


@dataclass(frozen=True, slots=True)
class Score:
    """Faults of a fleet with whether they were found in time and under which name; names of other trains named."""

    faults: tuple[tuple[Fault, bool, str], ...]
    false: tuple[str, ...]


Scored = Callable[[Library, int], Score]


def score_weak(library: Library, seed: int) -> Score:
    """Score a fleet whose faults are a third of the usual."""
    return score_fleet(library, seed, _WEAK)


def score_fleet(library: Library, seed: int, share: float = 1.0) -> Score:
    """Score a fleet: each fault by what is known on its third day, all others by all days."""
    fleet, scored = make_fleet(library, seed, share=share), []
    for name, fault in fleet.faults.items():
        train = _named(fleet.until(fault.onset + _WITHIN), name)
        in_time = any(change.alarm >= fault.onset for change in train.changes)
        scored.append((fault, in_time, train.causes[0].effect if train.causes else ''))
    return Score(tuple(scored), _false(fleet.whole, fleet.faults))


def score_small(library: Library, seed: int) -> Score:
    """Score a small fleet in which a brake drags on three days: found on the third, and under which name at the end."""
    fleet = make_small_fleet(library, seed, broken=True)
    ((name, fault),) = fleet.faults.items()
    late = fleet.whole
    then, now = _named(fleet.until(fault.onset + _WITHIN), name), _named(late, name)
    is_found = any(departure.alarm >= fault.onset for departure in then.departures)
    is_named = now.main is not None and now.main.first == fault.onset
    cause = now.causes[0].effect if is_named and now.causes else ''
    return Score(((fault, is_found, cause),), _false(late, fleet.faults))


def score_few(library: Library, seed: int) -> Score:
    return Score((), _false(make_small_fleet(library, seed, broken=False).whole, {}))


def score_rain(library: Library, seed: int) -> Score:
    """Score a fleet without faults in which rain hits all trains from the middle on."""
    return Score((), _false(make_fleet(library, seed, all_wet_from=_DAYS // 2, broken=False).whole, {}))


def score_nights(library: Library, seed: int) -> Score:
    """Score a fleet without faults by a report on each night."""
    fleet = make_fleet(library, seed, broken=False)
    return Score((), tuple(sorted({name for day in range(3, _DAYS + 1) for name in _false(fleet.until(day), {})})))


def _named(view: FleetView, name: str) -> TrainView:
    return next(train for train in view.trains if train.name == name)


def _false(view: FleetView, faults: dict[str, Fault]) -> tuple[str, ...]:
    """Return the trains that are named although nothing is wrong with them, or before it was."""
    onsets = {name: fault.onset for name, fault in faults.items()}
    return tuple(
        train.name
        for train in view.found
        if train.name not in onsets or any(change.alarm < onsets[train.name] for change in train.changes)
    )


def _found_table(scores: Sequence[Score], weak: Sequence[Score], library: Library) -> Table:
    rows = []
    for kind in (*FAULTS, 'all'):
        cells = [cell for some in (scores, weak) for cell in _found_cells(some, kind)]
        rows.append((kind, _step_text(library, kind), *cells))
    note = (
        f'Twice {len(scores)} surrogate fleets of {_TRAINS} trains and {_DAYS} days, one or two of which break on a '
        'random day by a random size; the report sees the days up to the third with the fault. Wanted: 90 %. '
        f'Surrogate: the errors are those of {len(library.errors)} replayed healthy drives of 11 min and of '
        f'{sum(map(len, library.fault_errors.values()))} with faults; the steps are those of the faults in these. The '
        'cause is that by the channels.'
    )
    within = f'found within {_WITHIN} days'
    header = ('fault', 'step of the smallest and the largest', within, 'right cause', 'a third: found', 'right cause')
    return Table('Broken trains found, surrogate fleets', header, tuple(rows), note)


def _small_table(scores: Sequence[Score]) -> Table:
    found, named = _found_cells(scores, 'all')
    note = (
        f'{len(scores)} surrogate fleets of {_SMALL_TRAINS} trains and {_SMALL_DAYS} days; the brake of one drags on '
        f'{_WITHIN} days, which adds {_SMALL_STEP} N/kN at 15 m/s. The cause is that of all days, with the right onset.'
    )
    header = (f'found within {_WITHIN} days', 'right cause and onset')
    return Table('A dragging brake in a small fleet', header, ((found, named),), note)


def _found_cells(scores: Sequence[Score], kind: str) -> tuple[str, str]:
    """Return how many faults of a kind were found, and how many of these under their cause."""
    own = [item for score in scores for item in score.faults if kind in (item[0].kind, 'all')]
    found = [item for item in own if item[1]]
    named = sum(name == _CAUSES[fault.kind] for fault, _, name in found)
    return _of(len(found), len(own)), _of(named, len(found))


def _of(count: int, total: int) -> str:
    return f'{count} of {total} ({count / max(1, total):.0%})'


def _step_text(library: Library, kind: str) -> str:
    if kind not in library.steps:
        return ''
    small, large = library.steps[kind]
    k = int(np.argmax(np.abs(large) / library.errors[:, :4].std(axis=0)))
    scale = library.errors[:, k].std()
    name = CHANNELS[k].name
    return f'{name} {small[k]:+.3f} to {large[k]:+.3f} (error of a run {scale:.2g})'


def _false_table(
    scores: Sequence[Score], rain: Sequence[Score], nights: Sequence[Score], small: Sequence[Score]
) -> Table:
    rows, whole = [], _TRAINS * _DAYS
    for name, some, each in (
        ('all days, one or two broken', scores, whole),
        ('rain hits all from day 15 on, none broken', rain, whole),
        ('a report each night, none broken', nights, whole),
        (f'{_SMALL_TRAINS} trains, {_SMALL_DAYS} days, one or none broken', small, _SMALL_TRAINS * _SMALL_DAYS),
    ):
        days = len(some) * each
        false = sum(len(score.false) for score in some)
        rows.append((name, str(days), str(false), f'{1500.0 * false / days:.2f}'))
    header = ('surrogate fleets', 'train-days', 'healthy trains named', 'per 1,500 train-days')
    return Table('Healthy trains named', header, tuple(rows), f'Wanted: 1 per 1,500; asked for: one in {_LIMIT:.0f}.')
