# SPDX-License-Identifier: Apache-2.0
"""What terminal, page and JSON say alike of a drive: the verdict in one sentence, and the rows of the estimates.

The verdict is whether the drive can be used, why or why not, and what to do next.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from trainid_ros.estimators.pipeline import ConsistencyVerdict
from trainid_ros.interface.records import KM_H
from trainid_ros.interface.results import Reason, ResistanceEstimate, Status, deviations, quantities
from trainid_ros.interface.text import plus_minus
from trainid_ros.monitor.trains import resistance_at

if TYPE_CHECKING:
    from trainid_ros.bag.bag_replay import Replay, Result
    from trainid_ros.interface.results import AdhesionEstimate, BrakeRateEstimate, Output
    from trainid_ros.resistance.suggested_drive import SuggestedDrive

SPEEDS: Final = (10.0, 15.0, 20.0)
"""Speeds at which the resistance is stated [m/s]."""
_WHY: Final = {
    Status.UNINITIALIZED: 'no sample was used',
    Status.CONVERGING: 'not certain enough yet',
    Status.STALE: 'inputs are missing at the end',
    Status.FAULT: 'the estimator failed',
}
_AGREES: Final = 3.0  # Distance up to which an estimate agrees with the train file [std]


class Level(Enum):
    """How far the estimates of a drive can be used."""

    USABLE = 'usable'
    CARE = 'usable with care'
    PART = 'usable in part'
    NOT = 'not usable'


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a drive can be used."""

    level: Level  # How far
    text: str  # The sentence, with reason and next step


def results_of(outcome: Replay) -> dict[str, Result[Any]]:
    """Return the results by the names of the estimators for people."""
    names = ('resistance', 'speed model', 'brake rate')
    return dict(zip(names, (outcome.resistance, outcome.speed_model, outcome.brake_rate), strict=True))


def middle_speed(estimate: ResistanceEstimate) -> float:
    """Return the speed of the tables that is nearest to the middle of those learned from [m/s]."""
    return min(SPEEDS, key=lambda speed: abs(speed - 0.5 * (estimate.speed_min + estimate.speed_max)))


def speed_text(speed: float) -> str:
    """Return a speed [m/s] as text, also in km/h."""
    return f'{speed:g} m/s ({KM_H * speed:.0f} km/h)'


class EstimateRow(NamedTuple):
    """One row of the estimates at the end of a drive."""

    name: str
    unit: str
    value: float
    std: float
    status: str
    factors: tuple[float, float, float] | None = None  # Of a, b and c in it; None for another quantity


def estimate_rows(
    resistance: Output[ResistanceEstimate],
    brake_rate: Output[BrakeRateEstimate],
    adhesion: Output[AdhesionEstimate] | None,
) -> list[EstimateRow]:
    """Return the rows of the estimates that have a standard deviation."""
    w, f, state = resistance.estimate, brake_rate.estimate, resistance.status.name
    known, units = deviations(w.covariance), quantities(ResistanceEstimate)
    each = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    rows = [
        EstimateRow(name, units[name].unit, getattr(w, name), std, state, factors)
        for name, std, factors in zip('abc', known, each, strict=True)
    ]
    for v in SPEEDS:
        name = f'w at {speed_text(v)}' + ('' if w.speed_min <= v <= w.speed_max else ' *')
        value, std = resistance_at(w, v)
        rows.append(EstimateRow(name, 'N/kN', value, std, state, (1.0, v, v * v)))
    if not math.isnan(w.force_scale):
        rows.append(EstimateRow('force scale', '1 = as reported', w.force_scale, w.force_scale_std, state))
        rows.append(EstimateRow('force delay', 's', w.force_delay, w.force_delay_std, state))
    rows.append(EstimateRow('brake rate', '1 = nominal', f.brake_rate, f.brake_rate_std, brake_rate.status.name))
    if adhesion is not None:
        m = adhesion.estimate
        unit = f'1, at least {m.at_least:.3f}'
        rows.append(EstimateRow('adhesion', unit, m.adhesion, m.adhesion_std, adhesion.status.name))
    return rows


