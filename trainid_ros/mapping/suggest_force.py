# SPDX-License-Identifier: Apache-2.0
"""Suggest where force, gradient and mass come from, and their units: by their part in the balance of forces."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.mapping.evidence import at_times, correlation, regress
from trainid_ros.mapping.names import family, is_nameless, score, unit_in
from trainid_ros.mapping.suggestion import Choice, Part
from trainid_ros.mapping.units import find_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from trainid_ros.bag.number_series import NumberSeries
    from trainid_ros.mapping.evidence import Array
    from trainid_ros.mapping.suggest_speed import Motion
    from trainid_ros.train.train_file import TrainFile

G: Final = 9.80665  # m/s^2
_FORCE_UNITS: Final = ('N', 'kN', 'lbf')
# Per mille in each.
_GRADIENTS: Final = {'per_mille': 1.0, 'percent': 10.0, 'deg': 1000.0 * math.pi / 180.0, 'rad': 1000.0}
_MASS_UNITS: Final = ('kg', 't', 'lb')
_USUAL_ROTARY: Final = 0.08
# Slopes of regressions are exact to this factor [1].
_SLOPE_FACTOR: Final = 1.6
_GOES_WITH: Final = 0.3
# Least correlation of a force without a name with the acceleration, and factor within which a slope is 1 or g [1].
_NAMELESS: Final = 0.6
_SAME: Final = 1.25
# Another force explains at least so much more of the variance of the acceleration [1], a gradient so much.
_NEW_FORCE: Final = 0.02
_GRADIENT_GAIN: Final = 1e-3
# Where only the range shows the unit: a larger number is not in kN, in percent, in rad, or in t.
_LARGE_KN: Final = 2000.0
_LARGE_PERCENT: Final = 6.0
_LARGE_RAD: Final = 0.1
_LARGE_T: Final = 3000.0


def choose_force(series: Sequence[NumberSeries], motion: Motion, train_file: TrainFile | None) -> list[Choice]:
    """Return the sources whose sum goes with the acceleration best; empty if nothing does.

    Args:
        series: What they may be.
        motion: The motion of the train.
        train_file: Its mass shows the unit; None if it is not known.
    """
    groups: dict[tuple[str, str, str], list[NumberSeries]] = {}
    for item in series:
        if score('force', item.topic, item.field) <= 0.0 or item.is_whole:
            continue
        if abs(correlation(at_times(item, motion.times), motion.acceleration)) > _GOES_WITH:
            groups.setdefault((family(item.topic), item.field, item.type), []).append(item)
    totals = {key: _sum_at(items, motion) for key, items in groups.items()}
    chosen: list[tuple[str, str, str]] = []
    share = 0.0
    if not groups:
        return _as_force([[item] for item in _by_numbers(series, motion)], motion, train_file)
    while rest := [key for key in groups if key not in chosen]:
        shares = {key: _share([totals[item] for item in (*chosen, key)], motion) for key in rest}
        best = max(rest, key=lambda key: shares[key])
        # Another measurement of the same force explains no more.
        if shares[best] < share + _NEW_FORCE:
            break
        chosen, share = [*chosen, best], shares[best]
    return _as_force([groups[key] for key in chosen], motion, train_file)


def _by_numbers(series: Sequence[NumberSeries], motion: Motion) -> list[NumberSeries]:
    """Return the number without a name that goes with the acceleration best and is not the acceleration; or none."""
    best: tuple[float, list[NumberSeries]] = (_NAMELESS, [])
    for item in series:
        if item.is_whole or not is_nameless(item.topic, item.field):
            continue
        values = at_times(item, motion.times)
        fit = regress(motion.acceleration, [values], motion.moving)
        with_it = abs(correlation(values, motion.acceleration))
        if fit is None or any(1.0 / _SAME < abs(fit.slopes[0]) / unit < _SAME for unit in (1.0, G)):
            continue
        if with_it > best[0]:
            best = with_it, [item]
    return best[1]


def _share(totals: Sequence[Array], motion: Motion) -> float:
    """Return the share of the acceleration that forces explain [1], 0 if that cannot be known."""
    fit = regress(motion.acceleration, totals, motion.moving)
    return 0.0 if fit is None else fit.share


def _sum_at(items: Iterable[NumberSeries], motion: Motion) -> Array:
    """Return the sum of series at the common times, shape (n,)."""
    total: Array = np.sum([at_times(item, motion.times) for item in items], axis=0)
    return total


def _as_force(groups: list[list[NumberSeries]], motion: Motion, train_file: TrainFile | None) -> list[Choice]:
    """Return the choice of groups of sources, each with a sign of its own."""
    totals = [_sum_at(items, motion) for items in groups]
    fit = regress(motion.acceleration, [*totals, motion.speed**2], motion.moving)
    if not groups or fit is None:
        return []
    signs = [math.copysign(1.0, slope) for slope in fit.slopes[: len(totals)]]
    total: Array = np.sum([sign * item for sign, item in zip(signs, totals, strict=True)], axis=0)
    choice = Choice('force')
    choice.reasons.append(
        f'correlation {correlation(total, motion.acceleration):.2f} with d(speed)/dt {motion.minutes}'
    )
    unit = _force_unit(choice, groups[0][0], abs(fit.slopes[0]), float(np.nanmax(np.abs(total))), train_file)
    choice.parts = tuple(Part(item, unit, sign) for sign, items in zip(signs, groups, strict=True) for item in items)
    if is_nameless(choice.parts[0].series.topic, choice.parts[0].series.field):
        choice.decisions.append('whether this is the force: no name says so')
    if len(choice.parts) > 1:
        choice.decisions.append('they are summed as forces of several cars or systems; leave out what counts twice')
    return [choice]


def _force_unit(choice: Choice, series: NumberSeries, slope: float, top: float, train_file: TrainFile | None) -> str:
    """Return the unit of a force, and note the reason; ``slope`` is the acceleration for each unit [m/s^2]."""
    named = unit_in(f'{series.topic} {series.field}', _FORCE_UNITS)
    if train_file is None:
        choice.reasons.append('unit by its name' if named else f'up to {top:.3g}')
        choice.decisions.append('the unit; with --train the mass shows it')
        return named or ('N' if top > _LARGE_KN else 'kN')
    newtons = slope * train_file.train.mass * (1.0 + train_file.train.rotary_mass)
    fitting = _nearest_unit(newtons, {name: find_unit(name, 'force').factor for name in _FORCE_UNITS})
    unit = fitting or named or f'percent_of {newtons / 10.0:.3g} kN'
    choice.reasons.append(f'mass x acceleration is {newtons:.4g} N for each unit, so {unit}')
    if named not in {'', unit}:
        choice.decisions.append(f'its name says {named}')
    if not fitting:
        choice.decisions.append('no unit fits: is it of all motor cars, and what is the largest force of the train?')
    return unit


def _nearest_unit(factor: float, units: dict[str, float]) -> str:
    """Return the unit with a factor near another, '' if none is."""
    name = min(units, key=lambda item: abs(math.log(factor / units[item])))
    return name if abs(math.log(factor / units[name])) < math.log(_SLOPE_FACTOR) else ''


def total_force(force: Choice, motion: Motion) -> Array:
    """Return the force [N] at the common times, shape (n,)."""
    parts = [
        find_unit(part.unit, 'force').factor * part.sign * at_times(part.series, motion.times) for part in force.parts
    ]
    total: Array = np.sum(parts, axis=0)
    return total


def specific_force(total: Array | None, masses: Sequence[Choice], train_file: TrainFile | None) -> Array | None:
    """Return the acceleration that the force would give [m/s^2], shape (n,); None if force or mass is not known."""
    if total is None or train_file is None:
        return None
    kilograms = train_file.train.mass
    if masses:
        (part,) = masses[0].parts
        kilograms = find_unit(part.unit, 'mass').factor * float(np.median(part.series.value))
    return total / (kilograms + train_file.train.mass * train_file.train.rotary_mass)


def choose_gradient(
    series: Iterable[NumberSeries],
    motion: Motion,
    total: Array | None,
    train_file: TrainFile | None,
    *,
    has_position: bool,
) -> list[Choice]:
    """Return the gradient, from a topic or the line, with the position where that needs one; empty if there is none.

    Args:
        series: What it may be.
        motion: The motion of the train.
        total: The force [N] at the common times, shape (n,); None if it is not known.
        train_file: Its line may have the gradients; None if it is not known.
        has_position: Whether the position is known.
    """
    named = [item for item in series if score('gradient', item.topic, item.field) > 0.0]
    if named:
        return [max((_gradient(item, motion, total, train_file) for item in named), key=lambda item: item[0])[1]]
    if train_file is None or not train_file.line.gradient:
        return []
    choice = Choice('gradient', text='{from: line}', reasons=['the train file has a line'])
    if has_position:
        return [choice]
    where = Choice('position', text='{from: speed, start: 0.0, direction: 1}')
    where.reasons.append('the line is looked up by position')
    where.decisions.append('where the bag starts on the line [m], and whether positions rise (1) or fall (-1)')
    return [where, choice]


def _gradient(
    series: NumberSeries, motion: Motion, total: Array | None, train_file: TrainFile | None
) -> tuple[float, Choice]:
    """Return how much more of the acceleration a gradient explains [1], and the choice."""
    named = unit_in(f'{series.topic} {series.field}', tuple(_GRADIENTS))
    top, choice = float(np.max(np.abs(series.value))), Choice('gradient')
    unit, sign = named or ('per_mille' if top > _LARGE_PERCENT else 'percent' if top > _LARGE_RAD else 'rad'), 1.0
    permille, gain = _slowing(series, motion, total, train_file)
    by_slope = _nearest_unit(abs(permille), _GRADIENTS) if gain > _GRADIENT_GAIN else ''
    if by_slope:
        choice.reasons.append(f'the train is slowed as by {permille:.3g} per mille for each unit, so {by_slope}')
        unit, sign = named or by_slope, math.copysign(1.0, permille)
    if by_slope != unit:
        how = 'its name' if named else f'its range, up to {top:.3g}'
        choice.decisions.append(f'unit {unit} is by {how}; + must be uphill')
    choice.parts = (Part(series, unit, sign),)
    return gain, choice


def _slowing(
    series: NumberSeries, motion: Motion, total: Array | None, train_file: TrainFile | None
) -> tuple[float, float]:
    """Return as how many per mille each unit slows the train, and the share of the variance that this explains [1]."""
    if total is None:
        return 1.0, 0.0
    others = [total, motion.speed, motion.speed**2]
    fit = regress(motion.acceleration, [at_times(series, motion.times), *others], motion.moving)
    if fit is None or fit.slopes[0] == 0.0:
        return 1.0, 0.0
    rotary = _USUAL_ROTARY if train_file is None else train_file.train.rotary_mass
    return -fit.slopes[0] * 1000.0 * (1.0 + rotary) / G, fit.share - _share(others, motion)


def choose_mass(series: Iterable[NumberSeries], train_file: TrainFile | None) -> list[Choice]:
    """Return a mass that fits the train file, or whose name and range say so; empty if there is none."""
    units = {name: find_unit(name, 'mass').factor for name in _MASS_UNITS}
    for item in series:
        value = float(np.median(item.value))
        if score('mass', item.topic, item.field) <= 0.0 or value <= 0.0:
            continue
        named = unit_in(f'{item.topic} {item.field}', _MASS_UNITS)
        choice = Choice('mass', reasons=[f'median {value:.4g}'])
        if train_file is None:
            unit = named or ('t' if value < _LARGE_T else 'kg')
            choice.decisions.append('is it the mass of the whole train, or of its load (then with an offset)?')
        else:
            mass = train_file.train.mass
            unit = named or _nearest_unit(mass / value, units)
            if not unit or not 1.0 / _SLOPE_FACTOR < units[unit] * value / mass < _SLOPE_FACTOR:
                continue
            choice.reasons.append(f'unit {unit}: the train file says {mass:.4g} kg')
        choice.parts = (Part(item, unit),)
        return [choice]
    return []
