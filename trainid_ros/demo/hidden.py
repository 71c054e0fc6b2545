# SPDX-License-Identifier: Apache-2.0
"""Last chapter of the demo: a simulated train with an effect that its train file lacks, and the search for it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.bag.run_reader import read_runs
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.explain import REPORT_HTML, describe, explain_runs, prepare_folder, to_json, write_all
from trainid_ros.demo.bags import TRAIN_FILE, stock_bag
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import Davis, load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from trainid_ros.explain.result import Explanation
    from trainid_ros.train.train_file import TrainFile

HIDDEN: Final = 'local_drag:start=4500,end=5700,permille=1.5'
RUNS: Final = 8
_STOPS: Final = 5
_SEED: Final = 2017
_TRUE: Final = Davis(1.74, 0.02, 0.0086)


@dataclass(frozen=True, slots=True)
class HiddenCase:
    """Result of the chapter."""

    train_file: TrainFile  # The train file that the workflow was given
    explanation: Explanation  # Result of the workflow
    report: Path  # Path of its report

    @property
    def worked(self) -> bool:
        """True if the workflow found the hidden effect."""
        return HIDDEN.partition(':')[0] in [effect.name for effect in self.explanation.effects]


def prepare_hidden(folder: Path) -> Path:
    """Create the folder of the chapter, check that its outputs can be written, and return the stated train file.

    Raises:
        InputError: The folder cannot be used, or a file of somebody else would be overwritten.
    """
    train = stock_bag('yizhuang') / TRAIN_FILE
    prepare_folder(folder, train)
    return train


def play_hidden(folder: Path, say: Callable[[str], None]) -> HiddenCase:
    """Simulate runs over a few stations, there and back, with a hidden effect, and explain the gap.

    Raises:
        InputError: The train file of the package or the folder cannot be used.
    """
    train = prepare_hidden(folder)
    full = load_train_file(train)
    stated = replace(full, line=replace(full.line, stops=full.line.stops[:_STOPS]))
    say(f'{RUNS} runs on the Yizhuang line, there and back; hidden: {HIDDEN}, and a, b, c unlike the train file')
    bag = folder / 'bag'
    shutil.rmtree(bag, ignore_errors=True)  # of an earlier demo
    _simulate(stated, bag)
    explanation = explain_runs(read_runs([bag], stated), stated, [bag])
    notes = (f'Hidden in the simulation: {HIDDEN}; a = {_TRUE.a}, b = {_TRUE.b}, c = {_TRUE.c}.',)
    write_all(folder, explanation, stated, str(train), [bag], notes)
    return HiddenCase(stated, explanation, folder / REPORT_HTML)


def _simulate(stated: TrainFile, bag: Path) -> None:
    true = replace(stated, resistance=_TRUE, effects=parse_effects([HIDDEN]))
    simulation = simulate(Scenario(true, runs=RUNS), np.random.default_rng(_SEED))
    with BagWriter(bag) as writer:
        for record in simulation.records:
            writer.write_record(record)


def describe_hidden(case: HiddenCase) -> str:
    """Return the hidden and the found effects as text."""
    return f'hidden: {HIDDEN}\n\n{describe(case.explanation, case.train_file)}\n\nreport: {case.report}'


def hidden_to_json(case: HiddenCase) -> dict[str, Any]:
    """Return the hidden and the found effects as a JSON object."""
    return {'hidden': HIDDEN, 'found': to_json(case.explanation), 'report': case.report}
