# SPDX-License-Identifier: Apache-2.0
"""The workflow: simulate the current model, locate the gap, identify missing effects, add them, validate the result.

Where an effect is confused with another, the workflow names a drive that tells them apart, if driving on level,
straight track can. The information on the amplitude A of an effect comes from the speeds of a planned run, linear in
what is not known: A, the sizes of all other effects, a, b, c, the payload and the brake. With C the derivatives of the
speeds by them, and R the covariance of integrated gusts, map errors and speed noise, it is I = C' R^-1 C; the inverse
has the variance of A.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.explain.curve import learn
from trainid_ros.explain.effects import SHOWN, EffectTerm, merged, without_replaced
from trainid_ros.explain.likelihood import integrated_covariance
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
from trainid_ros.interface.records import KM_H
from trainid_ros.interface.text import pluralise
from trainid_ros.resistance.suggested_drive import STEP_S, Manoeuvre, plan_run, planned_runs
from trainid_ros.train.effects import EFFECTS, TrackPoint, Twin
from trainid_ros.train.forces import davis as resistance_of
from trainid_ros.train.forces import specific_inertia
from trainid_ros.train.train_file import Davis, Effect

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from trainid_ros.explain.dataset import Array, Run
    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.explain.proof import Outcome
    from trainid_ros.resistance.suggested_drive import Run as PlannedRun
    from trainid_ros.train.effects import EffectKind
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


_COUNTS: Final = {1: 'once', 2: 'twice', 3: '3 times'}  # Numbers of times that one run is driven
_STEPS: Final = 5  # Steps of a plan whose speeds are averaged to one


@dataclass(frozen=True, slots=True)
class FitSummary:
    """What a fit has found: the train file, a, b, c with their standard deviations, noise and nuisances."""

    train_file: TrainFile
    davis: Davis
    davis_std: tuple[float, float, float]
    hyper: Hyperparameters


def distinguishing_drive(
    name: str, parameters: Mapping[str, float], twin: str, fit: FitSummary, others: Sequence[EffectTerm] = ()
) -> str:
    """Return the shortest drive that tells an effect as found from a twin of any size, with its std; '' if none.

    ``others`` are further effects in the model, whose sizes are not known either.
    """
    kind, other = EFFECTS[name], EFFECTS[twin]
    shape = _typical(other)
    if kind.resistance is None or other.resistance is None or shape is None:
        return ''
    size = abs(parameters[kind.amplitude] - kind.neutral)
    found: list[tuple[float, PlannedRun, int, float]] = []
    # Beside the usual manoeuvres, slow speeds are held for a minute.
    slow = (plan_run(Manoeuvre(v, v, 60.0), fit.train_file, fit.davis) for v in (5.0 / KM_H, 10.0 / KM_H))
    for run in chain(planned_runs(fit.train_file, fit.davis), (run for run in slow if run is not None)):
        motion = _Motion.of(run, fit)
        rivals = (other, shape), *((term.kind, term.parameters) for term in others)
        effect = motion.resistances(kind, parameters, fit.davis) / max(size, 1e-12)
        effects = effect, *(motion.resistances(*rival, fit.davis) for rival in rivals)
        information = _information(motion, effects, fit)
        for times in _COUNTS:
            std = _std(times * information, fit)
            if size >= 4.0 * std:  # then the two are distinguished
                found.append((times * run.duration_s, run, times, std))
    if not found:
        return ''
    _, run, times, std = min(found, key=lambda item: item[0])
    unit = kind.parameters[kind.amplitude].unit
    length = f'{times * run.length_m / 1000.0:.1f} km'
    return f'{run.manoeuvre.text} {_COUNTS[times]} ({length}): {kind.amplitude} ± {std:.2g}{f" {unit}" if unit else ""}'


def _typical(kind: EffectKind) -> dict[str, float] | None:
    """Return parameters of typical size and shape; None for an effect at a place or time of its own."""
    values = {kind.amplitude: kind.neutral + kind.typical_size}
    for name in kind.shape:
        parameter = kind.parameters[name]
        if parameter.search is None:
            return None
        low, high = parameter.search
        values[name] = math.sqrt(low * high) if parameter.grid == 'log' else 0.5 * (low + high)
    return values


class _Motion(NamedTuple):
    """Motion of a planned run from stop to stop, at the end of each step, shapes (n,)."""

    speed: Array  # [m/s]
    traction: Array  # Mean reported traction [N/kN]
    brake: Array  # Braking force [N/kN, <= 0]
    rate: Array  # Acceleration [m/s^2]

    @classmethod
    def of(cls, run: PlannedRun, fit: FitSummary) -> _Motion:
        """Return the motion of a run with a, b, c of a fit."""
        speed, pulled = np.array(run.speeds), np.array([step.traction for step in run.steps])
        rate, braked = np.diff(speed, prepend=speed[0]) / STEP_S, len(run.braking)
        force = specific_inertia(1.0, fit.train_file.train.rotary_mass) * rate + resistance_of(fit.davis, speed)
        brake = np.append(np.zeros(pulled.size), np.minimum(force[pulled.size :], 0.0))
        return cls(speed, np.append(pulled, np.zeros(braked)), brake, rate)

    def resistances(self, kind: EffectKind, parameters: Mapping[str, float], davis: Davis) -> Array:
        """Return the resistance of an effect at each step [N/kN], shape (n,)."""
        resistance = kind.resistance or (lambda *_: 0.0)
        return np.array([resistance(parameters, davis, self._point(k)) for k in range(self.speed.size)])

    def _point(self, k: int) -> TrackPoint:
        def before(force: Array, seconds: float) -> float:
            return float(force[min(max(k - round(seconds / STEP_S), 0), force.size - 1)])

        traction, brake = (partial(before, force) for force in (self.traction, self.brake))
        return TrackPoint(
            k * STEP_S, math.nan, 1, float(self.speed[k]),
            distance_run=1e6,  # the bearings are warm
            since_release=0.0 if self.brake[k] else k * STEP_S, traction=traction(0.0), brake=brake(0.0),
            acceleration=float(self.rate[k]), brake_before=brake, traction_before=traction,
        )  # fmt: skip


def _information(motion: _Motion, effects: Sequence[Array], fit: FitSummary) -> Array:
    """Return the information of a run on [effects, a, b, c, payload, brake], the initial speed not known, (n, n)."""
    v, traction, brake = motion.speed, motion.traction, motion.brake
    pulls = np.stack((*effects, np.ones_like(v), v, v * v, -traction, -brake), axis=1)
    hyper, m = fit.hyper, specific_inertia(1.0, fit.train_file.train.rotary_mass)
    at = slice(_STEPS - 1, None, _STEPS)
    C = np.concatenate((-np.cumsum(pulls, axis=0) * STEP_S / m, np.ones((len(v), 1))), axis=1)[at]
    t: Array = np.arange(1.0, len(v) + 1.0)[at] * STEP_S
    noise = hyper.noise
    map_time = 250.0 / max(float(v.mean()), 1.0)  # correlation length of map errors [m]
    gusts = (noise.gust * noise.gust_time) ** 2 * integrated_covariance(t, noise.gust_time)
    errors_of_map = (hyper.spread.map * map_time) ** 2 * integrated_covariance(t, map_time)
    R = (gusts + errors_of_map) / (m * m) + noise.speed**2 / (_STEPS * 2.0) * np.eye(t.size)  # two samples a step
    full = C.T @ np.linalg.solve(R, C)
    start = full[:-1, -1]
    return np.asarray(full[:-1, :-1] - np.outer(start, start) / full[-1, -1])


def _std(information: Array, fit: FitSummary) -> float:
    """Return the standard deviation of A after runs with this information, all else as unknown as a priori."""
    spread = fit.hyper.spread
    known = np.maximum([*(3.0 * x for x in fit.davis_std), spread.payload, spread.brake], 1e-6)  # for a finite inverse
    # The other effects may have ten times their typical amplitudes, and would change a, b, c too.
    stds = np.append(np.full(len(information) - 1 - known.size, 10.0), known)
    prior = np.concatenate(([0.0], stds**-2.0))
    total = information + np.diag(prior)
    left = total[0, 0] - total[0, 1:] @ np.linalg.solve(total[1:, 1:], total[1:, 0])
    return 1.0 / math.sqrt(left) if left > 0.0 else math.inf
