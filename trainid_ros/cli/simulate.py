# SPDX-License-Identifier: Apache-2.0
"""``trainid simulate``: create a bag with the simulator, together with its truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.output import print_json, progress, show
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS
from trainid_ros.interface.text import pluralise
from trainid_ros.sim.scenario import Scenario, check_scenario, simulate
from trainid_ros.sim.truth import plain_truth, save_truth
from trainid_ros.sim.worlds import WORLDS, make_case, unknowns_of, world_train
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import dump_train_file, load_train_file

if TYPE_CHECKING:
    import argparse

    from trainid_ros.sim.scenario import Simulation
    from trainid_ros.sim.worlds import Case

TRAIN_FILE: Final = 'train.yaml'
TRUTH_FILE: Final = 'truth.yaml'
_TOPIC_OF: Final = {topic.record: topic.name for topic in INPUT_TOPICS}
_PROGRESS_EVERY: Final = 1000


def run(args: argparse.Namespace) -> int:
    """Simulate and write the bag and its truth; with a world also the stated train file.

    Raises:
        InputError: If an argument or the train file cannot be used, or the bag already exists.
    """
    rng = np.random.default_rng(args.seed)
    case = _case(args, rng)
    scenario = case.scenario if case else scenario_from(_train_path(args), args.effect, args.runs)
    # The bag is opened first, so that a path that cannot be written is reported before the simulation.
    with BagWriter(args.out) as writer:
        with progress('simulating'):
            simulation = simulate(scenario, rng)
        _write(simulation, writer)
    if case:
        simulation = replace(simulation, truth=replace(simulation.truth, unknowns=case.true_values))
        (args.out / TRAIN_FILE).write_text(dump_train_file(case.stated), encoding='utf-8')
    save_truth(simulation.truth, args.out / TRUTH_FILE)
    _print_result(args, simulation)
    return 0


def _train_path(args: argparse.Namespace) -> Path:
    if args.train is None:
        raise InputError('no train: give --train T.yaml or --world NAME')
    return Path(args.train)


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


def scenario_from(train: Path, effects: list[str], runs: int) -> Scenario:
    """Return the scenario of a train file and the effects named on the command line.

    Raises:
        InputError: If the train file, an effect or the number of runs cannot be used.
    """
    file = load_train_file(train)
    file = replace(file, effects=(*file.effects, *parse_effects(effects)))
    scenario = Scenario(file, runs=runs)
    check_scenario(scenario)
    return scenario


def _write(simulation: Simulation, writer: BagWriter) -> None:
    with progress('writing', len(simulation.records)) as advance:
        for i, record in enumerate(simulation.records, 1):
            writer.write_record(record)
            if i % _PROGRESS_EVERY == 0:
                advance(_PROGRESS_EVERY)


def _print_result(args: argparse.Namespace, simulation: Simulation) -> None:
    counts = Counter(_TOPIC_OF[type(record)] for record in simulation.records)
    if not args.json:
        runs = f'{pluralise(len(simulation.arrivals), "run")}, {simulation.duration_s:.0f} s'
        show(f'{args.out}: {len(simulation.records)} messages of {runs}; truth in {args.out / TRUTH_FILE}')
        if args.world:
            show(f'stated train file: {args.out / TRAIN_FILE}')
        return
    print_json(
        {
            'out': args.out,
            'messages': dict(sorted(counts.items())),
            'duration_s': simulation.duration_s,
            'runs': len(simulation.arrivals),
            'seed': args.seed,
            'truth': plain_truth(simulation.truth),
        }
    )
