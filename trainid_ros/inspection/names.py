# SPDX-License-Identifier: Apache-2.0
"""What names of topics, fields and columns say of the quantity in them, and of its unit."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from trainid_ros.inputs.table_files import bare
from trainid_ros.inputs.units import written_unit

if TYPE_CHECKING:
    from trainid_ros.inspection.number_series import NumberSeries

# Words in names that speak for a quantity.
_WORDS: Final = {
    'speed': 'speed velocity vel twist odo odom tacho kmh kph mph geschwindigkeit vitesse v 速度 车速',
    'position': 'position pos distance dist odometer chainage location where mileage kilometer km weg strecke pk 里程'
    ' 位置 公里标 距离',
    'force': 'force effort traction tractive wrench thrust kn te zugkraft bremskraft kraft 牵引力 制动力',
    'gradient': 'gradient grade slope incline inclination permille steigung neigung pente déclivité rampe 坡度',
    'brake_command': 'brake braking notch decel deceleration handle bremse bremsstufe bremsvorgabe'
    ' bremsanforderung bremsstellung frein freinage 制动 制动级位',
    'mass': 'mass load weight payload masse gewicht charge 质量 载重 重量',
    'acceleration': 'acceleration accel acc beschleunigung accélération 加速度',
    'time': 'time timestamp stamp utc t zeit uhrzeit zeitstempel temps heure horodatage date datum 时间 时刻',
}
_KNOWN: Final = {quantity: frozenset(words.split()) for quantity, words in _WORDS.items()}
_LETTERS: Final = {'s': 'position', 'x': 'position', 'f': 'force', 'i': 'gradient', 'm': 'mass', 'a': 'acceleration'}
"""Symbols that are the whole name of a column."""
# Words of other measurements.
_OTHER: Final = frozenset(
    {'temperature', 'temp', 'voltage', 'volt', 'current', 'ampere', 'pressure', 'humidity', 'battery', 'fuel'}
    | {'angular', 'orientation', 'latitude', 'longitude', 'altitude', 'heading', 'yaw', 'roll', 'rpm', 'torque'}
    | {'lat', 'lon', 'long', 'height', 'bearing', 'sats', 'engine', 'throttle'}
)
# Words of a speed that is demanded or allowed, or of statistics.
_DEMANDS: Final = frozenset(
    {'target', 'limit', 'permitted', 'setpoint', 'soll', 'sollgeschwindigkeit', 'consigne', 'average', 'mean', 'max'}
    | {'目标速度', '目标', '限速', '限制速度'}
)
# Words that are parts of longer ones, the longest first.
_PARTS: Final = re.compile(
    '|'.join(sorted((word for word in _DEMANDS.union(*_KNOWN.values()) if len(word) > 5 or ord(word[0]) > 0x2E80),
                    key=len, reverse=True))
)  # fmt: skip
_NUMBERS: Final = re.compile(r'\d+|(?<![a-z])(?:front|rear|left|right|leading|trailing|[a-f])(?![a-z])')


def words_of(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case: ``/car1/tractionForce_kN`` has car, 1, traction, force and kn."""
    text = re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', name.replace('kN', 'kn').replace('km/h', 'kmh')).lower()
    text = re.sub(r'km_?(?:per_?)?h(?![a-z])', 'kmh', text).replace('per_mille', 'permille')
    words = re.findall(r'[^\W\d_]+|\d+', text)
    return tuple(dict.fromkeys((*(word for word in words if ord(word[0]) < 0x2E80), *_PARTS.findall(text))))


def score(quantity: str, topic: str, field: str) -> float:
    """Return how much a name says for a quantity [1]: up to 1 for the topic and for the field, less for other words."""
    known, topic_words, field_words = _KNOWN[quantity], words_of(topic), words_of(field)
    points = float(not known.isdisjoint(topic_words)) + float(not known.isdisjoint(field_words))
    if not topic and _LETTERS.get(bare(field).rstrip('0123456789').lower()) == quantity:
        points += 1.0
    words = {*topic_words, *field_words}
    is_across = not words.isdisjoint({'y', 'z', 'w', 'lateral', 'vertical', 'vert'})  # a component across the train
    is_demand = quantity != 'brake_command' and not words.isdisjoint(_DEMANDS)
    return points - 2.0 * (not _OTHER.isdisjoint(words)) - 0.5 * is_across - 0.5 * is_demand


def is_nameless(series: NumberSeries) -> bool:
    """Return whether a name speaks for no quantity."""
    return all(score(quantity, series.topic, series.field) == 0.0 for quantity in _KNOWN)


def unit_in(series: NumberSeries, quantity: str) -> str:
    """Return the unit of a quantity that the file or the name states; '' if they state none."""
    texts = (series.type, *reversed(words_of(series.name)))
    return next((unit for text in texts if (unit := written_unit(text, quantity))), '')


def family(topic: str) -> str:
    """Return a topic without the marks of alike ones, such as the numbers of motor cars."""
    return _NUMBERS.sub('#', topic.lower())
