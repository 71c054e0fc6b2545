# SPDX-License-Identifier: Apache-2.0
"""A suggested mapping: what each input may come from, why, and what the reader must decide; and its text.

The balance of forces in numbers over time: it tells which number is what, and in which unit.

    (1 + gamma) M dv/dt = F - M g (w(v) + i) / 1000

The slope of the acceleration over a force is 1 / ((1 + gamma) M) in its unit, over a gradient -g / (1 + gamma) / 1000.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.inspection.number_series import NumberSeries

    Array = NDArray[np.float64]

USUAL_ROTARY: Final = 0.08
"""Share by which rotating masses raise the inertia of a usual train [1]."""
PER_MILLE: Final = {'per_mille': 1.0, 'percent': 10.0, 'deg': 1000.0 * math.pi / 180.0, 'rad': 1000.0}
"""Per mille in each unit of a gradient."""
# Slopes of regressions are exact to this factor [1].
_SLOPE_FACTOR: Final = 1.6
# Residuals over this time may be alike, as in a gust [s].
_ALIKE_S: Final = 20.0
STEP_S: Final = 0.2
"""Interval of the common times [s]."""
# Half of the time over which a derivative is taken [steps].
_HALF: Final = 5
# Values farther apart are not interpolated [s]; slower series are always.
_LONGEST_S: Final = 1.5
FEWEST: Final = 50
"""Fewest numbers that show anything."""
# Changes of a position are compared with the distance over so much time, at least [s], and at most.
_SPAN_S: Final = (8.0, 900.0)


def common_times(speed: NumberSeries) -> Array:
    """Return the times at which all series are compared with a speed [s], shape (n,)."""
    return np.arange(speed.time[0], speed.time[-1], STEP_S)


def at_times(series: NumberSeries, times: Array) -> Array:
    """Return the numbers at times [s], shape (n,): interpolated, NaN in gaps; whole and rare ones are held."""
    after = np.searchsorted(series.time, times, side='right')
    before = np.clip(after - 1, 0, series.time.size - 1)
    if series.is_whole or not series.rate > 1.0 / _LONGEST_S:
        held: Array = np.where(after > 0, series.value[before], math.nan)
        return held
    values = np.interp(times, series.time, series.value, left=math.nan, right=math.nan)
    gap = series.time[np.clip(after, 0, series.time.size - 1)] - series.time[before]
    return np.where(gap > _LONGEST_S, math.nan, values)


def derivative(values: Array) -> Array:
    """Return the change per second of values at common times, shape (n,); NaN at the ends."""
    slope = np.full_like(values, math.nan)
    slope[_HALF:-_HALF] = (values[2 * _HALF :] - values[: -2 * _HALF]) / (2 * _HALF * STEP_S)
    return slope


def correlation(x: Array, y: Array) -> float:
    """Return the correlation of two series where both are known [1]; 0 if that is hardly anywhere."""
    known = np.isfinite(x) & np.isfinite(y)
    if np.count_nonzero(known) < FEWEST or np.ptp(x[known]) == 0.0 or np.ptp(y[known]) == 0.0:
        return 0.0
    return float(np.corrcoef(x[known], y[known])[0, 1])


class Travel(NamedTuple):
    """A position compared with the integral of a speed."""

    correlation: float  # Correlation of their changes [1]
    ratio: float  # Change of the position for each unit of the speed and second


def compare_travel(speed: NumberSeries, position: NumberSeries) -> Travel:
    """Compare changes of a position with the integral of a speed, between its stamps."""
    steps = np.diff(speed.time)
    mean = 0.5 * (np.abs(speed.value[1:]) + np.abs(speed.value[:-1]))
    distance = np.concatenate(([0.0], np.cumsum(np.where(steps < _SPAN_S[0], mean * steps, 0.0))))
    inside = (position.time >= speed.time[0]) & (position.time <= speed.time[-1]) & np.isfinite(position.value)
    time, value = position.time[inside], position.value[inside]
    if time.size == 0:
        return Travel(0.0, math.nan)
    bins = np.floor((time - time[0]) / _SPAN_S[0])
    first = np.concatenate(([True], np.diff(bins) > 0.0))
    time, value = time[first], value[first]
    gone, elapsed = np.diff(np.interp(time, speed.time, distance)), np.diff(time)
    change = np.abs(np.diff(value))
    usable = (elapsed < _SPAN_S[1]) & (gone > 0.0)
    if np.count_nonzero(usable) < _HALF or not change[usable].any():
        return Travel(0.0, math.nan)
    # Positions are set anew now and then.
    usual = float(np.median(change[usable] / gone[usable]))
    usable &= np.abs(change - usual * gone) <= 0.3 * usual * gone + 1e-3 * float(change[usable].max())
    if np.count_nonzero(usable) < _HALF or np.ptp(gone[usable]) == 0.0 or np.ptp(change[usable]) == 0.0:
        return Travel(0.0, math.nan)
    share = float(np.mean(usable[gone > 0.0]))
    ratio = float(change[usable] @ gone[usable]) / float(gone[usable] @ gone[usable])
    return Travel(float(np.corrcoef(gone[usable], change[usable])[0, 1]) * share, ratio)


class Fit(NamedTuple):
    """A regression."""

    slopes: tuple[float, ...]  # Coefficients of the regressors
    share: float  # Explained share of the variance [1]


def regress(y: Array, columns: Sequence[Array], moving: NDArray[np.bool_]) -> Fit | None:
    """Return the regression of y on columns and a constant, where all are known and the train moves; None if nowhere.

    Args:
        y: Shape (n,).
        columns: Each of shape (n,).
        moving: Shape (n,).
    """
    known = np.isfinite(y) & moving
    for column in columns:
        known &= np.isfinite(column)
    if np.count_nonzero(known) < FEWEST:
        return None
    design = np.column_stack([*(column[known] for column in columns), np.ones(np.count_nonzero(known))])
    scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
    slopes, *_ = np.linalg.lstsq(design / scale, y[known], rcond=1e-9)
    variance = float(np.var(y[known]))
    rest = float(np.mean((y[known] - design / scale @ slopes) ** 2))
    return Fit(tuple((slopes / scale)[:-1].tolist()), 1.0 - rest / variance if variance > 0.0 else 0.0)


class Slope(NamedTuple):
    """How one series follows another one apart from further series."""

    value: float  # Slope
    std: float  # Its standard deviation
    spread: float  # Standard deviation of the other series that the further ones do not explain
    share: float  # Share of the variance, of what the further ones leave, that the slope explains [1]


def partial_slope(y: Array, x: Array, others: Sequence[Array], time: Array) -> Slope | None:
    """Return the slope of y over x beside others and a constant; None where x does not change apart from them.

    Args:
        y: Shape (n,).
        x: Shape (n,).
        others: Each of shape (n,).
        time: Times that do not fall [s], shape (n,); residuals that are near in time are not independent.
    """
    design = np.column_stack([*others, np.ones(y.size)])
    design /= np.maximum(np.abs(design).max(axis=0), 1e-300)
    both = np.column_stack([y, x])
    rest_y, rest_x = (both - design @ np.linalg.lstsq(design, both, rcond=1e-9)[0]).T
    square = float(rest_x @ rest_x)
    if square <= 1e-9 * float(x @ x):
        return None
    slope = float(rest_x @ rest_y) / square
    rest = rest_y - slope * rest_x
    sums = np.bincount(np.floor(time / _ALIKE_S).astype(np.intp), weights=rest_x * rest)
    std = math.sqrt(float(sums @ sums) * sums.size / max(sums.size - 1, 1)) / square
    explained = slope * slope * square
    share = explained / total if (total := explained + float(rest @ rest)) > 0.0 else 0.0
    return Slope(slope, std, math.sqrt(square / y.size), share)


def is_near(size: float, expected: float) -> bool:
    """Return whether a slope may be another one, as slopes of regressions are exact."""
    return abs(math.log(size / expected)) < math.log(_SLOPE_FACTOR)


def nearest_unit(size: float, units: dict[str, float]) -> str:
    """Return the unit with a factor near a slope, '' if none is."""
    name = min(units, key=lambda item: abs(math.log(size / units[item])))
    return name if is_near(size, units[name]) else ''


_PLAIN: Final = re.compile(r'[A-Za-z/][A-Za-z0-9_/.]*')


@dataclass(frozen=True, slots=True)
class Part:
    """One source of a quantity, with what is not usual about it."""

    series: NumberSeries
    unit: str
    sign: float = 1.0
    table: tuple[tuple[float, float], ...] = ()

    def text(self, more: str = '') -> str:
        """Return it as in a mapping file; ``more`` are further keys."""
        words = [f'topic: {_quoted(self.series.topic)}', f'field: {_quoted(self.series.field)}']
        if self.table:
            words.append(f'table: {{{", ".join(f"{raw:g}: {value:g}" for raw, value in self.table)}}}')
        else:
            words.append(f'unit: {_quoted(self.unit)}')
        if self.sign < 0.0:
            words.append('sign: -1')
        if not self.series.has_stamps:
            words.append('stamp: receive')
        return f'{{{", ".join(words)}{more}}}'


@dataclass(slots=True)
class Choice:
    """What is suggested for one quantity."""

    quantity: str  # The quantity
    parts: tuple[Part, ...] = ()  # Its sources, which are summed
    text: str = ''  # What the file says in place of sources, '' with some
    reasons: list[str] = field(default_factory=list)  # What speaks for it
    decisions: list[str] = field(default_factory=list)  # What the reader must decide
    on_change: bool = False  # Whether commands come only when they change

    def lines(self) -> list[str]:
        """Return its lines in the file."""
        heads = [f'{self.quantity}: {described(part.series)}' for part in self.parts]
        said = [*(heads or [f'{self.quantity}: not on a topic']), *(f'  {reason}' for reason in self.reasons)]
        return [
            *(comment(line) for line in said),
            *(comment(f'  decide: {decision}') for decision in self.decisions),
            *self._body(),
        ]

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
        blocks = [[comment(line) for line in self.head], *(choice.lines() for choice in self.choices)]
        blocks.append([comment(line) for line in self.notes])
        if not any(choice.parts or choice.text for choice in self.choices):
            blocks.append(['{}'])
        return '\n\n'.join('\n'.join(block) for block in blocks if block)


def comment(text: str) -> str:
    """Return a text as one comment, whatever characters a name in it has."""
    return f'# {"".join(char if char.isprintable() else repr(char)[1:-1] for char in text)}'


def listed(names: Sequence[str], most: int = 6) -> str:
    """Return names with commas, no more than some of them."""
    more = f' and {len(names) - most} more' if len(names) > most else ''
    return f'{", ".join(names[:most])}{more}'


def described(series: NumberSeries) -> str:
    """Return topic, field, type and rate of a series."""
    rate = '' if math.isnan(series.rate) else f', {series.rate:.3g} Hz'
    return f'{series.topic} {series.field} ({series.type}{rate})'


def _quoted(text: str) -> str:
    return text if _PLAIN.fullmatch(text) else json.dumps(text)


_WORDS: Final = {
    'speed': 'speed velocity vel twist odo odom tacho kmh kph mph geschwindigkeit vitesse v',
    'position': 'position pos distance dist odometer chainage location where mileage kilometer km weg',
    'force': 'force effort traction tractive wrench thrust kn te zugkraft',
    'gradient': 'gradient grade slope incline inclination permille steigung neigung',
    'brake_command': 'brake braking notch decel deceleration handle bremse',
    'mass': 'mass load weight payload masse',
    'acceleration': 'acceleration accel acc',
}
_KNOWN: Final = {quantity: frozenset(words.split()) for quantity, words in _WORDS.items()}
# Words of what is never an input, and of components across the train.
_OTHER: Final = frozenset(
    {'temperature', 'temp', 'voltage', 'volt', 'current', 'ampere', 'pressure', 'humidity', 'battery', 'fuel'}
    | {'angular', 'orientation', 'latitude', 'longitude', 'altitude', 'heading', 'yaw', 'roll', 'rpm', 'torque'}
)
_ACROSS: Final = frozenset({'y', 'z', 'w', 'lateral', 'vertical'})
_UNITS: Final = {
    'kmh': 'km/h', 'kph': 'km/h', 'mph': 'mph', 'mps': 'm/s', 'ms': 'm/s', 'km': 'km', 'm': 'm', 'ft': 'ft', 'mi': 'mi',
    'kn': 'kN', 'n': 'N', 'newton': 'N', 'lbf': 'lbf', 'permille': 'per_mille', 'percent': 'percent', 'pct': 'percent',
    'deg': 'deg', 'rad': 'rad', 'kg': 'kg', 't': 't', 'ton': 't', 'tons': 't', 'tonnes': 't', 'lb': 'lb',
}  # fmt: skip
_CAMEL: Final = re.compile(r'(?<=[a-z0-9])(?=[A-Z])')
_JOINED: Final = ((re.compile(r'km_?(?:per_?)?h(?![a-z])'), 'kmh'), (re.compile(r'per_mille'), 'permille'))
_NUMBERS: Final = re.compile(r'\d+|(?<![a-z])(?:front|rear|left|right|leading|trailing|[a-f])(?![a-z])')


def words_of(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case: ``/car1/tractionForce_kN`` has car, 1, traction, force and kn."""
    text = _CAMEL.sub('_', name.replace('kN', 'kn').replace('km/h', 'kmh')).lower()
    for pattern, word in _JOINED:
        text = pattern.sub(word, text)
    return tuple(re.findall(r'[a-z]+|\d+', text))


def score(quantity: str, topic: str, field: str) -> float:
    """Return how much a name says for a quantity [1]: up to 1 for the topic and for the field, less for other words."""
    known, topic_words, field_words = _KNOWN[quantity], words_of(topic), words_of(field)
    points = float(not known.isdisjoint(topic_words)) + float(not known.isdisjoint(field_words))
    words = (*topic_words, *field_words)
    return points - 2.0 * (not _OTHER.isdisjoint(words)) - 0.5 * (not _ACROSS.isdisjoint(words))


def is_nameless(topic: str, field: str) -> bool:
    """Return whether a name says nothing about what it carries."""
    return all(score(quantity, topic, field) == 0.0 for quantity in _KNOWN)


def unit_in(name: str, units: tuple[str, ...]) -> str:
    """Return the unit that a name states, one of those given; '' if it states none."""
    return next((unit for word in reversed(words_of(name)) if (unit := _UNITS.get(word, '')) in units), '')


def family(topic: str) -> str:
    """Return a topic without what tells alike ones apart, such as the numbers of motor cars."""
    return _NUMBERS.sub('#', topic.lower())
