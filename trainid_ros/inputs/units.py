# SPDX-License-Identifier: Apache-2.0
"""Units of quantities, by their names in mappings and as files write them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.train.fields import did_you_mean

# Factor from each unit to that of the interface; angles to radian.
_FACTORS: Final[dict[str, dict[str, float]]] = {
    'speed': {'m/s': 1.0, 'km/h': 1.0 / 3.6, 'mph': 0.44704},
    'length': {'m': 1.0, 'km': 1e3, 'ft': 0.3048, 'mi': 1609.344},
    'force': {'N': 1.0, 'kN': 1e3, 'daN': 10.0, 'kgf': 9.80665, 'klbf': 4448.2216152605, 'lbf': 4.4482216152605},
    'gradient': {'per_mille': 1.0, 'percent': 10.0},
    'angle': {'rad': 1.0, 'deg': math.pi / 180.0},
    'acceleration': {'m/s^2': 1.0},
    'mass': {'kg': 1.0, 't': 1e3, 'short_ton': 907.18474, 'lb': 0.45359237},
    'time': {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9, 'min': 60.0, 'h': 3600.0},
}
_PERCENT_OF: Final = 'percent_of'


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit of a quantity."""

    name: str  # As in the file
    factor: float  # SI units (for gradients: per mille, for angles: radian) in this one
    is_angle: bool = False  # True for a gradient that is stated as the angle of the track

    def convert(self, value: float) -> float:
        """Return a value in the unit of the interface."""
        scaled = self.factor * value
        return 1000.0 * math.sin(scaled) if self.is_angle else scaled


def find_unit(text: str, quantity: str) -> Unit:
    """Return a unit of a quantity ('speed', 'length', ...) by its name, or ``percent_of NUMBER UNIT``.

    ValueError if it is not known for this quantity; the message says which are.
    """
    factors, known = _FACTORS[quantity], unit_factors(quantity)
    if text in known:
        return Unit(text, known[text], is_angle=text not in factors)
    if not text.startswith(_PERCENT_OF):
        raise ValueError(f'is not a unit of {quantity}; {did_you_mean(text, [*known, f"{_PERCENT_OF} NUMBER UNIT"])}')
    try:
        _, number, name = text.split()
        whole = float(number) * factors[name]
    except (ValueError, KeyError):
        whole = math.nan
    if not (math.isfinite(whole) and whole != 0.0):
        raise ValueError(
            f'must be like "{_PERCENT_OF} 300 {next(reversed(factors))}", with a unit of {", ".join(factors)}'
        )
    return Unit(text, whole / 100.0)


def unit_factors(quantity: str) -> dict[str, float]:
    """Return the factors of the units of a quantity, by name; see :class:`Unit`."""
    return _FACTORS[quantity] | (_FACTORS['angle'] if quantity == 'gradient' else {})


# Other ways to write units, in lower case.
_SPELLINGS: Final = {
    '‰': 'per_mille', '%o': 'per_mille', '0/00': 'per_mille', 'o/oo': 'per_mille', 'permille': 'per_mille',
    '%': 'percent', 'pct': 'percent', '°': 'deg', 'm/s²': 'm/s^2', 'm/s2': 'm/s^2',
    'km/hr': 'km/h', 'kmh': 'km/h', 'kph': 'km/h', '公里/小时': 'km/h', '千米/小时': 'km/h',
    'mps': 'm/s', 'ms': 'm/s', 'meters/second': 'm/s', '米/秒': 'm/s', '公里': 'km', '千米': 'km', '米': 'm',
    '千牛': 'kN', 'newton': 'N', '牛': 'N', 'ton': 't', 'tons': 't', 'tonnes': 't', '吨': 't', 'sec': 's', '秒': 's',
    'µs': 'us', '毫秒': 'ms', 'kp': 'kgf', 'short ton': 'short_ton', 'short tons': 'short_ton',
    'kip': 'klbf', 'kips': 'klbf', 'miles': 'mi', 'milepost': 'mi',
}  # fmt: skip
SUFFIXES: Final = frozenset({*_SPELLINGS, *(name.lower() for known in _FACTORS.values() for name in known)})
"""What may follow an underscore in a name as its unit, in lower case."""


def written_unit(text: str, quantity: str) -> str:
    """Return the unit of a quantity that a text states, whatever its case, or its last word; '' if it states none."""
    known = {name.lower(): name for name in unit_factors(quantity)}
    for word in (text.strip().lower(), *text.lower().split()[-1:]):
        for name in (word, _SPELLINGS.get(word, '').lower()):
            if name in known:
                return known[name]
    return ''
