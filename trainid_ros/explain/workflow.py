# SPDX-License-Identifier: Apache-2.0
"""The workflow: simulate the current model, locate the gap, identify missing effects, add them, validate the result."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.distinguishing import FitSummary, distinguishing_drive
from trainid_ros.explain.effects import EffectTerm, merged, without_replaced
from trainid_ros.explain.model import Model, find_slip, read_at
from trainid_ros.explain.noise import DAVIS
from trainid_ros.explain.proof import assess, locate, where
from trainid_ros.explain.result import (
    Alternative,
    Explanation,
    FoundEffect,
    Location,
    NoiseLevels,
    RunTrace,
    Verdict,
)
from trainid_ros.explain.search import Search, Selection
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.interface.text import pluralise
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import Davis, Effect

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Run
    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.explain.proof import Outcome
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

_MIN_SAMPLES: Final = 200
SEARCHED_S: Final = 3000.0
"""Maximum driving time that is searched for effects [s]."""
COMPARED_S: Final = 12000.0
"""Maximum driving time used to fit the effects and to measure the gap [s], to bound time and memory."""
# Relative error of parameters, since equations of real effects differ slightly from those of the library.
_EQUATION_SHARE: Final = 0.03
# Error of times [s]: time stamps are read at 5 Hz.
_CLOCK_S: Final = 0.04


def _quiet(_: str) -> None:
    pass


def explain(
    runs: Sequence[Run], train_file: TrainFile, *, provenance: str = '', advance: Callable[[str], None] = _quiet
) -> Explanation:
    """Find the effects that the model of a train file lacks.

    Args:
        runs: Runs from stop to stop, of one or more bags.
        train_file: Train file with the current model.
        provenance: Origin of added effects, for the train file.
        advance: Called with the name of each step.

    Raises:
        NoAnswerError: There is too little motion.
    """
    if sum(run.time.size for run in runs) < _MIN_SAMPLES:
        raise NoAnswerError(f'{pluralise(len(runs), "run")} from stop to stop: too little motion to compare')
    # 1. Data: runs simulated with the train file, and where on the train their gradients are read.
    compared = _some(runs, COMPARED_S)
    search = _search(compared, train_file, advance)
    if point := search.gradient_point():
        compared = read_at(point, compared, train_file.train.length)
        search = _search(compared, train_file, advance)
    # 2. Search: the effects that the marginal likelihood calls for, and what else explains the data as well.
    selection = search.run()
    if (rest := without_replaced(selection.final.model.terms, train_file)) is not None:
        return explain(runs, rest, provenance=provenance, advance=advance)
    slip = find_slip(search.base.model.dataset)
    # 3. Proof: the gap on runs that the fit has not seen, and the verdict.
    advance('held-out runs')
    outcome = assess(selection, compared, train_file, slipping=slip is not None)
    # 4. Location: where along position, speed, mode and time the gap lies.
    advance('places')
    locations = locate(outcome.base, outcome.final, outcome.hyper)
    found = [] if outcome.verdict is Verdict.UNEXPLAINED else _found(selection, outcome, locations, train_file)
    if slip is not None:
        found.append(_effect(*slip, (), 'bursts under traction and braking'))
    # 5. Result: the train file with the effects added, and the numbers of the report.
    return _result(outcome, train_file, found, locations, point, provenance)


def _result(
    outcome: Outcome,
    train_file: TrainFile,
    found: Sequence[FoundEffect],
    locations: tuple[Location, ...],
    point: str | None,
    provenance: str,
) -> Explanation:
    davis, davis_std = _davis(outcome.final, outcome.hyper)
    added = tuple(Effect(e.name, e.parameters, e.std, provenance) for e in found)
    return Explanation(
        verdict=outcome.verdict,
        effects=tuple(found),
        gap=outcome.gap,
        remaining=outcome.remaining,
        train_file=replace(train_file, resistance=davis, effects=merged(train_file.effects, added)),
        davis_std=davis_std,
        locations=locations,
        traces=_traces(outcome),
        noise=_noise(outcome.hyper),
        outliers=float(np.mean(outcome.base.dataset.outlier)),
        weighed=outcome.final.weighed,
        gradient_point=point,
    )


def _search(runs: Sequence[Run], train_file: TrainFile, advance: Callable[[str], None]) -> Search:
    """Return the search over a subset of the runs of at most :data:`SEARCHED_S`."""
    return Search(Model.of(_some(runs, SEARCHED_S), train_file), advance)


def _some(runs: Sequence[Run], seconds: float) -> Sequence[Run]:
    """Return all runs, or an evenly spaced subset that lasts about ``seconds``."""
    driven = sum(float(run.time[-1] - run.time[0]) for run in runs)
    if driven <= seconds:
        return runs
    count = math.ceil(len(runs) * seconds / driven)
    places = np.linspace(0, len(runs) - 1, count).round().astype(int)
    return [runs[i] for i in places.tolist()]


def _found(
    selection: Selection, outcome: Outcome, locations: tuple[Location, ...], train_file: TrainFile
) -> list[FoundEffect]:
    model = outcome.final
    rows = sorted(zip(model.terms, selection.evidence, selection.twins, strict=True), key=lambda row: -row[1])
    evaluator, dataset = model.evaluator, model.dataset
    known = FitSummary(train_file, *_davis(model, outcome.hyper), outcome.hyper)
    return [
        _effect(
            term,
            evidence,
            tuple(Alternative(name, _drive(term, name, known)) for name in twins),
            where(evaluator.resistance(term.name, term.parameters), dataset, locations),
        )
        for term, evidence, twins in rows
    ]


def _drive(term: EffectTerm, twin: str, known: FitSummary) -> str:
    """Return the test run that would distinguish an effect from its twin, with a drive that does it if there is one."""
    kind = EFFECTS[term.name]
    text = {item.name: item.drive for item in kind.twins}.get(twin, kind.needs)
    drive = distinguishing_drive(term.name, term.parameters, twin, known)
    return f'{text}; for example {drive}' if drive else text


def _effect(term: EffectTerm, evidence: float, alternatives: tuple[Alternative, ...], place: str) -> FoundEffect:
    kind = EFFECTS[term.name]
    parameters = tuple((name, float(value)) for name, value in term.parameters.items())
    std = tuple((name, _total_std(term, name, value)) for name, value in term.std.items())
    return FoundEffect(
        kind.name, kind.title, kind.equation, kind.origin, parameters, std, float(evidence), place, alternatives
    )


def _total_std(term: EffectTerm, name: str, std: float) -> float:
    """Return a standard deviation that includes the errors of equations and clocks."""
    kind = EFFECTS[term.name]
    off = term.parameters[name] - (kind.neutral if name == kind.amplitude else 0.0)
    # Positions and times have no relative error.
    sized = name == kind.amplitude or (kind.parameters[name].unit != 'm' and kind.parameters[name].search is not None)
    equation = _EQUATION_SHARE * off if sized else 0.0
    clock = _CLOCK_S if kind.parameters[name].unit == 's' else 0.0
    return math.sqrt(std * std + equation * equation + clock * clock)


def _davis(model: Model, hyper: Hyperparameters) -> tuple[Davis, tuple[float, float, float]]:
    """Return a, b, c as estimated with the effects, with their std; negative a and c are set to zero."""
    mean, covariance = model.posterior(hyper)
    std = np.sqrt(np.diag(covariance)[DAVIS]).tolist()
    return model.found_davis(mean), (std[0], std[1], std[2])


def _traces(outcome: Outcome) -> tuple[RunTrace, ...]:
    """Return all runs with their gaps for plots."""
    model, before, after = outcome.final, outcome.before, outcome.after
    dataset = model.dataset
    position, speed = dataset.average(dataset.joined('position')), dataset.average(dataset.speed)
    nothing = np.full(model.residual.size, np.nan)
    gaps = [nothing if held is None else held.gap for held in (before, after)]
    band = nothing if after is None else after.std
    traces = []
    for k, run in enumerate(dataset.runs):
        at = (dataset.point_run == k) & (dataset.point_count > 0.0)
        time = dataset.point_time[at] - run.time[0]
        traces.append(
            RunTrace(run.bag, run.direction, time, position[at], speed[at], gaps[0][at], gaps[1][at], band[at])
        )
    return tuple(traces)


def _noise(hyper: Hyperparameters) -> NoiseLevels:
    noise, spread = hyper.noise, hyper.spread
    return NoiseLevels(noise.speed, noise.gust, noise.gust_time, spread.payload, spread.brake, spread.map)
