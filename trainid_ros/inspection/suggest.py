# SPDX-License-Identifier: Apache-2.0
"""Suggest a mapping for a bag or a table, from names of topics, fields or columns and from relations of their numbers.

Speed is what positions are the integral of, and forces go with its derivative; units follow from ratios.
"""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_ros.inputs.mapping import QUANTITIES
from trainid_ros.inputs.units import find_unit, unit_factors
from trainid_ros.inspection.number_series import (
    MIN_NUMBERS,
    PER_MILLE,
    STEP_S,
    USUAL_ROTARY,
    Array,
    BagNumbers,
    NumberSeries,
    Travel,
    at_times,
    comes_on_change,
    common_times,
    compare_travel,
    correlation,
    derivative,
    family,
    is_nameless,
    is_near,
    jumps,
    nearest_unit,
    partial_slope,
    regress,
    score,
    unit_in,
)
from trainid_ros.interface.text import listed, printable
from trainid_ros.train.forces import G
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class Part:
    """One source of a quantity, with its unit, sign and table."""

    series: NumberSeries
    unit: str
    sign: float = 1.0
    table: tuple[tuple[float, float], ...] = ()

    def text(self, more: str = '') -> str:
        """Return it as in a mapping file; ``more`` are further keys."""
        words = [f'topic: {quoted(self.series.topic)}'] if self.series.topic else []
        words.append(f'field: {quoted(self.series.field)}')
        if self.table:
            words.append(f'table: {{{", ".join(f"{raw:g}: {value:g}" for raw, value in self.table)}}}')
        else:
            words.append(f'unit: {quoted(self.unit)}')
        if self.sign < 0.0:
            words.append('sign: -1')
        if not self.series.has_stamps:
            words.append('stamp: receive')
        return f'{{{", ".join(words)}{more}}}'


