# SPDX-License-Identifier: Apache-2.0
"""The workflow: simulate the belief, locate the gap, name what is missing, add it, show that the gap shrank."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.core.errors import NoAnswerError
from trainid_ros.core.plural import pluralise
from trainid_ros.explain.believed_effects import together, without_replaced
from trainid_ros.explain.dataset import assemble
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.explanation import (
    Explanation,
    FoundEffect,
    Likeness,
    NoiseLevels,
    RunTrace,
    Verdict,
)
from trainid_ros.explain.gap_location import locate, where
from trainid_ros.explain.gradient_reference import read_at
from trainid_ros.explain.holdout import gap_of, hold_out
from trainid_ros.explain.model import EffectTerm, Model
from trainid_ros.explain.nuisances import DAVIS
from trainid_ros.explain.onset import with_onsets
from trainid_ros.explain.selection import LEFT_OVER, NAMELESS, Search
from trainid_ros.explain.slip import find_slip
from trainid_ros.train.effects import EFFECTS
from trainid_ros.train.train_file import Davis, Effect

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.explanation import Gap, Location
    from trainid_ros.explain.holdout import HeldOut
    from trainid_ros.explain.marginal_likelihood import Hyperparameters
    from trainid_ros.explain.run_data import Run
    from trainid_ros.explain.selection import Selection
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

_FEWEST_SAMPLES: Final = 200
SEARCHED_S: Final = 3000.0
"""Of longer drives, so much is searched for effects [s]."""
COMPARED_S: Final = 12000.0
"""Of longer drives, so much tells the parameters of effects and the gap [s], so that time and memory are bounded."""
# The equations of real effects differ a little from those of the library, and clocks are read at 5 Hz.
_EQUATION_SHARE: Final = 0.03
# Gusts, loads and maps are nowhere so far from what they usually are; see Evidence.excess.
_MOST_EXCESS: Final = 14.0
# Beside effects with evidence of their own, they may be worse.
_MOST_EXCESS_NAMED: Final = 30.0
# No effect is so many times as large as it usually is.
_MOST_USUAL: Final = 12.0
_WORSE: Final = 1.1
"""Effects that make runs held out so much worse are not told, whatever their evidence."""
_CLOCK_S: Final = 0.04


def _quiet(_: str) -> None:
    pass


def explain(
    runs: Sequence[Run], train_file: TrainFile, *, provenance: str = '', advance: Callable[[str], None] = _quiet
) -> Explanation:
    """Find what a believed model lacks.

    Args:
        runs: Runs from station to station, of one or more bags.
        train_file: What is believed.
        provenance: Where added effects come from, for the train file.
        advance: Called with the name of what is being done.

    Raises:
        NoAnswerError: There is too little motion.

    """
    if sum(run.time.size for run in runs) < _FEWEST_SAMPLES:
        msg = f'{pluralise(len(runs), "run")} from stop to stop: too little motion to compare'
        raise NoAnswerError(msg)
    compared = _some(runs, COMPARED_S)
    search = _search(compared, train_file, advance)
    if point := search.gradient_point():
        compared = read_at(point, compared, train_file.train.length)
        search = _search(compared, train_file, advance)
    selection = search.run()
    if (rest := without_replaced(selection.final.model.terms, train_file)) is not None:
        return explain(runs, rest, provenance=provenance, advance=advance)
    slip = find_slip(search.base.model.dataset)
    advance('held-out runs')
    proof = _prove(selection, compared, train_file, slipping=slip is not None)
    advance('places')
    locations = locate(proof.base, proof.final, proof.hyper)
    found = [] if proof.verdict is Verdict.UNEXPLAINED else _found(selection, proof.final, locations)
    if slip is not None:
        found.append(_effect(*slip, (), 'bursts under traction and braking'))
    davis, davis_std = _davis(proof.final, proof.hyper)
    added = tuple(Effect(e.name, e.parameters, e.std, provenance) for e in found)
    return Explanation(
        verdict=proof.verdict,
        effects=tuple(found),
        gap=proof.gap,
        remaining=proof.remaining,
        train_file=replace(train_file, resistance=davis, effects=together(train_file.effects, added)),
        davis_std=davis_std,
        locations=locations,
        traces=_traces(proof),
        noise=_noise(proof.hyper),
        outliers=float(np.mean(proof.base.dataset.outlier)),
        weighed=proof.final.weighed,
        gradient_point=point,
    )


@dataclass(frozen=True, slots=True)
class _Proof:
    """What can be told, and what shows it.

    Attributes:
        verdict: Outcome.
        remaining: On what the rest of the gap depends.
        hyper: Sizes of noise and nuisances.
        base: Model without effects, of all runs compared.
        final: Model with those that are told.
        before: Gaps of runs held out, without effects; None with too few runs.
        after: The same with them.

    """

    verdict: Verdict
    remaining: str
    hyper: Hyperparameters
    base: Model
    final: Model
    before: HeldOut | None
    after: HeldOut | None

    @property
    def gap(self) -> Gap | None:
        """The gap before and after; None with too few runs."""
        return gap_of(self.before, self.after, self.final)


def _prove(selection: Selection, runs: Sequence[Run], train_file: TrainFile, *, slipping: bool) -> _Proof:
    """Return the verdict on what was selected, with all runs compared."""
    verdict = _verdict(selection, slipping=slipping)
    # Effects that do not fit are not told, and nothing is calculated with them.
    reported = selection.base if verdict is Verdict.UNEXPLAINED else selection.final
    hyper, base, final = reported.hyper, selection.base.model, reported.model
    if len(base.dataset.runs) < len(runs):
        base = Model(_evaluator(runs, train_file), train_file)
        final = with_onsets(base.having(reported.model.terms).fit(hyper), hyper)
    before = hold_out(base, hyper)
    proof = _Proof(verdict, _remaining(selection, verdict), hyper, base, final, before, hold_out(final, hyper))
    if (gap := proof.gap) is None or gap.after <= _WORSE * gap.before:
        return proof
    # Whatever the likelihood says, runs that the fit never saw are not simulated better.
    return _Proof(Verdict.UNEXPLAINED, _no_better(final, gap), hyper, base, base, before, before)


def _search(runs: Sequence[Run], train_file: TrainFile, advance: Callable[[str], None]) -> Search:
    """Return the search in as many of the runs as are looked into for effects."""
    return Search(Model(_evaluator(_some(runs, SEARCHED_S), train_file), train_file), advance)


def _evaluator(runs: Sequence[Run], train_file: TrainFile) -> EffectEvaluator:
    """Return runs with what is believed of effects taken into account."""
    evaluator = EffectEvaluator(assemble(runs, train_file), train_file)
    if not train_file.effects:
        return evaluator
    return EffectEvaluator(assemble(runs, train_file, evaluator.total(train_file.effects)), train_file)


def _some(runs: Sequence[Run], seconds: float) -> Sequence[Run]:
    """Return all runs, or so many of them, spread evenly, that they last so long."""
    driven = sum(float(run.time[-1] - run.time[0]) for run in runs)
    if driven <= seconds:
        return runs
    count = math.ceil(len(runs) * seconds / driven)
    places = np.linspace(0, len(runs) - 1, count).round().astype(int)
    return [runs[i] for i in places.tolist()]


def _verdict(selection: Selection, *, slipping: bool) -> Verdict:
    nameless = selection.groups[0].evidence if selection.groups else 0.0
    if nameless > max(NAMELESS, LEFT_OVER * sum(selection.evidence)) or not _credible(selection, slipping=slipping):
        return Verdict.UNEXPLAINED
    if not selection.evidence:
        return Verdict.EXPLAINED if slipping else Verdict.NO_GAP
    return Verdict.AMBIGUOUS if any(selection.twins) else Verdict.EXPLAINED


def _credible(selection: Selection, *, slipping: bool) -> bool:
    """Return False where effects were stretched beyond what they can be, or noise beyond what it is anywhere.

    Bursts of slip are no gusts, but look like them.
    """
    terms = selection.final.model.terms
    most = _MOST_EXCESS_NAMED if terms else _MOST_EXCESS
    usual = slipping or selection.final.excess < most
    return usual and all(term.size < _MOST_USUAL for term in terms)


def _found(selection: Selection, model: Model, locations: tuple[Location, ...]) -> list[FoundEffect]:
    rows = sorted(zip(model.terms, selection.evidence, selection.twins, strict=True), key=lambda row: -row[1])
    evaluator, dataset = model.evaluator, model.dataset
    return [
        _effect(term, evidence, twins, where(evaluator.resistance(term.name, term.parameters), dataset, locations))
        for term, evidence, twins in rows
    ]


def _effect(term: EffectTerm, evidence: float, twins: Sequence[str], place: str) -> FoundEffect:
    kind = EFFECTS[term.name]
    drives = {twin.name: twin.drive for twin in kind.twins}
    likenesses = tuple(Likeness(name, drives.get(name, kind.needs)) for name in twins)
    parameters = tuple((name, float(value)) for name, value in term.parameters.items())
    std = tuple((name, _total_std(term, name, value)) for name, value in term.std.items())
    return FoundEffect(
        kind.name, kind.title, kind.equation, kind.origin, parameters, std, float(evidence), place, likenesses
    )


def _total_std(term: EffectTerm, name: str, std: float) -> float:
    """Return a standard deviation that knows that equations and clocks are not exact either."""
    kind = EFFECTS[term.name]
    off = term.parameters[name] - (kind.neutral if name == kind.amplitude else 0.0)
    # Places and times of day are no sizes.
    sized = name == kind.amplitude or (kind.parameters[name].unit != 'm' and kind.parameters[name].search is not None)
    equation = _EQUATION_SHARE * off if sized else 0.0
    clock = _CLOCK_S if kind.parameters[name].unit == 's' else 0.0
    return math.sqrt(std * std + equation * equation + clock * clock)


def _davis(model: Model, hyper: Hyperparameters) -> tuple[Davis, tuple[float, float, float]]:
    """Return a, b, c as found together with the effects; what a train file cannot hold is cut off."""
    mean, covariance = model.posterior(hyper, model.whitener(hyper))
    std = np.sqrt(np.diag(covariance)[DAVIS]).tolist()
    return model.found_davis(mean), (std[0], std[1], std[2])


def _remaining(selection: Selection, verdict: Verdict) -> str:
    strongest = selection.groups[0] if selection.groups else None
    if strongest is not None and strongest.evidence >= NAMELESS:
        size = 'depends' if verdict is Verdict.UNEXPLAINED else 'depends a little'
        return f'The rest of the gap {size} on {strongest.text}, and no effect of the library fits it.'
    if verdict is Verdict.UNEXPLAINED:
        return f'Forces that nobody measured are larger than noise can be: {_unusual(selection.final.hyper)}.'
    return 'What is left is noise: gusts, errors of the map and of the sensors.'


def _no_better(model: Model, gap: Gap) -> str:
    """Return why effects with evidence are not told."""
    names = ' and '.join(sorted({term.name for term in model.terms}))
    return (
        f'What looks like {names} does not hold: runs that the fit never saw would be simulated worse with it '
        f'({gap.before:.3f} to {gap.after:.3f} m/s).'
    )


def _unusual(hyper: Hyperparameters) -> str:
    """Return the sizes that passing forces, loads, brakes and maps would need to have, in words."""
    noise, spread = hyper.noise, hyper.spread
    return (
        f'gusts of {noise.gust:.2f} N/kN that last {noise.gust_time:.0f} s, loads off by {spread.payload:.1%}, '
        f'brakes by {spread.brake:.1%} from run to run, the map by {spread.map:.2f} per mille'
    )


def _traces(proof: _Proof) -> tuple[RunTrace, ...]:
    """Return all runs with their gaps for plots."""
    model, before, after = proof.final, proof.before, proof.after
    dataset = model.dataset
    position, speed = dataset.average(dataset.joined('position')), dataset.average(dataset.speed)
    nothing = np.full(model.residual.size, np.nan)
    gaps = [nothing if held is None else held.gap for held in (before, after)]
    band = nothing if after is None else after.std
    traces = []
    for k, run in enumerate(dataset.runs):
        at = (dataset.node_run == k) & (dataset.node_count > 0.0)
        time = dataset.node_time[at] - run.time[0]
        traces.append(
            RunTrace(run.bag, run.direction, time, position[at], speed[at], gaps[0][at], gaps[1][at], band[at])
        )
    return tuple(traces)


def _noise(hyper: Hyperparameters) -> NoiseLevels:
    noise, spread = hyper.noise, hyper.spread
    return NoiseLevels(noise.speed, noise.gust, noise.gust_time, spread.payload, spread.brake, spread.map)
