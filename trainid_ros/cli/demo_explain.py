# SPDX-License-Identifier: Apache-2.0
"""The chapter of the demo that hides effects in simulated runs, each drawn by a seed, and finds them again."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.bag.run_reader import read_runs
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.explain import REPORT_HTML, explain_runs, prepare_folder, to_json, write_all
from trainid_ros.cli.output import table
from trainid_ros.report import words
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.effects import EFFECTS, parse_effects
from trainid_ros.train.train_file import Davis, load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from trainid_ros.explain.result import Explanation

CASES: Final = 3
# Effects that half an hour on the line of the demo shows at any size drawn.
_HIDEABLE: Final = (
    'brake_delay', 'brake_scale', 'gradient_error', 'headwind', 'local_drag', 'mass_error', 'traction_scale',
    'wheel_diameter',
)  # fmt: skip
_SIZES: Final = (1.0, 2.0)  # Range of the amplitude, in units of the typical one of the effect [1]
_LENGTHS: Final = (500.0, 3000.0)  # Range of the length of a section [m]
_DAVIS: Final = (0.8, 1.2)  # Range of a, b and c over those of the train file [1]
_STOPS: Final = 5
_RUNS: Final = 8


@dataclass(frozen=True, slots=True)
class Case:
    """A hidden effect and what was found."""

    seed: int
    hidden: str  # Effect as for --effect
    explanation: Explanation
    folder: Path  # Of the report

    @property
    def is_found(self) -> bool:
        """Whether the hidden effect is among those found."""
        return self.hidden.partition(':')[0] in [effect.name for effect in self.explanation.effects]

    @property
    def answer(self) -> dict[str, Any]:
        """The case for ``--json``."""
        found, report = to_json(self.explanation), self.folder / REPORT_HTML
        return {'seed': self.seed, 'hidden': self.hidden, 'is_found': self.is_found, 'found': found, 'report': report}


def folders(folder: Path, seed: int) -> dict[int, Path]:
    """Return the folder of each case by its seed."""
    return {each: folder / f'seed_{each}' for each in range(seed, seed + CASES)}


def prepare(folder: Path, seed: int, train: Path) -> None:
    """Create the folders; InputError if one cannot be written to."""
    for each in folders(folder, seed).values():
        prepare_folder(each, train)


def run_cases(folder: Path, seed: int, train: Path, say: Callable[[str], None]) -> Iterator[Case]:
    """Simulate runs with an effect that the train file lacks, and explain the gap, for each seed."""
    full = load_train_file(train)
    stated = replace(full, line=replace(full.line, stops=full.line.stops[:_STOPS]))
    for each, place in folders(folder, seed).items():
        rng = np.random.default_rng(each)
        hidden = draw_effect(rng, stated.line.stops[-1])
        a, b, c = (x * rng.uniform(*_DAVIS) for x in (full.resistance.a, full.resistance.b, full.resistance.c))
        say(f'seed {each}: {_RUNS} runs on the Yizhuang line, there and back; hidden: {hidden}, and other a, b and c')
        bag = place / 'bag'
        shutil.rmtree(bag, ignore_errors=True)  # of an earlier demo
        true = replace(stated, resistance=Davis(a, b, c), effects=parse_effects([hidden]))
        with BagWriter(bag) as writer:
            for record in simulate(Scenario(true, runs=_RUNS), rng).records:
                writer.write_record(record)
        explanation = explain_runs(read_runs([bag], stated), stated, [bag])
        notes = (f'Hidden in the simulation: {hidden}; a = {a:.3g}, b = {b:.3g}, c = {c:.3g}.',)
        write_all(place, explanation, stated, str(train), [bag], notes)
        yield Case(each, hidden, explanation, place)


def draw_effect(rng: np.random.Generator, end: float) -> str:
    """Return an effect on a line from 0 to ``end`` [m], drawn at random, as for ``--effect``."""
    kind = EFFECTS[_HIDEABLE[rng.integers(len(_HIDEABLE))]]
    sign = kind.sign or rng.choice((-1, 1))
    parameters = {kind.amplitude: kind.neutral + sign * rng.uniform(*_SIZES) * kind.typical_size}
    if 'start' in kind.shape:
        length = rng.uniform(*_LENGTHS)
        start = rng.uniform(0.0, end - length)
        parameters |= {'start': round(start), 'end': round(start + length)}
    return f'{kind.name}:{",".join(f"{name}={value:.4g}" for name, value in parameters.items())}'


def describe_cases(cases: list[Case]) -> str:
    """Return what was hidden beside what was found, and the gap on runs left out, as text."""
    rows = [('seed', 'hidden', 'found', 'gap before -> after, m/s')]
    for case in cases:
        gap = case.explanation.gap
        found = [f'{effect.name}: {words.parameters_text(effect)}' for effect in case.explanation.effects]
        text = '; '.join(found) or case.explanation.verdict.value
        rows.append((str(case.seed), case.hidden, text, f'{gap.before:.3f} -> {gap.after:.3f}' if gap else words.DASH))
    reports = '\n'.join(f'report: {case.folder / REPORT_HTML}' for case in cases)
    return f'Effects missing from the train file\n{table(rows)}\n{reports}'
