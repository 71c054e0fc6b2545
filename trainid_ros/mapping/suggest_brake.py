# SPDX-License-Identifier: Apache-2.0
"""Suggest where the brake command comes from: notches, percent or accelerations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.mapping.evidence import STEP_S, at_times, correlation
from trainid_ros.mapping.names import score, unit_in
from trainid_ros.mapping.suggestion import Choice, Part
from trainid_ros.stream.alignment import AlignmentConfig

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.bag.number_series import NumberSeries
    from trainid_ros.mapping.evidence import Array
    from trainid_ros.mapping.suggest_speed import Motion

# A brake acts up to so much later [s].
_LATEST_S: Final = 2.0
# Then it takes so long to come to its value [s].
_SETTLED_S: Final = 1.4
_MOST_NOTCHES: Final = 16
_GOES_WITH: Final = 0.3
# Milder than this is not braking [m/s^2].
_MILD: Final = 0.1
_CHANGING: Final = 0.9
_FEWEST: Final = 10
_LARGEST: Final = 3.0  # m/s^2


def choose_brake(series: Sequence[NumberSeries], motion: Motion, effort: Array | None) -> list[Choice]:
    """Return the brake command: what is named so and precedes decelerations; empty if nothing does.

    Args:
        series: What it may be.
        motion: The motion of the train.
        effort: Force by mass [m/s^2], shape (n,), None if it is not known. While braking it is the effort of a nominal
            brake, which is what a command asks for.
    """
    ranked = _ranked(series, motion)
    if not ranked:
        return []
    _, lag_s, with_it, item = ranked[0]
    by_force = 'median of d(speed)/dt' if effort is None else 'median of force / mass'
    target = np.where(motion.moving, motion.acceleration if effort is None else effort, np.nan)
    target = _earlier(target, _precedes(item, motion, target)[0])
    choice = Choice('brake_command', on_change=_on_change(item))
    choice.reasons.append(f'correlation {with_it:.2f} with d(speed)/dt {lag_s:.1f} s later {motion.minutes}')
    values = at_times(item, motion.times)
    if item.is_whole and np.unique(item.value).size <= _MOST_NOTCHES:
        choice.parts = (Part(item, 'm/s^2', table=_table(choice, item, values, target)),)
        choice.reasons.append(f'value of each notch: {by_force} while it holds')
        choice.decisions.append('the nominal deceleration of each notch')
    else:
        _scale(choice, item, values, target, by_force)
    if choice.on_change:
        choice.reasons.append(f'published only on change, up to {float(np.diff(item.time).max()):.0f} s apart')
    if others := [f'{entry.item.topic} {entry.item.field}' for entry in ranked[1:]]:
        choice.decisions.append(f'also like a brake: {", ".join(others[:3])}')
    return [choice]


class _Candidate(NamedTuple):
    """A number that may be the command: its rank, by how much it precedes decelerations [s], and its correlation."""

    rank: float
    lag_s: float
    with_it: float
    item: NumberSeries


def _ranked(series: Sequence[NumberSeries], motion: Motion) -> list[_Candidate]:
    """Return what is named like a brake command and precedes decelerations, the likeliest first."""
    found = []
    for item in series:
        named = score('brake_command', item.topic, item.field)
        if named <= 0.0 or np.ptp(item.value) == 0.0:
            continue
        lag_s, with_it = _precedes(item, motion, motion.acceleration)
        if abs(with_it) > _GOES_WITH:
            found.append(_Candidate(abs(with_it) + 0.3 * named, lag_s, with_it, item))
    return sorted(found, key=lambda candidate: -candidate.rank)


def _precedes(item: NumberSeries, motion: Motion, acceleration: Array) -> tuple[float, float]:
    """Return by how much a number precedes decelerations [s], and its correlation with them [1]."""
    values = at_times(item, motion.times)
    braking = np.where(motion.moving, np.minimum(acceleration, 0.0), np.nan)
    lags = np.arange(0.0, _LATEST_S, STEP_S).tolist()
    return max(((lag, correlation(values, _earlier(braking, lag))) for lag in lags), key=lambda entry: abs(entry[1]))


def _earlier(values: Array, by_s: float) -> Array:
    """Return values so much earlier [s], shape (n,); NaN at the end."""
    steps = round(by_s / STEP_S)
    return np.concatenate((values[steps:], np.full(steps, np.nan)))


def _on_change(item: NumberSeries) -> bool:
    """Return whether a command comes only when it changes."""
    if item.value.size < _FEWEST:
        return True
    changes = np.mean(np.diff(item.value) != 0.0) >= _CHANGING
    return bool(changes and np.diff(item.time).max() > AlignmentConfig().command_timeout)


def _table(choice: Choice, item: NumberSeries, values: Array, target: Array) -> tuple[tuple[float, float], ...]:
    """Return the target acceleration of each notch, 0 where it does not brake; one never seen on the move is noted."""
    wait = round(_SETTLED_S / STEP_S)
    table = []
    for notch in np.unique(item.value):
        holds = values == notch
        steady = holds.copy()
        for steps in range(1, wait):
            steady[steps:] &= holds[:-steps]
        known = np.isfinite(target)
        seen = target[steady & known] if np.any(steady & known) else target[holds & known]
        if notch != 0.0 and not seen.size:
            choice.decisions.append(f'notch {notch:g} was not seen on the move and would be rejected: give its value')
            continue
        value = float(np.median(seen)) if seen.size else 0.0
        table.append((float(notch), round(value, 2) if value < -_MILD and notch != 0.0 else 0.0))
    return tuple(table)


def _scale(choice: Choice, item: NumberSeries, values: Array, target: Array, by_force: str) -> None:
    """Find unit and sign of a command that is no notch."""
    top = float(np.max(np.abs(item.value)))
    braking = np.isfinite(values) & np.isfinite(target) & (np.abs(values) > 0.1 * top) & (target < -_MILD)
    ratio = float(np.median(target[braking] / values[braking])) if braking.any() else -1.0
    sign = 1.0 if ratio > 0.0 else -1.0
    named = unit_in(f'{item.topic} {item.field}', ('percent',))
    if not named and top <= _LARGEST and 0.5 < abs(ratio) < 2.0:
        choice.reasons.append(f'unit m/s^2: {by_force} is {ratio:.2f} for each unit')
        choice.parts = (Part(item, 'm/s^2', sign),)
        return
    unit = f'percent_of {100.0 * abs(ratio):.3g} m/s^2'
    choice.reasons.append(f'unit {unit}: {by_force} is {ratio:.4f} for each unit')
    choice.decisions.append('the nominal deceleration of the full brake')
    choice.parts = (Part(item, unit, sign),)
