# SPDX-License-Identifier: Apache-2.0
"""The last chapter of the demo: a train that runs otherwise than believed, and the workflow that finds out why."""

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
from trainid_ros.train.effect_text import parse_effects
from trainid_ros.train.train_file import Davis, load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from trainid_ros.explain.explanation import Explanation
    from trainid_ros.train.train_file import TrainFile

HIDDEN: Final = 'local_drag:start=4500,end=5700,permille=1.5'
RUNS: Final = 8
_STOPS: Final = 5
_SEED: Final = 2017
_TRUE: Final = Davis(1.74, 0.02, 0.0086)


@dataclass(frozen=True, slots=True)
class HiddenCase:
    """What came of it.

    Attributes:
        believed: The train file that the workflow got.
        explanation: What it found.
        report: Its report.

    """

    believed: TrainFile
    explanation: Explanation
    report: Path

    @property
    def worked(self) -> bool:
        """True if the hidden effect was named."""
        return HIDDEN.partition(':')[0] in [effect.name for effect in self.explanation.effects]


def play_hidden(folder: Path, say: Callable[[str], None]) -> HiddenCase:
    """Simulate a few stations there and back with a hidden effect, and explain what differs.

    Raises:
        InputError: The train file of the package or the folder cannot be used.

    """
    folder.mkdir(parents=True, exist_ok=True)
    train = stock_bag('yizhuang') / TRAIN_FILE
    known = load_train_file(train)
    believed = replace(known, line=replace(known.line, stops=known.line.stops[:_STOPS]))
    prepare_folder(folder, train)
    say(f'{RUNS} runs on the Yizhuang line, there and back; hidden: {HIDDEN}, and other a, b, c than believed')
    bag = folder / 'bag'
    shutil.rmtree(bag, ignore_errors=True)  # of an earlier demo
    _simulate(believed, bag)
    explanation = explain_runs(read_runs([bag], believed), believed, [bag])
    notes = (f'Hidden in the simulation: {HIDDEN}; a = {_TRUE.a}, b = {_TRUE.b}, c = {_TRUE.c}.',)
    write_all(folder, explanation, believed, str(train), [bag], notes)
    return HiddenCase(believed, explanation, folder / REPORT_HTML)


def _simulate(believed: TrainFile, bag: Path) -> None:
    true = replace(believed, resistance=_TRUE, effects=parse_effects([HIDDEN]))
    simulation = simulate(Scenario(true, runs=RUNS), np.random.default_rng(_SEED))
    with BagWriter(bag) as writer:
        for record in simulation.records:
            writer.write_record(record)


def describe_hidden(case: HiddenCase) -> str:
    """Return what was hidden and what was found, as text for people."""
    return f'hidden: {HIDDEN}\n\n{describe(case.explanation, case.believed)}\n\nreport: {case.report}'


def hidden_to_json(case: HiddenCase) -> dict[str, Any]:
    """Return what was hidden and what was found."""
    return {'hidden': HIDDEN, 'found': to_json(case.explanation), 'report': case.report}