def judge(
    outcome: Replay,
    drives: tuple[SuggestedDrive | None, SuggestedDrive | None],
    bag: str,
    train: str,
    named: Callable[[str], str] = lambda text: text,
) -> Verdict:
    """Return the verdict on a replay.

    ``drives`` are those suggested for resistance and brake rate; ``named`` gives topics the names of the bag.
    """
    results = results_of(outcome)
    unusable = {name: result for name, result in results.items() if not result.output.status.is_usable}
    level = Level.NOT if len(unusable) == len(results) else Level.PART if unusable else Level.USABLE
    info = f'{shlex.join(("trainid", "info", bag))} shows what the bag holds'
    found = {'brake rate': outcome.brake_findings}
    reasons = [text for name, result in unusable.items() for text in found.get(name) or (_why(name, result),)]
    suggested = zip(('resistance', 'brake rate'), drives, strict=True)
    steps = [drive.text for name, drive in suggested if name in unusable and drive is not None]
    if outcome.brake_findings and 'brake rate' in unusable:
        steps = [f'{shlex.join(("trainid", "fit", "--brake", bag, "--train", train))} finds the brake']
    if reason := outcome.why_no_resistance():
        reasons = [reason]
    elif not unusable and (findings := outcome.findings):
        reasons, steps = [*findings], ['correct the train file or what publishes the topic']
    optimistic = [
        f'uncertainty of {name}: {result.consistency.advice}'
        for name, result in results.items()
        if result.consistency.verdict is ConsistencyVerdict.OPTIMISTIC and name not in unusable
    ]
    steps = steps or ([_explained(bag, train)] if optimistic and not unusable else [])
    reasons += optimistic
    if (last := outcome.contradiction).finding:
        share = max(dict(r.rejections).get(Reason.CONTRADICTION, 0) / max(r.samples, 1) for r in results.values())
        text = f'{last.text} ({share:.0%} of the samples left out)'
        mend = f'correct what publishes {" and ".join(last.inputs)}, or state its unit and sign with --map'
        mend += ', or correct the train file' if 'train.' in last.finding else ''
        if unusable and not _is_main(outcome):
            reasons.append(text)
        else:
            # What else is wrong may follow from it.
            reasons, steps = [text], [mend]
    if reasons and level is Level.USABLE:
        level = Level.CARE
    if not reasons:
        reasons, steps = _compared(outcome, bag, train)
    is_begun = all(r.output.used and r.output.status is Status.CONVERGING for r in unusable.values())
    if not steps and level is Level.PART and is_begun:
        steps = ['a longer drive tells the rest']
    step = next(iter(steps), info)
    head = f'{level.value}, not {" and ".join(unusable)}' if level is Level.PART else level.value
    return Verdict(level, named(f'{head[0].upper()}{head[1:]}: {"; ".join(reasons)}. Next: {step}.'))


def _is_main(outcome: Replay) -> bool:
    """Return whether a contradiction lasts, or is why most of the samples were not used."""
    rejections = outcome.resistance.rejections
    return math.isnan(outcome.contradiction.end_s) or bool(rejections and rejections[0][0] is Reason.CONTRADICTION)


def _why(name: str, result: Result[Any]) -> str:
    status, why = result.output.status, result.why_converging
    if not why and status is Status.CONVERGING and not result.output.used and result.rejections:
        why = f'no sample was used (most often: {result.rejections[0][0].text})'
    return f'{name} is {status.name}, {why or _WHY[status]}'


def _explained(bag: str, train: str) -> str:
    return f'{shlex.join(("trainid", "explain", bag, "--train", train))} names what the train file lacks'


def _compared(outcome: Replay, bag: str, train: str) -> tuple[list[str], list[str]]:
    """Return the main numbers against the train file, and what follows."""
    w, prior, f = outcome.resistance.output.estimate, outcome.resistance.prior, outcome.brake_rate.output.estimate
    v = middle_speed(w)
    value, std = resistance_at(w, v)
    moved = abs(value - prior.a - prior.b * v - prior.c * v * v) / std
    braking = abs(f.brake_rate - outcome.brake_rate.prior.brake_rate) / f.brake_rate_std
    numbers = (
        f'w at {v:g} m/s {plus_minus(value, std)} N/kN and brake rate {plus_minus(f.brake_rate, f.brake_rate_std)}'
    )
    if max(moved, braking) <= _AGREES:
        return [f'{numbers} agree with the train file'], ['go on with this train file']
    differ = f'{numbers} differ from the train file by {moved:.1f} and {braking:.1f} std'
    return [differ], [_explained(bag, train)]
