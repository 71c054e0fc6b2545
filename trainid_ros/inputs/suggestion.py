# SPDX-License-Identifier: Apache-2.0
"""A suggested mapping: what each input may come from, why, and what the reader must decide; and its text."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.bag.number_series import NumberSeries


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