@dataclass(slots=True)
class Choice:
    """The suggestion for one quantity."""

    quantity: str  # The quantity
    parts: tuple[Part, ...] = ()  # Its sources, which are summed
    text: str = ''  # What the file says in place of sources, '' with some
    reasons: list[str] = field(default_factory=list)  # What speaks for it
    decisions: list[str] = field(default_factory=list)  # What the reader must decide
    on_change: bool = False  # Whether commands come only when they change
    head: str = ''  # What it is in place of sources

    def lines(self) -> list[str]:
        """Return its lines in the file."""
        heads = [f'{self.quantity}: {described(part.series)}' for part in self.parts]
        said = heads or [self.head or f'{self.quantity}: not on a topic']
        said += [f'  {reason}' for reason in self.reasons]
        said += [f'  decide: {decision}' for decision in self.decisions]
        return [*map(comment, said), *self._body()]

    def _body(self) -> list[str]:
        more = ', on_change: true' if self.on_change else ''
        if not self.parts:
            return [f'{self.quantity}: {self.text}'] if self.text else []
        if len(self.parts) == 1:
            return [f'{self.quantity}: {self.parts[0].text(more)}']
        return [f'{self.quantity}:', '  sum:', *(f'    - {part.text()}' for part in self.parts)]


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A suggested mapping."""

    head: tuple[str, ...]  # What was read
    choices: tuple[Choice, ...]  # What is suggested for each quantity
    missing: tuple[str, ...]  # Required quantities for which nothing was found
    notes: tuple[str, ...]  # What else there is to know

    def text(self) -> str:
        """Return the mapping file, with reasons as comments."""
        blocks = [[*map(comment, self.head)], *(choice.lines() for choice in self.choices), [*map(comment, self.notes)]]
        if not any(choice.parts or choice.text for choice in self.choices):
            blocks.append(['{}'])
        return '\n\n'.join('\n'.join(block) for block in blocks if block)


def comment(text: str) -> str:
    """Return a text as one comment, whatever characters a name in it has."""
    return '# ' + printable(text).replace('\n', r'\n')


def described(series: NumberSeries) -> str:
    """Return topic, field, type and rate of a series."""
    rate = '' if math.isnan(series.rate) else f'{series.rate:.3g} Hz'
    return f'{series.name} ({", ".join(filter(None, (series.type, rate)))})'


def quoted(text: str) -> str:
    """Return a text as in YAML."""
    is_word = re.fullmatch(r'[A-Za-z/][A-Za-z0-9_/.]*', text) and text.lower() not in {'yes', 'no', 'on', 'off'}
    return text if is_word else json.dumps(text, ensure_ascii=False)


def suggest(
    numbers: BagNumbers, name: str, train_file: TrainFile | None = None, table: Sequence[Choice] = ()
) -> Suggestion:
    """Return a mapping for the numbers of a bag with a name, or of a table with choices for its time and form.

    The mass of the train file, if it is known, shows the unit of the force, and its line may have the gradients.
    """
    head = (
        f'Suggested by trainid {"import" if table else "info"} --suggest-map for {name}: '
        f'{numbers.duration_s / 60.0:.0f} min were read.',
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
    speeds = [item for item in own if item.field == 'speed'] or _possible_speeds(foreign) or _speeds_by_numbers(foreign)
    if not speeds:
        return []
    speed, position, motion = _choose_speed(speeds, [*foreign, *own], train_file)
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


# Correlation of two speeds of one train, and of a position with the integral of its speed [1].
_MIN_ALIKE: Final = 0.9
# Correlation of a force or a brake with the acceleration [1], and without a name that says so.
_MIN_CORRELATION: Final = 0.3
_MIN_NAMELESS: Final = 0.6
# Largest number of a step of a lever [1]: twice the 8 of the AAR's lever for locomotives, chosen, not measured.
_MAX_NOTCH: Final = 16


def trains_in(series: Sequence[NumberSeries]) -> tuple[str, ...]:
    """Return the namespaces of the trains if there are several, empty if not."""
    groups: dict[tuple[str, str, str], dict[str, NumberSeries]] = defaultdict(dict)
    for item in _possible_speeds(series):
        for at in re.finditer(r'(?<!^)/', item.topic):
            namespace, name = item.topic[: at.start()], item.topic[at.end() :]
            groups[namespace.rpartition('/')[0], name, item.field][namespace] = item
    for speeds in groups.values():
        are_named = all(re.fullmatch(r'(?:.*/)?train_?\d+', name, re.IGNORECASE) for name in speeds)
        if len(speeds) > 1 and (are_named or _drive_apart(speeds, series)):
            return tuple(sorted(speeds))
    return ()


def _drive_apart(speeds: Mapping[str, NumberSeries], series: Sequence[NumberSeries]) -> bool:
    """Return whether each namespace has a force, and not all have the same speed."""
    forces = [item.topic for item in series if score('force', item.topic, item.field) > 0.0]
    if not all(any(topic.startswith(f'{namespace}/') for topic in forces) for namespace in speeds):
        return False
    first, *others = speeds.values()
    times = common_times(first)
    speed = abs(at_times(first, times))
    return any(correlation(speed, abs(at_times(other, times))) < _MIN_ALIKE for other in others)


@dataclass(frozen=True, slots=True)
class _Motion:
    """The speed that was chosen, at common times, and the train file if it is known."""

    train_file: TrainFile | None
    times: Array  # Common times [s], shape (n,)
    speed: Array  # Speed [m/s], shape (n,)
    acceleration: Array  # Its derivative [m/s^2], shape (n,)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Where the train moves, shape (n,)."""
        return self.speed > 1.0

    @property
    def minutes(self) -> str:
        """Over how long it is known."""
        return f'over {max(1, round((self.times[-1] - self.times[0]) / 60.0))} min'


def _possible_speeds(series: Iterable[NumberSeries]) -> list[NumberSeries]:
    return [
        item
        for item in series
        if np.ptp(item.value) > 0.0 and item.time.size > 2 and item.rate >= 1.0
        if score('speed', item.topic, item.field) > 0.0 >= score('acceleration', item.topic, item.field)
    ]


