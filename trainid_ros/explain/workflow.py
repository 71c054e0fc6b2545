# SPDX-License-Identifier: Apache-2.0
"""The workflow: simulate the current model, locate the gap, identify missing effects, add them, validate the result."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.curve import learn
from trainid_ros.explain.distinguishing_drive import FitSummary, distinguishing_drive
from trainid_ros.explain.effects import SHOWN, EffectTerm, merged, without_replaced
from trainid_ros.explain.model import Model, Slip, find_slip, read_at
from trainid_ros.explain.nuisances import DAVIS
from trainid_ros.explain.proof import NEAR, assess, leaves_more_than_noise, locate, unexplained, weakest, where
from trainid_ros.explain.result import (
    Explanation,
    FoundEffect,
    Learned,
    Location,
    Probabilities,
    RunTrace,
    Verdict,
    dependence,
    noise_floor,
    probabilities,
)
from trainid_ros.explain.search import Search, Selection
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.interface.text import pluralise
from trainid_ros.train.effects import EFFECTS, Twin
from trainid_ros.train.train_file import Davis, Effect

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from trainid_ros.explain.dataset import Run
    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.explain.proof import Outcome
    from trainid_ros.train.train_file import TrainFile

_MAX_SEARCHED_S: Final = 3000.0  # Maximum driving time that is searched for effects [s]


def explain(
    runs: Sequence[Run],
    train_file: TrainFile,
    *,
    provenance: str = '',
    advance: Callable[[str], None] = lambda _: None,
    stated: TrainFile | None = None,
) -> Explanation:
    """Find the effects that the model of a train file lacks.

    Args:
        runs: Runs from stop to stop, of one or more bags.
        train_file: Train file with the current model.
        provenance: Origin of added effects, for the train file.
        advance: Called with the name of each step.
        stated: Train file whose gap is stated, if not the same.

    Raises:
        NoAnswerError: There is too little motion.
    """
    if sum(run.time.size for run in runs) < 200:
        raise NoAnswerError(f'{pluralise(len(runs), "run")} from stop to stop: too little motion to compare')
    # 1. Data: runs simulated with the train file, and where on the train their gradients are read.
    compared = _some(runs, 12000.0)  # s of driving, to bound time and memory
    search = Search(Model.of(_some(compared, _MAX_SEARCHED_S), train_file), advance)
    if point := search.gradient_point():
        compared = read_at(point, compared, train_file.train.length)
        search = Search(Model.of(_some(compared, _MAX_SEARCHED_S), train_file), advance)
    # 2. Search: the effects that the marginal likelihood calls for, and what else explains the data as well.
    if (slip := find_slip(search.base.model.dataset)) is not None and slip.evidence <= SHOWN:
        slip = None
    selection = search.run(slipping=slip is not None)
    if (rest := without_replaced(selection.final.model.terms, train_file)) is not None:
        return explain(runs, rest, provenance=provenance, advance=advance, stated=train_file)
    # 3. Proof: the gap on runs that the fit has not seen, and the verdict.
    advance('held-out runs')
    outcome = assess(selection, compared, train_file, stated or train_file, slip)
    while (k := weakest(outcome)) is not None:
        selection = selection.without(k)
        outcome = assess(selection, compared, train_file, stated or train_file, slip)
    # 4. Curve: what the missing force depends on where nothing of the library fits it.
    outcome, learned = _with_curve(selection, outcome, provenance, advance, slipping=slip is not None)
    causes = _causes(selection, slip, learned)
    if outcome.verdict is Verdict.UNEXPLAINED and not _shows_gap(selection, outcome, learned):
        outcome, learned = _without_gap(outcome, learned, slipping=slip is not None), None
    # 5. Location: where along position, speed, mode and time the gap lies.
    advance('places')
    locations = locate(outcome.base, outcome.final, outcome.hyper)
    davis, davis_std, davis_distance = _davis(outcome.final, outcome.hyper)
    fit = FitSummary(train_file, davis, davis_std, outcome.hyper)
    found = _found(selection, outcome, causes, fit) if outcome.terms else []
    if slip is not None:
        found.append(_effect(slip.term, slip.evidence, causes, (), 'bursts under traction and braking'))
    # 6. Result: the train file with the effects added, and the numbers of the report.
    gap, added = outcome.gap, tuple(Effect(e.name, e.parameters, e.std, provenance, e.runs) for e in found)
    return Explanation(
        verdict=outcome.verdict,
        effects=tuple(found),
        gap=gap and replace(gap, evidence=gap.evidence + (slip.evidence if slip else 0.0)),
        remaining=(learned.sentence if learned else outcome.remaining) + _odd_runs(outcome, learned, locations),
        train_file=replace(train_file, resistance=outcome.davis, effects=merged(train_file.effects, added)),
        davis=davis,
        davis_std=davis_std,
        davis_distance=davis_distance,
        locations=locations,
        traces=_traces(outcome),
        noise=outcome.hyper.noise,
        spread=outcome.hyper.spread,
        outliers=float(np.mean(outcome.base.dataset.outlier)),
        weighed=outcome.final.weighed,
        gradient_point=point,
        probabilities=causes.shares,
        other=causes.other,
        learned=learned,
    )


def _with_curve(
    selection: Selection, outcome: Outcome, provenance: str, advance: Callable[[str], None], *, slipping: bool
) -> tuple[Outcome, Learned | None]:
    """Return the outcome with the curve learned, None if none is or if the effects are better."""
    names, fits = selection.final.names, outcome.verdict is not Verdict.UNEXPLAINED
    # Effects with a place or time of their own only say where it is: a curve over something else may be more probable.
    is_placed = bool(names) and not slipping and all(EFFECTS[name].repeatable for name in names)
    if fits and not is_placed:
        return outcome, None
    advance('curves')
    learned = learn(selection.base, outcome.base, outcome.read, provenance)
    if not fits:
        return outcome, learned
    if learned is not None and _is_better(learned, selection, outcome):
        return unexplained(outcome, learned.sentence), learned
    return outcome, None


def _shows_gap(selection: Selection, outcome: Outcome, learned: Learned | None) -> bool:
    """Return whether the train file read leaves more than noise, by the floor of the model or of a confirmed curve.

    Noise beyond the usual may be what is missing, so its floor shows nothing. A curve over the number of the run cannot
    be tried on runs held out, so it counts as a gap.
    """
    gap, is_of_run = outcome.gap, learned is not None and learned.gap is None
    if gap is None or is_of_run or selection.base.excess > SHOWN:
        return True
    return gap.before > NEAR * noise_floor(gap, learned)


def _without_gap(outcome: Outcome, learned: Learned | None, *, slipping: bool) -> Outcome:
    """Return the outcome of a train file that leaves no gap, with what may still be missing."""
    verdict = Verdict.EXPLAINED if slipping else Verdict.NO_GAP
    found = learned.sentence if learned else outcome.remaining
    return replace(
        outcome, verdict=verdict, remaining=f'The gap is near what a correct train file leaves. Within it: {found}'
    )


def _is_better(learned: Learned, selection: Selection, outcome: Outcome) -> bool:
    """Return whether a curve is more probable than the effects selected, and better on runs held out."""
    if not learned.is_confirmed or learned.gap is None or outcome.gap is None:
        return False
    weights = [item.weight for item in selection.hypotheses if item.names == selection.final.names]
    return dependence((), learned.evidence).weight > max(weights) and learned.gap.after < outcome.gap.after


def _causes(selection: Selection, slip: Slip | None, learned: Learned | None) -> Probabilities:
    """Return the probabilities of causes."""
    compared = selection.hypotheses
    if learned is not None and slip is None:  # bursts of slip look like a dependence on the force
        compared = (*compared, dependence((), learned.evidence))
    return probabilities(compared, () if slip is None else (slip.term.name,))


def _odd_runs(outcome: Outcome, learned: Learned | None, locations: Sequence[Location]) -> str:
    """Return a sentence with the runs that differ by three standard deviations, if the gap may depend on the run."""
    if not (leaves_more_than_noise(outcome.gap) if learned is None else learned.name == 'run'):
        return ''
    places = [place for location in locations if location.axis == 'run' for place in location.places]
    odd = [f'{place.label} ({place.after:+.2f} N/kN)' for place in places if abs(place.after) > 3.0 * place.std]
    return f' It is that of {pluralise(len(odd), "run")}: {", ".join(odd)}.' if odd else ''


def _some(runs: Sequence[Run], seconds: float) -> Sequence[Run]:
    """Return all runs, or an evenly spaced subset that lasts about so many seconds."""
    driven = sum(float(run.time[-1] - run.time[0]) for run in runs)
    if driven <= seconds:
        return runs
    count = math.ceil(len(runs) * seconds / driven)
    places = np.linspace(0, len(runs) - 1, count).round().astype(int)
    return [runs[i] for i in places.tolist()]


def _found(selection: Selection, outcome: Outcome, causes: Probabilities, fit: FitSummary) -> list[FoundEffect]:
    """Return the effects of the model, the most evident first."""
    model, found = outcome.final, []
    rows = sorted(zip(outcome.terms, selection.evidence, selection.twins, strict=True), key=lambda row: -row[1])
    for term, evidence, twins in rows:
        others = [one for one in outcome.terms if one is not term]
        alternatives = [Twin(name, _test_run(term, name, others, fit)) for name in twins]
        if term.name == _MASS and not twins and _FORCES.isdisjoint(one.name for one in others):
            text = f'no drive does, as {1.0 / term.parameters["ratio"]:.3f} of both acts alike; weigh the train'
            alternatives = [Twin('+'.join(sorted(_FORCES)), text)]
        place = where(model.evaluator.resistance(term.name, term.parameters, runs=term.runs), model.dataset)
        found.append(_effect(term, evidence, causes, tuple(alternatives), place))
    return found


_MASS, _FORCES = (
    'mass_error',
    frozenset({'brake_scale', 'traction_scale'}),
)  # Both forces together act like another mass


def _test_run(term: EffectTerm, twin: str, others: Sequence[EffectTerm], fit: FitSummary) -> str:
    """Return what distinguishes an effect from a twin, beside the other effects of the model."""
    if _FORCES | {_MASS} <= {term.name, twin, *(one.name for one in others)}:
        return 'no drive does, as any two of mass, traction and brake act like the third; weigh the train'
    text = {item.name: item.drive for item in term.kind.twins}.get(twin, term.kind.needs)
    drive = distinguishing_drive(term.name, term.parameters, twin, fit, others)
    return f'{text}; for example {drive}' if drive else text


def _effect(
    term: EffectTerm, evidence: float, causes: Probabilities, alternatives: tuple[Twin, ...], place: str
) -> FoundEffect:
    kind = term.kind
    parameters = tuple((name, float(value)) for name, value in term.parameters.items())
    std = tuple((name, _total_std(term, name, value)) for name, value in term.std.items())
    of_kind = kind.name, kind.title, kind.equation, kind.origin
    sure = float(evidence), term.significance, causes.of(kind.name)
    return FoundEffect(*of_kind, parameters, std, *sure, place, alternatives, term.runs)


def _total_std(term: EffectTerm, name: str, std: float) -> float:
    """Return a standard deviation that includes the errors of equations and clocks."""
    kind, parameter = term.kind, term.kind.parameters[name]
    off = term.amount if name == kind.amplitude else term.parameters[name]
    # Equations of real effects differ slightly from those of the library; positions and times have no such error.
    sized = name == kind.amplitude or (parameter.unit != 'm' and parameter.search is not None)
    equation = 0.03 * off if sized else 0.0
    clock = 0.04 if parameter.unit == 's' else 0.0  # s: time stamps are read at 5 Hz
    return math.sqrt(std * std + equation * equation + clock * clock)


def _davis(model: Model, hyper: Hyperparameters) -> tuple[Davis, tuple[float, float, float], float]:
    """Return a, b, c as estimated, negative a and c as zero; their std; how many std all of them have moved."""
    mean, covariance = model.posterior(hyper)
    moved, of_davis = mean[DAVIS], covariance[DAVIS, DAVIS]
    std = np.sqrt(np.diag(of_davis)).tolist()
    return model.found_davis(mean), (std[0], std[1], std[2]), math.sqrt(moved @ np.linalg.solve(of_davis, moved))


def _traces(outcome: Outcome) -> tuple[RunTrace, ...]:
    dataset, read, held = outcome.final.dataset, outcome.read, outcome.after
    nothing = np.full(dataset.point_time.size, np.nan)
    columns = (
        dataset.average(dataset.joined('position')), dataset.average(dataset.speed),
        read, *((nothing, nothing) if held is None else (held.gap, held.std)),
    )  # fmt: skip
    traces = []
    for k, run in enumerate(dataset.runs):
        at = (dataset.point_run == k) & (dataset.point_count > 0.0)
        time = dataset.point_time[at] - run.time[0]
        traces.append(RunTrace(run.bag, run.direction, time, *(column[at] for column in columns)))
    return tuple(traces)
