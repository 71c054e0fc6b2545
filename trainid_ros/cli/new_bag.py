# SPDX-License-Identifier: Apache-2.0
"""The verbs that create bags: ``trainid import`` from a table, and ``trainid simulate`` with the truth.

With ``--fleet`` it simulates the bags of a fleet over days, with the faults of some trains.
"""

from __future__ import annotations

import argparse
import shlex
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from trainid_ros.bag.reader import PROGRESS_EVERY
from trainid_ros.bag.worker_pool import each_bag, processors
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.output import EXIT_NO_ANSWER, print_json, progress, show, warn
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping import load_table_mapping
from trainid_ros.inputs.tables import TableRecords
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import new_place
from trainid_ros.interface.records import NS_PER_S, REQUIRED_TOPICS, input_topic
from trainid_ros.interface.text import pluralise
from trainid_ros.sim.scenario import Scenario, check_scenario
from trainid_ros.sim.scenario import simulate as run_scenario
from trainid_ros.sim.truth import plain_truth, save_truth
from trainid_ros.sim.worlds import (
    WORLDS,
    Case,
    Fault,
    Fleet,
    draw_day,
    draw_train,
    drive,
    find_world,
    fleet_train,
    make_case,
    parse_fault,
    train_name,
    unknowns_of,
    world_train,
)
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.fields import shown
from trainid_ros.train.train_file import TrainFile, dump_train_file, load_train_file

TRAIN_FILE: Final = 'train.yaml'
TRUTH_FILE: Final = 'truth.yaml'


def import_table(args: argparse.Namespace) -> int:
    """Read the table and write the bag, or print a mapping for it; after an InputError no bag is left."""
    if args.suggest_map:
        return _suggest(args)
    if args.out is None or args.map is None:
        lacks = '--map is' if args.out else 'OUT is' if args.map else 'OUT and --map are'
        command = f'trainid import {_quoted(args.file)} --suggest-map > map.yaml'
        raise InputError(f'{lacks} missing; {command} proposes a mapping')
    train_file = None if args.train is None else load_train_file(args.train)
    table = TableRecords(args.file, MappedInputs(load_table_mapping(args.map), train_file))
    counts: Counter[str] = Counter({topic.name: 0 for topic in REQUIRED_TOPICS})
    first_ns = last_ns = 0
    bar = progress(f'importing {args.file.name}', 1.0)
    with new_place(args.out) as place, BagWriter(place) as writer, bar as advance:
        for share, records in table.blocks():
            for log_ns, record in records:
                writer.write_record(record, log_ns)
                counts[input_topic(record).name] += 1
            if records:
                first_ns, last_ns = first_ns or records[0][0], records[-1][0]
            advance(share)
        if not writer.message_count:
            raise InputError(f'{args.file}: nothing in {pluralise(table.rows, "row")} has a time and a value')
    _warn_of_table(args, table, counts)
    duration_s, rows = (last_ns - first_ns) / NS_PER_S, pluralise(table.rows, 'row')
    blank = {name: count for name, count in table.blank.items() if count}
    if args.json:
        read = {'rows': table.rows, 'blank': blank, 'duration_s': duration_s}
        print_json({'out': args.out, 'messages': dict(sorted(counts.items())), **read})
        return 0
    show(f'{args.out}: {counts.total()} messages from {rows} over {duration_s:.1f} s')
    show('\n'.join(f'  {topic}: {count}' for topic, count in counts.items()))
    if blank:
        show('rows without a value: ' + ', '.join(f'{name} {count}' for name, count in blank.items()))
    if all(counts[topic.name] for topic in REQUIRED_TOPICS):
        train, out = _quoted(args.train or Path('T.yaml')), _quoted(args.out)
        show(f'next: trainid replay {out} --train {train} --report {out}.html')
        if args.train is None:
            show('      where T.yaml has mass [kg] and resistance [N/kN], at least:')
            show('      train: {mass: 200e3}\n      resistance: {a: 1.0, b: 0.01, c: 0.0005}')
    return 0


