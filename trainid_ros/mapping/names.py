# SPDX-License-Identifier: Apache-2.0
"""What names of topics and fields say about what they carry and in which unit."""

from __future__ import annotations

import re
from typing import Final

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
