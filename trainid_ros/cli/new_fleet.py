# SPDX-License-Identifier: Apache-2.0
"""``trainid simulate``: one bag, or with ``--fleet`` those of a fleet over days, with the faults of some trains."""

from __future__ import annotations

import shlex
from collections import deque
from functools import partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from trainid_ros.bag.worker_pool import each_bag, processors
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli import new_bag
from trainid_ros.cli.output import print_json, progress, show
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.text import pluralise
from trainid_ros.sim.fleet import Fault, Fleet, draw_day, draw_train, drive, fleet_train, parse_fault, train_name
from trainid_ros.sim.truth import save_truth
from trainid_ros.sim.worlds import find_world, world_train
from trainid_ros.train.train_file import dump_train_file, load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    Advance = Callable[[float], None]

_DAYS: Final = 10
"""Days of a fleet unless stated."""
_NO_FLEET: Final = ('realism', 'unknown', 'effect')


def run(args: argparse.Namespace) -> int:
    """Simulate a bag, or a fleet."""
    if not args.fleet:
        if args.days is not None or args.fault:
            raise InputError(f'--{"fault" if args.fault else "days"} needs --fleet N')
        return new_bag.simulate(args)
    if given := [name for name in _NO_FLEET if getattr(args, name)]:
        raise InputError(f'--{given[0]} is of a single bag; what a train of a fleet has is a --fault')
    days = _DAYS if args.days is None else args.days
    if not days:
        raise InputError('--days = 0 must be >= 1')
    faults = [parse_fault(text, args.fleet, days) for text in args.fault]
    world = find_world(args.world or 'metro')
    fleet = Fleet(world, load_train_file(args.train) if args.train else world_train(world), args.seed)
    new_bag.warn_of_runs(fleet.file, args.runs)
    if args.out.exists():
        raise InputError(f'{args.out}: exists already and is not overwritten')
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f'.{args.out.name}.', dir=args.out.parent) as name:
        folder = Path(name) / args.out.name
        folder.mkdir()
        (folder / new_bag.TRAIN_FILE).write_text(dump_train_file(fleet_train(fleet.file)), encoding='utf-8')
        work, numbers = partial(_simulate, fleet, faults, args.runs, days, folder), range(1, args.fleet + 1)
        with progress('simulating', total=args.fleet * days, unit='bags') as advance:
            deque(each_bag(work, numbers, processors(), lambda share: advance(share * days), _killed), maxlen=0)
        folder.rename(args.out)
    table, report = (args.out / name for name in ('table.csv', 'report.html'))
    replay = ('trainid', 'fleet', str(args.out), '--train', str(args.out / new_bag.TRAIN_FILE), '--out', str(table))
    commands = [shlex.join(replay), shlex.join(('trainid', 'fleet', 'report', str(table), '--out', str(report)))]
    if args.json:
        print_json({'out': args.out, 'trains': args.fleet, 'days': days, 'faults': args.fault, 'next': commands})
        return 0
    broken = ', '.join(args.fault) or 'none'
    counts = f'{pluralise(args.fleet, "train")}, {pluralise(days, "day")}, {pluralise(args.fleet * days, "bag")}'
    show(f'{args.out}: {counts}; faults: {broken}\nnext: {" && ".join(commands)}')
    return 0


def _simulate(
    fleet: Fleet, faults: Sequence[Fault], runs: int, days: int, out: Path, number: int, advance: Advance
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
        save_truth(simulation.truth, writer.path / new_bag.TRUTH_FILE)
        advance(1.0 / days)


def _killed(number: int) -> None:
    raise InputError(f'the process that simulated {train_name(number)} was killed, as when memory runs out')