def _speeds_by_numbers(series: Sequence[NumberSeries]) -> list[NumberSeries]:
    """Return nameless candidates for a speed: never negative, slow, and with an integral or a force among the rest."""
    found = []
    for item in series:
        if not is_nameless(item) or item.is_whole or not item.rate >= 1.0:
            continue
        top = float(np.max(item.value))
        if not top > 0.0 or float(np.min(item.value)) < -0.02 * top:
            continue
        # A speed changes by a quarter of its largest value in a second at most.
        if not _steepest(item) <= 0.25 * top:
            continue
        rank = _rank(item, series)
        if rank.position is not None or abs(rank.push[0]) > _MIN_NAMELESS:
            found.append(item)
    return found


def _steepest(speed: NumberSeries) -> float:
    """Return the size below which 99 % of the changes in a second are, NaN for too few seconds."""
    changes = np.abs(derivative(at_times(speed, common_times(speed))))
    return float(np.nanpercentile(changes, 99.0)) if np.isfinite(changes).any() else math.nan


class _Ranked(NamedTuple):
    points: float  # Evidence by name and numbers
    speed: NumberSeries
    position: NumberSeries | None  # Its integral, if there is one
    travel: Travel  # How both go together
    push: tuple[float, str]  # Largest correlation of its derivative with another number [1], and which that is


def _choose_speed(
    speeds: Sequence[NumberSeries], series: Sequence[NumberSeries], train_file: TrainFile | None
) -> tuple[Choice, list[Choice], _Motion]:
    """Return the choice among speeds, that of the position, if there is one, and the motion."""
    ranked = sorted((_rank(item, series) for item in speeds), key=lambda item: -item.points)
    best = ranked[0] if ranked[0].position is not None else _with_position(ranked[0], series)
    unit, length, reason, decisions = _speed_unit(best)
    times = common_times(best.speed)
    speed_si = find_unit(unit, 'speed').factor * np.abs(at_times(best.speed, times))
    motion = _Motion(train_file, times, speed_si, derivative(speed_si))
    choice = Choice('speed', (Part(best.speed, unit),), decisions=decisions)
    if is_nameless(best.speed):
        top = np.max(best.speed.value)
        choice.reasons.append(f'no name says speed; by its numbers: never negative, up to {top:.3g}')
        choice.decisions.append('whether this is the speed')
    if abs(best.push[0]) > _MIN_CORRELATION:
        choice.reasons.append(f'correlation {best.push[0]:.2f} of its derivative with {best.push[1]} {motion.minutes}')
    choice.reasons.append(reason)
    fastest = float(np.nanmax(speed_si))
    # No train exceeds the largest speed of its train file by half.
    if train_file is not None and fastest > 1.5 * (limit := train_file.train.max_speed):
        choice.decisions.append(f'unit {unit} makes it up to {fastest:.3g} m/s, beyond max_speed = {limit:.3g} m/s')
    others = ((item.speed.name, np.abs(at_times(item.speed, times))) for item in ranked[1:])
    if alike := [name for name, other in others if abs(correlation(motion.speed, other)) > _MIN_ALIKE]:
        choice.decisions.append(f'also like a speed: {listed(alike, 3)}')
    if best.position is None:
        return choice, [], motion
    position = Choice('position', (Part(best.position, length or 'm'),))
    if is_nameless(best.position):
        position.decisions.append('whether this is the position: no name says so')
    metres = find_unit(length or 'm', 'length').factor
    if found := jumps(best.speed, best.position, best.travel.ratio, _LEAST_JUMP_M / metres):
        rows = ', '.join(f'[{metres * at:.1f}, {metres * by:.1f}]' for at, by in found[:_MOST_JUMPS])
        position.decisions.append(f'it jumps while the train runs; if kilometre posts do, add chainage: [{rows}]')
    position.reasons.append(f'correlation {best.travel.correlation:.2f} of its changes with the integral of the speed')
    if not length:
        position.decisions.append(f'no units fit {best.travel.ratio:.4g} for each {unit} and second: gain or unit')
    return choice, [position], motion