def _suggest(args: argparse.Namespace) -> int:
    """Print a mapping for a table, and on standard error what it doubts and the next command."""
    from trainid_ros.inspection.suggest import suggest  # noqa: PLC0415 - loads much that only this needs
    from trainid_ros.inspection.table_numbers import read_table  # noqa: PLC0415

    if args.map is not None or args.out is not None:
        raise InputError('--suggest-map takes a table alone, without OUT and --map')
    with progress(f'reading {args.file.name}'):
        numbers, choices = read_table(args.file)
        train_file = None if args.train is None else load_train_file(args.train)
        suggestion = suggest(numbers, args.file.name, train_file, choices)
    missing = list(suggestion.missing)
    if args.json:
        print_json({'mapping': suggestion.text(), 'missing': missing})
    else:
        show(suggestion.text())
        for choice in suggestion.choices:
            for decision in choice.decisions:
                warn(f'{choice.quantity}: {decision}', 'decide')
        train = '' if args.train is None else f' --train {_quoted(args.train)}'
        if not missing:
            out = args.file.with_suffix('')
            warn(f'trainid import {_quoted(args.file)} {_quoted(out)} --map map.yaml{train}', 'next')
    if missing:
        warn(f'{args.file}: nothing found for {", ".join(missing)}', 'error')
    return EXIT_NO_ANSWER if missing else 0


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _warn_of_table(args: argparse.Namespace, table: TableRecords, counts: Counter[str]) -> None:
    for line in table.warnings:
        warn(line)
    for (name, number), count in table.unlisted.most_common(5):
        rows = pluralise(count, 'row')
        warn(f'{args.file}: column {shown(name)}: {number:g} is not in table of the mapping ({rows})')
    if table.steps_back:
        warn(f'{args.file}: {pluralise(table.steps_back, "row")} earlier than one before')
    if table.repeated:
        warn(f'{args.file}: {pluralise(table.repeated, "row")} with the time of the one before')
    if missing := [topic for topic, count in counts.items() if not count]:
        warn(f'{args.out}: no messages on {", ".join(missing)}: the mapping names no column with values')


def simulate(args: argparse.Namespace) -> int:
    """Simulate and write the bag and its truth; with a world also the stated train file."""
    if args.fleet:
        return _simulate_fleet(args)
    if args.days is not None or args.fault:
        raise InputError(f'--{"fault" if args.fault else "days"} needs --fleet N')
    rng = np.random.default_rng(args.seed)
    case = _case(args, rng)
    scenario = case.scenario if case else _scenario(args)
    _warn_of_runs(scenario.train_file, args.runs)
    # The bag is opened first, so that a path that cannot be written is reported before the simulation.
    with BagWriter(args.out) as writer:
        with progress('simulating'):
            simulation = run_scenario(scenario, rng)
        with progress('writing', len(simulation.records)) as advance:
            for i, record in enumerate(simulation.records, 1):
                writer.write_record(record)
                if i % PROGRESS_EVERY == 0:
                    advance(PROGRESS_EVERY)
    if case:
        simulation = replace(simulation, truth=replace(simulation.truth, unknowns=case.true_values))
        (args.out / TRAIN_FILE).write_text(dump_train_file(case.stated), encoding='utf-8')
    save_truth(simulation.truth, args.out / TRUTH_FILE)
    if args.json:
        counts = Counter(input_topic(record).name for record in simulation.records)
        run = {'duration_s': simulation.duration_s, 'runs': len(simulation.arrivals), 'seed': args.seed}
        truth = plain_truth(simulation.truth)
        print_json({'out': args.out, 'messages': dict(sorted(counts.items())), **run, 'truth': truth})
        return 0
    runs = f'{pluralise(len(simulation.arrivals), "run")}, {simulation.duration_s:.0f} s'
    show(f'{args.out}: {len(simulation.records)} messages of {runs}; truth in {args.out / TRUTH_FILE}')
    if args.world:
        show(f'stated train file: {args.out / TRAIN_FILE}')
    return 0


