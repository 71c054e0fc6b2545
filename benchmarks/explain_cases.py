# SPDX-License-Identifier: Apache-2.0
"""Hidden cases of both generators in one form: input of the workflow, and truth for the scoring."""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from benchmarks import hidden_cases, hidden_cases_b
from trainid_ros.explain.dataset import RunCollector
from trainid_ros.explain.workflow import explain
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import parse_train_file

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.dataset import Run
    from trainid_ros.interface.records import Record
    from trainid_ros.train.train_file import NamedValues, TrainFile

Generator = Literal['A', 'B']
GENERATORS: Final[tuple[Generator, ...]] = ('A', 'B')
_CONTAMINATION_B: Final = {'outliers': 'outliers', 'dropouts': 'dropouts', 'slip_contamination': 'slip'}
CRASHED: Final = 'crashed'
"""Verdict of a case on which the workflow raised an exception."""


@dataclass(frozen=True, slots=True)
class Spec:
    """Identification of a case; generator, name and seed reproduce it."""

    generator: Generator
    name: str
    seed: int


@dataclass(frozen=True, slots=True)
class HiddenEffect:
    name: str  # Its name
    parameters: tuple[tuple[str, float], ...]  # (name, value) of those that an estimate may be compared with
    near: tuple[str, ...]  # For effects outside the library, acceptable generic names
    visible: float  # How much it raises the gap over the noise floor [%]


@dataclass(frozen=True, slots=True)
class Answer:
    kind: str  # none, single, pair or outside
    effects: tuple[HiddenEffect, ...]  # What is hidden
    visible: float  # How much all effects raise the gap over the noise floor [%]
    floor: float  # RMS speed gap of the true model due to noise, by the generator [m/s]
    one_way: bool  # All runs go up the line
    contamination: tuple[str, ...]  # Any of outliers, dropouts, slip
    flags: tuple[str, ...]  # Names of further circumstances


@dataclass(frozen=True, slots=True)
class Opened:
    """A generated case; the workflow gets only the train file and the bags."""

    train_yaml: str
    bags: tuple[tuple[Record, ...], ...]
    answer: Answer


def draw_specs(generator: Generator, seed: int, count: int) -> tuple[Spec, ...]:
    draw = hidden_cases.draw_cases if generator == 'A' else hidden_cases_b.draw_cases
    return tuple(Spec(generator, name, of_case) for name, of_case in draw(seed, count))


def open_case(spec: Spec) -> Opened:
    return _case_a(spec) if spec.generator == 'A' else _case_b(spec)


def _case_a(spec: Spec) -> Opened:
    case = hidden_cases.make_case(spec.name, spec.seed)
    truth = case.truth
    effects = tuple(
        HiddenEffect(effect.name, effect.parameters if effect.comparable else (), effect.near, effect.visible_percent)
        for effect in truth.effects
    )
    flags = () if truth.mass_topic else ('no_mass_topic',)
    answer = Answer(truth.kind, effects, truth.visible_percent, truth.floor, truth.one_way, truth.contamination, flags)
    return Opened(case.train_yaml, case.bags, answer)


def _case_b(spec: Spec) -> Opened:
    case = hidden_cases_b.make_case(spec.name, spec.seed)
    truth = case.truth
    effects = tuple(
        HiddenEffect(
            name,
            tuple((key, truth.parameters[name][key]) for key in truth.exact[name]),
            hidden_cases_b.NEAR.get(name, ()),
            truth.visible_each[name],
        )
        for name in truth.effects
    )
    contamination = tuple(name for flag, name in _CONTAMINATION_B.items() if flag in truth.flags)
    flags = (truth.service, *(flag for flag in truth.flags if flag != 'one_way' and flag not in _CONTAMINATION_B))
    answer = Answer(truth.kind, effects, truth.visible, truth.floor, 'one_way' in truth.flags, contamination, flags)
    return Opened(case.train_yaml, case.bags, answer)


@dataclass(frozen=True, slots=True)
class Named:
    """An effect that the workflow added."""

    name: str
    parameters: NamedValues
    std: NamedValues
    evidence: float
    twins: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of the workflow on one case, with the truth."""

    spec: Spec  # The case
    answer: Answer  # The truth
    verdict: str  # Of the workflow, or ``CRASHED``
    found: tuple[Named, ...]  # Effects, strongest first
    gap: tuple[float, float, float] | None  # RMS gap before, after, floor [m/s]; None if no run was held out
    remaining: str  # What the remaining gap depends on, or the error message of a crash
    runs: int  # Number of runs
    explain_s: float  # CPU time of the workflow [s]


def try_case(spec: Spec) -> Outcome:
    """Generate a case and explain it; a crash of the workflow is an outcome too."""
    return explain_case(spec, open_case(spec))


def explain_case(spec: Spec, opened: Opened) -> Outcome:
    assumed = parse_train_file(opened.train_yaml, 'assumed train file')
    runs = runs_of(opened.bags, assumed)
    start = time.process_time()
    verdict, found, gap = CRASHED, list[Named](), None
    try:
        explanation = explain(runs, assumed)
    except Exception as error:  # A benchmark of hundreds of cases must report failures, not stop at one.
        frame = traceback.extract_tb(error.__traceback__)[-1]
        remaining = f'{type(error).__name__}: {error} ({frame.name}, line {frame.lineno})'
    else:
        verdict, remaining = explanation.verdict.value, explanation.remaining
        for one in explanation.effects:
            twins = tuple(twin.name for twin in one.twins)
            found.append(Named(one.name, one.parameters, one.std, one.evidence, twins))
        if explanation.gap is not None:
            gap = explanation.gap.before, explanation.gap.after, explanation.gap.noise_floor
    explain_s = time.process_time() - start
    return Outcome(spec, opened.answer, verdict, tuple(found), gap, remaining, len(runs), explain_s)


def runs_of(bags: Sequence[Sequence[Record]], assumed: TrainFile) -> tuple[Run, ...]:
    """Return the runs of all bags, with the aligner and collector of the command."""
    runs: list[Run] = []
    origin = 0
    for number, records in enumerate(bags):
        aligner, collector = Aligner(AlignmentConfig()), RunCollector(assumed, number, origin)
        for record in records:
            for event in aligner.push(record):
                if isinstance(event, Sample):
                    collector.add(event)
                elif isinstance(event, TimeJump):
                    collector.end_run()
        collector.end_run()
        origin = origin or collector.origin_ns
        runs += collector.runs
    return tuple(runs)
