# SPDX-License-Identifier: Apache-2.0
"""The workflow: simulate the belief, locate the gap, name what is missing, add it, show that the gap shrank."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.core.errors import NoAnswerError
from trainid_ros.core.plural import counted
from trainid_ros.discrepancy.belief import believed_otherwise, together
from trainid_ros.discrepancy.explanation import (
    Explanation,
    FoundEffect,
    Likeness,
    NoiseSizes,
    RunTrace,
    Verdict,
)
from trainid_ros.discrepancy.holdout import gap_of, hold_out
from trainid_ros.discrepancy.locate import locate, where
from trainid_ros.discrepancy.model import Member, Model
from trainid_ros.discrepancy.nodes import assemble
from trainid_ros.discrepancy.nuisances import DAVIS
from trainid_ros.discrepancy.onset import with_onsets
from trainid_ros.discrepancy.points import Points
from trainid_ros.discrepancy.reading import read_at
from trainid_ros.discrepancy.selection import LEFT_OVER, NAMELESS, Search
from trainid_ros.discrepancy.slip import find_slip
from trainid_ros.physics.effects import EFFECTS
from trainid_ros.physics.train_file import Davis, Effect

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from trainid_ros.discrepancy.explanation import Gap, Location
    from trainid_ros.discrepancy.holdout import HeldOut
    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.runs import Run
    from trainid_ros.discrepancy.selection import Selection
    from trainid_ros.physics.train_file import TrainFile

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
        msg = f'{counted(len(runs), "run")} from stop to stop: too little motion to compare'
        raise NoAnswerError(msg)
    compared = _some(runs, COMPARED_S)
    search = _search(compared, train_file, advance)
    if point := search.gradient_point():
        compared = read_at(point, compared, train_file.train.length)
        search = _search(compared, train_file, advance)
    selection = search.run()
    if (rest := believed_otherwise(selection.final.model.members, train_file)) is not None:
        return explain(runs, rest, provenance=provenance, advance=advance)
    slip = find_slip(search.base.model.drive)
    advance('held-out runs')
    proof = _prove(selection, compared, train_file, slipping=slip is not None)
    advance('places')
    locations = locate(proof.base, proof.final, proof.sizes)
    found = [] if proof.verdict is Verdict.UNEXPLAINED else _found(selection, proof.final, locations)
    if slip is not None:
        found.append(_effect(*slip, (), 'bursts under traction and braking'))
    davis, davis_std = _davis(proof.final, proof.sizes)
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
        noise=_noise(proof.sizes),
        outliers=float(np.mean(proof.base.drive.outlier)),
        weighed=proof.final.weighed,
        gradient_point=point,
    )


@dataclass(frozen=True, slots=True)
class _Proof:
    """What can be told, and what shows it.

    Attributes:
        verdict: Outcome.
        remaining: On what the rest of the gap depends.
        sizes: Sizes of noise and nuisances.
        base: Model without effects, of all runs compared.
        final: Model with those that are told.
        before: Gaps of runs held out, without effects; None with too few runs.
        after: The same with them.

    """

    verdict: Verdict
    remaining: str
    sizes: Sizes
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
    told = selection.base if verdict is Verdict.UNEXPLAINED else selection.final
    sizes, base, final = told.sizes, selection.base.model, told.model
    if len(base.drive.runs) < len(runs):
        base = Model(_points(runs, train_file), train_file)
        final = with_onsets(base.having(told.model.members).fit(sizes), sizes)
    before = hold_out(base, sizes)
    proof = _Proof(verdict, _remaining(selection, verdict), sizes, base, final, before, hold_out(final, sizes))
    if (gap := proof.gap) is None or gap.after <= _WORSE * gap.before:
        return proof
    # Whatever the likelihood says, runs that the fit never saw are not simulated better.
    return _Proof(Verdict.UNEXPLAINED, _no_better(final, gap), sizes, base, base, before, before)


def _search(runs: Sequence[Run], train_file: TrainFile, advance: Callable[[str], None]) -> Search:
    """Return the search in as many of the runs as are looked into for effects."""
    return Search(Model(_points(_some(runs, SEARCHED_S), train_file), train_file), advance)


def _points(runs: Sequence[Run], train_file: TrainFile) -> Points:
    """Return runs with what is believed of effects taken into account."""
    points = Points(assemble(runs, train_file), train_file)
    if not train_file.effects:
        return points
    return Points(assemble(runs, train_file, points.total(train_file.effects)), train_file)


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
    members = selection.final.model.members
    most = _MOST_EXCESS_NAMED if members else _MOST_EXCESS
    usual = slipping or selection.final.excess < most
    return usual and all(member.size < _MOST_USUAL for member in members)


def _found(selection: Selection, model: Model, locations: tuple[Location, ...]) -> list[FoundEffect]:
    rows = sorted(zip(model.members, selection.evidence, selection.twins, strict=True), key=lambda row: -row[1])
    points, drive = model.points, model.drive
    return [
        _effect(member, evidence, twins, where(points.resistance(member.name, member.parameters), drive, locations))
        for member, evidence, twins in rows
    ]


def _effect(member: Member, evidence: float, twins: Sequence[str], place: str) -> FoundEffect:
    kind = EFFECTS[member.name]
    drives = {twin.name: twin.drive for twin in kind.twins}
    likenesses = tuple(Likeness(name, drives.get(name, kind.needs)) for name in twins)
    parameters = tuple((name, float(value)) for name, value in member.parameters.items())
    std = tuple((name, _honest(member, name, value)) for name, value in member.std.items())
    return FoundEffect(
        kind.name, kind.title, kind.equation, kind.origin, parameters, std, float(evidence), place, likenesses
    )


def _honest(member: Member, name: str, std: float) -> float:
    """Return a standard deviation that knows that equations and clocks are not exact either."""
    kind = EFFECTS[member.name]
    off = member.parameters[name] - (kind.neutral if name == kind.amplitude else 0.0)
    # Places and times of day are no sizes.
    sized = name == kind.amplitude or (kind.parameters[name].unit != 'm' and kind.parameters[name].search is not None)
    equation = _EQUATION_SHARE * off if sized else 0.0
    clock = _CLOCK_S if kind.parameters[name].unit == 's' else 0.0
    return math.sqrt(std * std + equation * equation + clock * clock)


def _davis(model: Model, sizes: Sizes) -> tuple[Davis, tuple[float, float, float]]:
    """Return a, b, c as found together with the effects; what a train file cannot hold is cut off."""
    mean, covariance = model.posterior(sizes, model.whitener(sizes))
    std = np.sqrt(np.diag(covariance)[DAVIS]).tolist()
    return model.found_davis(mean), (std[0], std[1], std[2])


def _remaining(selection: Selection, verdict: Verdict) -> str:
    strongest = selection.groups[0] if selection.groups else None
    if strongest is not None and strongest.evidence >= NAMELESS:
        size = 'depends' if verdict is Verdict.UNEXPLAINED else 'depends a little'
        return f'The rest of the gap {size} on {strongest.text}, and no effect of the library fits it.'
    if verdict is Verdict.UNEXPLAINED:
        return f'Forces that nobody measured are larger than noise can be: {_unusual(selection.final.sizes)}.'
    return 'What is left is noise: gusts, errors of the map and of the sensors.'


def _no_better(model: Model, gap: Gap) -> str:
    """Return why effects with evidence are not told."""
    names = ' and '.join(sorted({member.name for member in model.members}))
    return (
        f'What looks like {names} does not hold: runs that the fit never saw would be simulated worse with it '
        f'({gap.before:.3f} to {gap.after:.3f} m/s).'
    )


def _unusual(sizes: Sizes) -> str:
    """Return the sizes that passing forces, loads, brakes and maps would need to have, in words."""
    noise, spread = sizes.noise, sizes.spread
    return (
        f'gusts of {noise.gust:.2f} N/kN that last {noise.gust_time:.0f} s, loads off by {spread.payload:.1%}, '
        f'brakes by {spread.brake:.1%} from run to run, the map by {spread.map:.2f} per mille'
    )


def _traces(proof: _Proof) -> tuple[RunTrace, ...]:
    """Return all runs with their gaps for plots."""
    model, before, after = proof.final, proof.before, proof.after
    drive = model.drive
    position, speed = drive.average(drive.joined('position')), drive.average(drive.speed)
    nothing = np.full(model.residual.size, np.nan)
    gaps = [nothing if held is None else held.gap for held in (before, after)]
    band = nothing if after is None else after.std
    traces = []
    for k, run in enumerate(drive.runs):
        at = (drive.node_run == k) & (drive.node_count > 0.0)
        time = drive.node_time[at] - run.time[0]
        traces.append(
            RunTrace(run.bag, run.direction, time, position[at], speed[at], gaps[0][at], gaps[1][at], band[at])
        )
    return tuple(traces)


def _noise(sizes: Sizes) -> NoiseSizes:
    noise, spread = sizes.noise, sizes.spread
    return NoiseSizes(noise.speed, noise.gust, noise.gust_time, spread.payload, spread.brake, spread.map)