def _warn_of_runs(file: TrainFile, runs: int) -> None:
    """Warn of effects on runs that a drive of so many runs does not have."""
    for effect in file.effects:
        if beyond := [str(run) for run in effect.runs if run > runs]:
            warn(f'effect {effect.name}: the drive has {pluralise(runs, "run")}, not runs {", ".join(beyond)}')


def _case(args: argparse.Namespace, rng: np.random.Generator) -> Case | None:
    """Return the case of the world asked for, None without a world."""
    if args.world is None:
        if args.realism or args.unknown:
            raise InputError(f'--{"realism" if args.realism else "unknown"} needs --world, one of {", ".join(WORLDS)}')
        return None
    world = WORLDS[args.world]
    stated = load_train_file(args.train) if args.train else world_train(world)
    names = unknowns_of(args.realism or 'clean', args.unknown, stated)
    # Drawn from a separate generator, so that driving and noise are the same with and without unknowns.
    return make_case(world, stated, names, args.runs, rng.spawn(1)[0], parse_effects(args.effect))


def _scenario(args: argparse.Namespace) -> Scenario:
    if args.train is None:
        raise InputError('no train: give --train T.yaml or --world NAME')
    file = load_train_file(args.train)
    scenario = Scenario(replace(file, effects=(*file.effects, *parse_effects(args.effect))), runs=args.runs)
    check_scenario(scenario)
    return scenario


def _simulate_fleet(args: argparse.Namespace) -> int:
    if given := [name for name in ('realism', 'unknown', 'effect') if getattr(args, name)]:
        raise InputError(f'--{given[0]} is of a single bag; what a train of a fleet has is a --fault')
    days = 10 if args.days is None else args.days
    if not days:
        raise InputError('--days = 0 must be >= 1')
    faults = [parse_fault(text, args.fleet, days) for text in args.fault]
    world = find_world(args.world or 'metro')
    fleet = Fleet(world, load_train_file(args.train) if args.train else world_train(world), args.seed)
    _warn_of_runs(fleet.file, args.runs)
    with new_place(args.out) as folder:
        folder.mkdir()
        (folder / TRAIN_FILE).write_text(dump_train_file(fleet_train(fleet.file)), encoding='utf-8')
        work, numbers = partial(_simulate_train, fleet, faults, args.runs, days, folder), range(1, args.fleet + 1)
        with progress('simulating', total=args.fleet * days, unit='bags') as advance:
            deque(each_bag(work, numbers, processors(), lambda share: advance(share * days), _killed), maxlen=0)
    table, report = (args.out / name for name in ('table.csv', 'report.html'))
    replay = ('trainid', 'fleet', str(args.out), '--train', str(args.out / TRAIN_FILE), '--out', str(table))
    commands = [shlex.join(replay), shlex.join(('trainid', 'fleet', 'report', str(table), '--out', str(report)))]
    if args.json:
        print_json({'out': args.out, 'trains': args.fleet, 'days': days, 'faults': args.fault, 'next': commands})
        return 0
    broken = ', '.join(args.fault) or 'none'
    counts = f'{pluralise(args.fleet, "train")}, {pluralise(days, "day")}, {pluralise(args.fleet * days, "bag")}'
    show(f'{args.out}: {counts}; faults: {broken}\nnext: {" && ".join(commands)}')
    return 0


def _simulate_train(
    fleet: Fleet,
    faults: Sequence[Fault],
    runs: int,
    days: int,
    out: Path,
    number: int,
    advance: Callable[[float], None],
) -> None:
    """Write the bags of a train, one a day, in a folder of its name."""
    train, name = draw_train(fleet.seed, number), train_name(number)
    (out / name).mkdir()
    for day in (draw_day(fleet.seed, k) for k in range(days)):
        acting = [fault.effects for fault in faults if fault.train == name and fault.day <= day.number]
        simulation = drive(fleet, train, day, chain(*acting), runs)
        with BagWriter(out / name / f'day{day.number + 1:02d}') as writer:
            for record in simulation.records:
                writer.write_record(record)
        save_truth(simulation.truth, writer.path / TRUTH_FILE)
        advance(1.0 / days)


def _killed(number: int) -> None:
    raise InputError(f'the process that simulated {train_name(number)} was killed, as when memory runs out')