def _rank(speed: NumberSeries, series: Sequence[NumberSeries]) -> _Ranked:
    """Return the evidence for a speed: its name, a position that is its integral, a force or acceleration."""
    times, by_numbers = common_times(speed), is_nameless(speed)
    slope = derivative(np.abs(at_times(speed, times)))
    position, travel, push = None, Travel(0.0, math.nan), (0.0, '')
    for item in series:
        if item is speed or np.ptp(item.value) == 0.0:
            continue
        where = item.topic, item.field
        unnamed = by_numbers and is_nameless(item)
        if unnamed or (score('position', *where) > 0.0 and score('speed', item.field, item.field) <= 0.0):
            found = compare_travel(speed, item)
            if found.correlation > travel.correlation:
                position, travel = item, found
        if unnamed or max(score('force', *where), score('acceleration', *where)) > 0.0:
            with_it = correlation(slope, at_times(item, times))
            if abs(with_it) > abs(push[0]):
                push = (with_it, item.name)
    if travel.correlation < _MIN_ALIKE:
        position = None
    points = score('speed', speed.topic, speed.field) + 2.0 * (position is not None) + 1.5 * abs(push[0])
    if position is not None:
        points -= 10.0 * min((off for _, _, off in _units_off(travel.ratio)), default=_MAX_OFF)
    return _Ranked(points + 0.1 * speed.has_stamps + 0.001 * min(speed.rate, 50.0), speed, position, travel, push)


# Smallest step of a position that is no correction of the odometer [m], and how many of them are named.
_LEAST_JUMP_M: Final = 20.0
_MOST_JUMPS: Final = 6


def _with_position(best: _Ranked, series: Iterable[NumberSeries]) -> _Ranked:
    """Return a speed with the position that is its integral though no name says so, if there is one."""
    unnamed = [item for item in series if item is not best.speed and is_nameless(item) and np.ptp(item.value) > 0.0]
    compared = [(compare_travel(best.speed, item), item) for item in unnamed]
    fitting = [pair for pair in compared if pair[0].correlation > _MIN_ALIKE and _units_off(pair[0].ratio)]
    if not fitting:
        return best
    travel, position = max(fitting, key=lambda pair: pair[0].correlation)
    return best._replace(position=position, travel=travel)


_MAX_OFF: Final = 0.04  # share by which a worn wheel or a coarse position may be off [1]


def _units_off(ratio: float) -> list[tuple[str, str, float]]:
    """Return the units of speed and position that fit a ratio of both, and by how much it is off [1]."""
    return [
        (unit, length, off)
        for length, meters in unit_factors('length').items()
        for unit, meters_per_s in unit_factors('speed').items()
        if (off := abs(ratio * meters / meters_per_s - 1.0)) < _MAX_OFF
    ]


def _speed_unit(best: _Ranked) -> tuple[str, str, str, list[str]]:
    """Return the units of speed and position ('' if none fits both), the reason, and what to decide."""
    speed, position = best.speed, best.position
    named = unit_in(speed, 'speed')
    found = _units_off(best.travel.ratio)
    if position is not None and found:
        also = unit_in(position, 'length')
        unit, length, _ = max(found, key=lambda pair: (pair[0] == named) + (pair[1] == also))
        reason = (
            f'unit {unit}: {position.name} changes by {best.travel.ratio:.4g} for each unit and '
            f'second (correlation {best.travel.correlation:.2f}), so positions are in {length}'
        )
        contradiction = f'its name says {named}, its integral {unit}'
        return unit, length, reason, [contradiction] if named not in {'', unit} else []
    if named:
        return named, '', f'unit {named}: by its name', []
    top = float(np.max(np.abs(speed.value)))
    steep = _steepest(speed)
    unit = 'km/h' if top > 60.0 or steep > 1.6 else 'm/s'  # no train reaches 60 m/s, or changes by 1.6 m/s^2 for long
    reason = f'unit {unit}: up to {top:.3g}'
    reason += f', and 99 % of its changes below {steep:.2g} a second' if steep >= 0.0 else ''
    return unit, '', reason, ['nothing but its range shows the unit of the speed']


