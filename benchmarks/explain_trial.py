# SPDX-License-Identifier: Apache-2.0
"""Run the discrepancy workflow on one hidden case and keep its result with the truth."""

from __future__ import annotations

import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING, Final

from benchmarks.explain_cases import Answer, Opened, Spec, open_case
from trainid_ros.explain.dataset import RunCollector
from trainid_ros.explain.workflow import explain
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import parse_train_file

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from trainid_ros.explain.dataset import Run
    from trainid_ros.explain.result import Explanation, FoundEffect
    from trainid_ros.interface.records import Record
    from trainid_ros.train.train_file import NamedValues, TrainFile

CRASHED: Final = 'crashed'
"""Verdict of a case on which the workflow raised an exception."""


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
    """Result of the workflow on one case, with the truth.

    Attributes:
        spec: The case.
        answer: The truth.
        verdict: Of the workflow, or ``CRASHED``.
        found: Effects, strongest first.
        gap: RMS speed gap before, after, noise floor [m/s]; None if no run could be held out.
        remaining: What the remaining gap depends on, or the error message of a crash.
        runs: Number of runs.
        align_s: CPU time from records to runs [s].
        explain_s: CPU time of the workflow [s].

    """

    spec: Spec
    answer: Answer
    verdict: str
    found: tuple[Named, ...]
    gap: tuple[float, float, float] | None
    remaining: str
    runs: int
    align_s: float
    explain_s: float


def outcomes(specs: Sequence[Spec], jobs: int) -> Iterator[Outcome]:
    """Yield outcomes in the order of completion; one job runs in this process."""
    if jobs == 1:
        yield from map(try_case, specs)
        return
    # Spawn, because a fork of a process with threads may hang.
    with ProcessPoolExecutor(jobs, mp_context=get_context('spawn')) as pool:
        for future in as_completed([pool.submit(try_case, spec) for spec in specs]):
            yield future.result()


def try_case(spec: Spec) -> Outcome:
    """Generate a case and explain it; a crash of the workflow is an outcome too."""
    return explain_case(spec, open_case(spec))


def explain_case(spec: Spec, opened: Opened) -> Outcome:
    """Explain a generated case."""
    assumed = parse_train_file(opened.train_yaml, 'assumed train file')
    start = time.process_time()
    runs = runs_of(opened.bags, assumed)
    aligned = time.process_time()
    explanation = _explained(runs, assumed)
    times = (aligned - start, time.process_time() - aligned)
    if isinstance(explanation, str):
        return Outcome(spec, opened.answer, CRASHED, (), None, explanation, len(runs), *times)
    found = tuple(_one(effect) for effect in explanation.effects)
    return Outcome(
        spec,
        opened.answer,
        explanation.verdict.value,
        found,
        _gap(explanation),
        explanation.remaining,
        len(runs),
        *times,
    )


def _explained(runs: Sequence[Run], assumed: TrainFile) -> Explanation | str:
    """Return the explanation, or the error message if the workflow crashed."""
    try:
        return explain(runs, assumed)
    except Exception as error:  # A benchmark of hundreds of cases must report failures, not stop at one.
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return f'{type(error).__name__}: {error} ({frame.name}, line {frame.lineno})'


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


def _one(effect: FoundEffect) -> Named:
    twins = tuple(twin.name for twin in effect.twins)
    return Named(effect.name, effect.parameters, effect.std, effect.evidence, twins)


def _gap(explanation: Explanation) -> tuple[float, float, float] | None:
    return (
        None
        if explanation.gap is None
        else (explanation.gap.before, explanation.gap.after, explanation.gap.noise_floor)
    )
