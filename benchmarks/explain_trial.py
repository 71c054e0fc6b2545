# SPDX-License-Identifier: Apache-2.0
"""One hidden case through the workflow: its bags and the believed train file go in, what came out is kept."""

from __future__ import annotations

import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING, Final

from benchmarks.explain_cases import Answer, Opened, Spec, open_case
from trainid_ros.core.alignment import Aligner, AlignmentConfig, TimeJump
from trainid_ros.core.samples import Sample
from trainid_ros.explain.run_data import RunCollector
from trainid_ros.explain.workflow import explain
from trainid_ros.train.train_file import parse_train_file

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from trainid_ros.core.records import Record
    from trainid_ros.explain.explanation import Explanation, FoundEffect
    from trainid_ros.explain.run_data import Run
    from trainid_ros.train.train_file import NamedValues, TrainFile

CRASHED: Final = 'crashed'
"""Verdict of a case on which the workflow raised."""


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
    """What the workflow told of one case, beside the truth.

    Attributes:
        spec: Which case.
        answer: The truth.
        verdict: Of the workflow, or ``CRASHED``.
        found: Effects, strongest first.
        gap: RMS speed before, after, noise floor [m/s]; None where nothing could be held out.
        remaining: What the rest depends on, or how it crashed.
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
    """Yield outcomes in the order of completion; one job stays in this process."""
    if jobs == 1:
        yield from map(try_case, specs)
        return
    # Children start anew: a fork of a process with threads may hang.
    with ProcessPoolExecutor(jobs, mp_context=get_context('spawn')) as pool:
        for future in as_completed([pool.submit(try_case, spec) for spec in specs]):
            yield future.result()


def try_case(spec: Spec) -> Outcome:
    """Make a case and explain it; a crash of the workflow is an outcome too."""
    return explain_case(spec, open_case(spec))


def explain_case(spec: Spec, opened: Opened) -> Outcome:
    """Explain a case that is made."""
    believed = parse_train_file(opened.believed, 'believed')
    start = time.process_time()
    runs = runs_of(opened.bags, believed)
    aligned = time.process_time()
    told = _explained(runs, believed)
    times = (aligned - start, time.process_time() - aligned)
    if isinstance(told, str):
        return Outcome(spec, opened.answer, CRASHED, (), None, told, len(runs), *times)
    found = tuple(_one(effect) for effect in told.effects)
    return Outcome(spec, opened.answer, told.verdict.value, found, _gap(told), told.remaining, len(runs), *times)


def _explained(runs: Sequence[Run], believed: TrainFile) -> Explanation | str:
    """Return the explanation, or how the workflow crashed."""
    try:
        return explain(runs, believed)
    except Exception as error:  # A benchmark of hundreds of cases must tell which of them fail, not stop at one.
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return f'{type(error).__name__}: {error} ({frame.name}, line {frame.lineno})'


def runs_of(bags: Sequence[Sequence[Record]], believed: TrainFile) -> tuple[Run, ...]:
    """Return the runs of all bags, by the aligner and collector that the command uses."""
    runs: list[Run] = []
    origin = 0
    for number, records in enumerate(bags):
        aligner, collector = Aligner(AlignmentConfig()), RunCollector(believed, number, origin)
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


def _gap(told: Explanation) -> tuple[float, float, float] | None:
    return None if told.gap is None else (told.gap.before, told.gap.after, told.gap.noise_floor)