# Largest number in each unit, where only the range shows it.
_MAX_IN: Final = {
    'force': {'kN': 2000.0, 'N': math.inf},
    'gradient': {'rad': 0.1, 'percent': 6.0, 'per_mille': math.inf},
    'mass': {'t': 3000.0, 'kg': math.inf},
}


def _unit_by_range(quantity: str, top: float) -> str:
    return next(unit for unit, limit in _MAX_IN[quantity].items() if top <= limit)


def _choose_force(series: Sequence[NumberSeries], motion: _Motion) -> list[Choice]:
    """Return the sources whose sum goes with the acceleration best; empty if nothing does."""
    groups: dict[tuple[str, str, str], list[NumberSeries]] = {}
    for item in series:
        if score('force', item.topic, item.field) <= 0.0 or _is_notch(item):
            continue
        if abs(correlation(at_times(item, motion.times), motion.acceleration)) > _MIN_CORRELATION:
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


def _by_numbers(series: Sequence[NumberSeries], motion: _Motion) -> list[NumberSeries]:
    """Return the number without a name that goes with the acceleration best and is not the acceleration; or none."""
    ranked = []
    for item in (item for item in series if is_nameless(item) and not item.is_whole):
        values = at_times(item, motion.times)
        fit = regress(motion.acceleration, [values], motion.moving)
        if fit is not None and not any(0.8 < abs(fit.slopes[0]) / unit < 1.25 for unit in (1.0, G)):  # no acceleration
            ranked.append((abs(correlation(values, motion.acceleration)), item))
    best = max(ranked, key=lambda entry: entry[0], default=None)
    return [best[1]] if best is not None and best[0] > _MIN_NAMELESS else []


def _sum_at(items: Iterable[tuple[NumberSeries, float]], motion: _Motion) -> Array:
    """Return the sum of series, each with its factor, at the common times, shape (n,)."""
    return np.asarray(np.sum([factor * at_times(item, motion.times) for item, factor in items], axis=0))


def _as_force(groups: list[list[NumberSeries]], motion: _Motion) -> list[Choice]:
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
    # A thousand pounds are like a per cent of the force of many trains.
    units = {name: size for name, size in unit_factors('force').items() if name != 'klbf' or named == name}
    fitting = nearest_unit(newtons, units)
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
    series: Iterable[NumberSeries], motion: _Motion, total: Array | None, position: Sequence[Choice]
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


def _compare_line(choice: Choice, position: Part, motion: _Motion, total: Array | None, train_file: TrainFile) -> None:
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


def _gradient(series: NumberSeries, motion: _Motion, total: Array | None) -> tuple[float, Choice]:
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


def _slowing(x: Array, motion: _Motion, total: Array | None) -> tuple[float, float]:
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
            unit = named or nearest_unit(mass / value, units)
            if not unit or not is_near(units[unit] * value, mass):
                continue
            choice.reasons.append(f'unit {unit}: the train file says {mass:.4g} kg')
        choice.parts = (Part(item, unit),)
        return [choice]
    return []


_MIN_BRAKING: Final = 0.1  # deceleration of a brake that acts [m/s^2]


def _choose_brake(series: Sequence[NumberSeries], motion: _Motion, effort: Array | None) -> list[Choice]:
    """Return the brake command: a number that is named so and precedes decelerations; empty if none does.

    ``effort`` is the force by mass [m/s^2], shape (n,), None if it is not known. While braking it is the effort of a
    nominal brake, which is what a command asks for.
    """
    ranked = []  # the likeliest first: rank, by how much a number precedes decelerations [s], correlation, number
    for item in series:
        named = score('brake_command', item.topic, item.field)
        if named > 0.0 and np.ptp(item.value) > 0.0:
            lag_s, with_it = _precedes(item, motion, motion.acceleration)
            if abs(with_it) > _MIN_CORRELATION:
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
    if item.is_whole and np.unique(item.value).size <= 16:
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


def _precedes(item: NumberSeries, motion: _Motion, acceleration: Array) -> tuple[float, float]:
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
