# SPDX-License-Identifier: Apache-2.0
"""Suggest a mapping for a bag or a table, from names of topics, fields or columns and from relations of their numbers.

Speed is what positions are the integral of, and forces go with its derivative; units follow from ratios.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from trainid_ros.inputs.mapping import QUANTITIES
from trainid_ros.inputs.units import find_unit, unit_factors
from trainid_ros.inspection.choice import Choice, Part, Suggestion
from trainid_ros.inspection.number_series import (
    MIN_NUMBERS,
    PER_MILLE,
    STEP_S,
    USUAL_ROTARY,
    Array,
    BagNumbers,
    NumberSeries,
    at_times,
    comes_on_change,
    correlation,
    derivative,
    family,
    is_nameless,
    is_near,
    nearest_unit,
    partial_slope,
    regress,
    score,
    unit_in,
)
from trainid_ros.inspection.suggest_speed import (
    MIN_CORRELATION,
    MIN_NAMELESS,
    Motion,
    choose_speed,
    possible_speeds,
    speeds_by_numbers,
)
from trainid_ros.interface.text import listed
from trainid_ros.train.forces import G
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import TrainFile


def suggest(
    numbers: BagNumbers, name: str, train_file: TrainFile | None = None, table: Sequence[Choice] = ()
) -> Suggestion:
    """Return a mapping for the numbers of a bag with a name, or of a table with choices for its time and form.

    The mass of the train file, if it is known, shows the unit of the force, and its line may have the gradients.
    """
    head = (
        f'Suggested by trainid {"import" if table else "info"} --suggest-map for {name}: '
        f'{_lasting(numbers.duration_s)} were read.',
        f'Check each line before it is used; what is left out {"is missing" if table else "comes from our own topic"}.',
    )
    own = frozenset(topic.lstrip('/') for topic in numbers.own)
    choices = tuple(choice for choice in _choices(numbers, train_file) if QUANTITIES[choice.quantity].topic not in own)
    chosen = {choice.quantity for choice in choices}
    missing = tuple(name for name in _ADVICE if name not in chosen and QUANTITIES[name].topic not in own)
    notes = [_ADVICE[name] for name in missing]
    if numbers.own:
        notes.append(f'from our own topics: {listed(sorted(own), 6)}')
    used = {part.series.source for choice in choices for part in choice.parts}
    if rest := sorted({item.source for item in numbers.series} - used - numbers.own):
        notes.append(f'not used: {listed(rest, 6)}')
    if numbers.left_out:
        notes.append(f'not read: {listed([f"{topic} ({why})" for topic, why in numbers.left_out], 6)}')
    return Suggestion(head, (*table, *choices), missing, tuple(notes))


def _lasting(seconds: float) -> str:
    return f'{seconds / 60.0:.0f} min' if seconds >= 90.0 else f'{seconds:.0f} s'


_ADVICE: Final = {
    'speed': 'speed: nothing found; it is needed, and all else is compared with it',
    'force': 'force: nothing found; the force at the wheel rim, or the sum of those of all motor cars, is needed',
    'gradient': 'gradient: nothing found; {from: line} takes it from the line of the train file (--train), by position',
    'brake_command': 'brake_command: nothing found; a notch with a table, percent of the full brake or m/s^2 is needed',
}


def _choices(numbers: BagNumbers, train_file: TrainFile | None) -> list[Choice]:
    """Return candidates for each quantity, also for those that come from our own topics."""
    own = [item for item in numbers.series if item.topic in numbers.own]
    foreign = [item for item in numbers.series if item.topic not in numbers.own]
    speeds = [item for item in own if item.field == 'speed'] or possible_speeds(foreign) or speeds_by_numbers(foreign)
    if not speeds:
        return []
    speed, position, motion = choose_speed(speeds, [*foreign, *own], train_file)
    rest = _without(foreign, [speed, *position])
    forces = _choose_force([item for item in own if item.field == 'force'] or rest, motion)
    rest = _without(rest, forces)
    total = None
    if forces:  # the force [N] at the common times, shape (n,)
        total = _sum_at([(p.series, find_unit(p.unit, 'force').factor * p.sign) for p in forces[0].parts], motion)
    gradients = _choose_gradient(rest, motion, total, position)
    masses = _choose_mass([item for item in own if item.field == 'mass'] or rest, train_file)
    brakes = _choose_brake(rest, motion, _specific_force(total, masses, train_file))
    return [speed, *position, *forces, *gradients, *brakes, *masses]


def _without(series: Iterable[NumberSeries], choices: Iterable[Choice]) -> list[NumberSeries]:
    chosen = {id(part.series) for choice in choices for part in choice.parts}
    return [item for item in series if id(item) not in chosen]


# Largest number in each unit, where only the range shows it.
_MAX_IN: Final = {
    'force': {'kN': 2000.0, 'N': math.inf},
    'gradient': {'rad': 0.1, 'percent': 6.0, 'per_mille': math.inf},
    'mass': {'t': 3000.0, 'kg': math.inf},
}


def _unit_by_range(quantity: str, top: float) -> str:
    return next(unit for unit, limit in _MAX_IN[quantity].items() if top <= limit)


# Largest number of a step of a lever [1]: twice the 8 of the AAR's lever for locomotives, chosen, not measured.
_MAX_NOTCH: Final = 16


def _choose_force(series: Sequence[NumberSeries], motion: Motion) -> list[Choice]:
    """Return the sources whose sum goes with the acceleration best; empty if nothing does."""
    groups: dict[tuple[str, str, str], list[NumberSeries]] = {}
    for item in series:
        if score('force', item.topic, item.field) <= 0.0 or _is_notch(item):
            continue
        if abs(correlation(at_times(item, motion.times), motion.acceleration)) > MIN_CORRELATION:
            groups.setdefault((family(item.source), item.topic and item.field, item.type), []).append(item)
    if not groups:
        return _as_force([[item] for item in _by_numbers(series, motion)], motion)
    totals = {key: _sum_at([(item, 1.0) for item in items], motion) for key, items in groups.items()}
    chosen: list[tuple[str, str, str]] = []
    share = 0.0
    while rest := [key for key in groups if key not in chosen]:
        fits = {key: regress(motion.acceleration, [totals[k] for k in (*chosen, key)], motion.moving) for key in rest}
        shares = {key: 0.0 if fit is None else fit.share for key, fit in fits.items()}
        best = max(rest, key=lambda key: shares[key])
        # Another measurement of the same force explains no more.
        if shares[best] < share + 0.02:
            break
        chosen, share = [*chosen, best], shares[best]
    return _as_force([groups[key] for key in chosen], motion)


def _is_notch(item: NumberSeries) -> bool:
    """Return whether a number may be a step of a lever rather than a force that is logged in whole units."""
    return item.is_whole and not unit_in(item, 'force') and (bool(item.type) or np.abs(item.value).max() <= _MAX_NOTCH)


def _by_numbers(series: Sequence[NumberSeries], motion: Motion) -> list[NumberSeries]:
    """Return the number without a name that goes with the acceleration best and is not the acceleration; or none."""
    ranked = []
    for item in (item for item in series if is_nameless(item) and not item.is_whole):
        values = at_times(item, motion.times)
        fit = regress(motion.acceleration, [values], motion.moving)
        if fit is not None and not any(0.8 < abs(fit.slopes[0]) / unit < 1.25 for unit in (1.0, G)):  # no acceleration
            ranked.append((abs(correlation(values, motion.acceleration)), item))
    best = max(ranked, key=lambda entry: entry[0], default=None)
    return [best[1]] if best is not None and best[0] > MIN_NAMELESS else []


def _sum_at(items: Iterable[tuple[NumberSeries, float]], motion: Motion) -> Array:
    """Return the sum of series, each with its factor, at the common times, shape (n,)."""
    return np.asarray(np.sum([factor * at_times(item, motion.times) for item, factor in items], axis=0))


def _as_force(groups: list[list[NumberSeries]], motion: Motion) -> list[Choice]:
    """Return the choice of groups of sources, each with a sign of its own."""
    totals = [_sum_at([(item, 1.0) for item in items], motion) for items in groups]
    fit = regress(motion.acceleration, [*totals, motion.speed**2], motion.moving)
    if not groups or fit is None:
        return []
    signs = [math.copysign(1.0, slope) for slope in fit.slopes[: len(totals)]]
    total: Array = np.sum([sign * item for sign, item in zip(signs, totals, strict=True)], axis=0)
    with_it = correlation(total, motion.acceleration)
    choice = Choice('force', reasons=[f'correlation {with_it:.2f} with d(speed)/dt {motion.minutes}'])
    unit = _force_unit(choice, groups[0][0], abs(fit.slopes[0]), float(np.nanmax(np.abs(total))), motion.train_file)
    choice.parts = tuple(Part(item, unit, sign) for sign, items in zip(signs, groups, strict=True) for item in items)
    if not np.nanmin(total) < -0.05 * np.nanmax(total):
        choice.decisions.append('it is never negative: leave cells blank while brakes act, whose force is missing')
    if is_nameless(choice.parts[0].series):
        choice.decisions.append('whether this is the force: no name says so')
    if len(choice.parts) > 1:
        choice.decisions.append('they are summed as forces of several cars or systems; leave out what counts twice')
    return [choice]


def _force_unit(choice: Choice, series: NumberSeries, slope: float, top: float, train_file: TrainFile | None) -> str:
    """Return the unit of a force, and note the reason; ``slope`` is the acceleration for each unit [m/s^2]."""
    named = unit_in(series, 'force')
    if train_file is None:
        choice.reasons.append('unit by its name' if named else f'up to {top:.3g}')
        choice.decisions.append('the unit; with --train the mass shows it')
        return named or _unit_by_range('force', top)
    newtons = slope * train_file.train.mass * (1.0 + train_file.train.rotary_mass)
    # Other units are like a per cent of the force of many trains, so only a name says them.
    units = {name: size for name, size in unit_factors('force').items() if name in {named, 'N', 'kN', 'lbf'}}
    fitting = named if named and is_near(newtons, units[named]) else nearest_unit(newtons, units)
    unit = fitting or named or f'percent_of {newtons / 10.0:.3g} kN'
    choice.reasons.append(f'mass x acceleration is {newtons:.4g} N for each unit, so {unit}')
    if named not in {'', unit}:
        choice.decisions.append(f'its name says {named}')
    if not fitting:
        choice.decisions.append('no unit fits: is it of all motor cars, and what is the largest force of the train?')
    return unit


def _specific_force(total: Array | None, masses: Sequence[Choice], train_file: TrainFile | None) -> Array | None:
    """Return the acceleration that the force would give [m/s^2], shape (n,); None if force or mass is not known."""
    if total is None or train_file is None:
        return None
    kilograms = train_file.train.mass
    if masses:
        (part,) = masses[0].parts
        kilograms = find_unit(part.unit, 'mass').factor * float(np.median(part.series.value))
    return total / (kilograms + train_file.train.mass * train_file.train.rotary_mass)


def _choose_gradient(
    series: Iterable[NumberSeries], motion: Motion, total: Array | None, position: Sequence[Choice]
) -> list[Choice]:
    """Return the gradient, from a topic or the line, with the position where that needs one; empty if there is none.

    ``total`` is the force [N] at the common times, shape (n,), None if it is not known.
    """
    named = [item for item in series if score('gradient', item.topic, item.field) > 0.0]
    if named:
        return [max((_gradient(item, motion, total) for item in named), key=lambda item: item[0])[1]]
    if motion.train_file is None or not motion.train_file.line.gradient:
        return []
    choice = Choice('gradient', text='{from: line}', reasons=['the train file has a line'])
    if position:
        _compare_line(choice, position[0].parts[0], motion, total, motion.train_file)
        return [choice]
    decision = 'where the bag starts on the line [m], and whether positions rise (1) or fall (-1)'
    where = Choice(
        'position', (), '{from: speed, start: 0.0, direction: 1}', ['the line is looked up by position'], [decision]
    )
    return [where, choice]


def _compare_line(choice: Choice, position: Part, motion: Motion, total: Array | None, train_file: TrainFile) -> None:
    """Note whether the train is slowed as by the gradients of the line at its positions."""
    line = profile_of(train_file)
    metres = find_unit(position.unit, 'length').factor * at_times(position.series, motion.times)
    directions = np.where(derivative(metres) < 0.0, -1, 1).tolist()
    gradients = [line.gradient(x, sign) for x, sign in zip(metres.tolist(), directions, strict=True)]
    share, gain = _slowing(np.array(gradients), motion, total)
    if gain > _MIN_GAIN and share > 0.0 and is_near(share, 1.0):
        choice.reasons.append(f'the train is slowed as by {share:.2f} times the gradients at its positions')
    else:
        choice.decisions.append('is it this line, and do positions count from its begin? Its gradients do not show')


# Share of the variance of the acceleration from which on a gradient shows [1].
_MIN_GAIN: Final = 1e-3


def _gradient(series: NumberSeries, motion: Motion, total: Array | None) -> tuple[float, Choice]:
    """Return how much more of the acceleration a gradient explains [1], and the choice."""
    named = unit_in(series, 'gradient')
    top, choice = float(np.max(np.abs(series.value))), Choice('gradient')
    unit, sign = named or _unit_by_range('gradient', top), 1.0
    permille, gain = _slowing(at_times(series, motion.times), motion, total)
    by_slope = nearest_unit(abs(permille), PER_MILLE) if gain > _MIN_GAIN else ''
    if by_slope:
        choice.reasons.append(f'the train is slowed as by {permille:.3g} per mille for each unit, so {by_slope}')
        unit, sign = named or by_slope, math.copysign(1.0, permille)
    if by_slope != unit:
        how = 'its name' if named else f'its range, up to {top:.3g}'
        choice.decisions.append(f'unit {unit} is by {how}; + must be uphill')
    choice.parts = (Part(series, unit, sign),)
    return gain, choice


def _slowing(x: Array, motion: Motion, total: Array | None) -> tuple[float, float]:
    """Return as how many per mille each unit of a gradient at the common times, shape (n,), slows the train.

    Also the share of the variance that this explains [1].
    """
    if total is None:
        return 1.0, 0.0
    y, others = motion.acceleration, [total, motion.speed, motion.speed**2]
    known = motion.moving & np.isfinite(x) & np.isfinite(y) & np.isfinite(total)
    if np.count_nonzero(known) < MIN_NUMBERS:
        return 1.0, 0.0
    slope = partial_slope(y[known], x[known], [item[known] for item in others], motion.times[known] - motion.times[0])
    if slope is None or slope.value == 0.0:
        return 1.0, 0.0
    rotary = USUAL_ROTARY if motion.train_file is None else motion.train_file.train.rotary_mass
    gain = (slope.value * slope.spread) ** 2 / float(np.var(y[known]))
    return -slope.value * 1000.0 * (1.0 + rotary) / G, gain


_MASS_OFF: Final = 0.08  # share by which loads seldom differ from the train file [1]; short tons do by 0.09


def _choose_mass(series: Iterable[NumberSeries], train_file: TrainFile | None) -> list[Choice]:
    """Return a mass that fits the train file, or whose name and range say so; empty if there is none."""
    units = unit_factors('mass')
    for item in series:
        value = float(np.median(item.value))
        if score('mass', item.topic, item.field) <= 0.0 or value <= 0.0:
            continue
        named = unit_in(item, 'mass')
        choice = Choice('mass', reasons=[f'median {value:.4g}'])
        if train_file is None:
            unit = named or _unit_by_range('mass', value)
            choice.decisions.append('is it the mass of the whole train, or of its load (then with an offset)?')
        else:
            mass = train_file.train.mass
            unit = named or nearest_unit(mass / value, {name: units[name] for name in ('kg', 't', 'lb')})
            if not unit or not is_near(units[unit] * value, mass):
                continue
            choice.reasons.append(f'unit {unit}: the train file says {mass / 1000.0:.4g} t')
            if abs(off := units[unit] * value / mass - 1.0) > _MASS_OFF:
                choice.decisions.append(f'whether it is {off:+.0%} off the train file, or short tons or another unit')
        choice.parts = (Part(item, unit),)
        return [choice]
    return []


_MIN_BRAKING: Final = 0.1  # deceleration of a brake that acts [m/s^2]


def _choose_brake(series: Sequence[NumberSeries], motion: Motion, effort: Array | None) -> list[Choice]:
    """Return the brake command: a number that is named so and precedes decelerations; empty if none does.

    ``effort`` is the force by mass [m/s^2], shape (n,), None if it is not known. While braking it is the effort of a
    nominal brake, which is what a command asks for.
    """
    ranked = []  # the likeliest first: rank, by how much a number precedes decelerations [s], correlation, number
    for item in series:
        named = score('brake_command', item.topic, item.field)
        if named > 0.0 and np.ptp(item.value) > 0.0:
            lag_s, with_it = _precedes(item, motion, motion.acceleration)
            if abs(with_it) > MIN_CORRELATION:
                ranked.append((abs(with_it) + 0.3 * named, lag_s, with_it, item))
    if not ranked:
        return []
    ranked.sort(key=lambda entry: -entry[0])
    _, lag_s, with_it, item = ranked[0]
    # A force of traction alone does not show what the brake does.
    if effort is not None and not np.nanmin(effort) < -_MIN_BRAKING:
        effort = None
    by_force = 'median of d(speed)/dt' if effort is None else 'median of force / mass'
    target = np.where(motion.moving, motion.acceleration if effort is None else effort, np.nan)
    target = _earlier(target, _precedes(item, motion, target)[0])
    on_change = item.value.size < 10 or comes_on_change(item.time, item.value)
    choice = Choice('brake_command', on_change=on_change)
    choice.reasons.append(f'correlation {with_it:.2f} with d(speed)/dt {lag_s:.1f} s later {motion.minutes}')
    values = at_times(item, motion.times)
    is_percent = '%' in item.field or unit_in(item, 'gradient') == 'percent'
    if item.is_whole and not is_percent and np.unique(item.value).size <= 16:
        choice.parts = (Part(item, 'm/s^2', table=_table(choice, item, values, target)),)
        choice.reasons.append(f'value of each notch: {by_force} while it holds')
        choice.decisions.append('the nominal deceleration of each notch')
    else:
        _scale(choice, item, values, target, by_force)
    if choice.on_change:
        choice.reasons.append(f'published only on change, up to {float(np.diff(item.time).max()):.0f} s apart')
    if others := [other.name for *_, other in ranked[1:]]:
        choice.decisions.append(f'also like a brake: {", ".join(others[:3])}')
    return [choice]


def _precedes(item: NumberSeries, motion: Motion, acceleration: Array) -> tuple[float, float]:
    """Return by how much a number precedes decelerations [s], and its correlation with them [1]."""
    values = at_times(item, motion.times)
    braking = np.where(motion.moving, np.minimum(acceleration, 0.0), np.nan)
    lags = np.arange(0.0, 2.0, STEP_S).tolist()  # a brake acts at most 2 s later
    return max(((lag, correlation(values, _earlier(braking, lag))) for lag in lags), key=lambda entry: abs(entry[1]))


def _earlier(values: Array, by_s: float) -> Array:
    """Return values so much earlier [s], shape (n,); NaN at the end."""
    steps = round(by_s / STEP_S)
    return np.concatenate((values[steps:], np.full(steps, np.nan)))


def _table(choice: Choice, item: NumberSeries, values: Array, target: Array) -> tuple[tuple[float, float], ...]:
    """Return the target acceleration of each notch, 0 where it does not brake; one never seen on the move is noted.

    Notch 0 may be the full brake; unseen it is released if no other one is.
    """
    wait = round(1.4 / STEP_S)  # a brake takes 1.4 s to come to its value
    known = np.isfinite(target)
    table: list[tuple[float, float]] = []
    unseen: list[float] = []
    for notch in np.unique(item.value):
        holds = values == notch
        steady = holds & known
        for steps in range(1, wait):
            steady[steps:] &= holds[:-steps]
        if (seen := target[steady if steady.any() else holds & known]).size:
            value = float(np.median(seen))
            table.append((float(notch), round(value, 2) if value < -_MIN_BRAKING else 0.0))
        else:
            unseen.append(float(notch))
    if 0.0 in unseen and all(value for _, value in table):
        unseen.remove(0.0)
        table = sorted([*table, (0.0, 0.0)])
    for notch in unseen:
        choice.decisions.append(f'notch {notch:g} was not seen on the move and would be rejected: give its value')
    return tuple(table)


def _scale(choice: Choice, item: NumberSeries, values: Array, target: Array, by_force: str) -> None:
    """Find unit and sign of a command that is no notch."""
    top = float(np.max(np.abs(item.value)))
    braking = np.isfinite(values) & np.isfinite(target) & (np.abs(values) > 0.1 * top) & (target < -_MIN_BRAKING)
    ratio = float(np.median(target[braking] / values[braking])) if braking.any() else -1.0
    sign = 1.0 if ratio > 0.0 else -1.0
    unit, digits = f'percent_of {100.0 * abs(ratio):.3g} m/s^2', 4
    if unit_in(item, 'gradient') != 'percent' and top <= 3.0 and 0.5 < abs(ratio) < 2.0:  # more than a brake gives
        unit, digits = 'm/s^2', 2
    else:
        choice.decisions.append('the nominal deceleration of the full brake')
    choice.reasons.append(f'unit {unit}: {by_force} is {ratio:.{digits}f} for each unit')
    choice.parts = (Part(item, unit, sign),)
