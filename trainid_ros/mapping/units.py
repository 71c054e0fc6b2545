# SPDX-License-Identifier: Apache-2.0
"""Units by name, and their conversion to those of the interface: SI, gradients in per mille."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.train.fields import did_you_mean

_DEGREE: Final = math.pi / 180.0
_FACTORS: Final[dict[str, dict[str, float]]] = {
    'speed': {'m/s': 1.0, 'km/h': 1.0 / 3.6, 'mph': 0.44704},
    'length': {'m': 1.0, 'km': 1e3, 'ft': 0.3048, 'mi': 1609.344},
    'force': {'N': 1.0, 'kN': 1e3, 'lbf': 4.4482216152605},
    'gradient': {'per_mille': 1.0, 'percent': 10.0},
    'acceleration': {'m/s^2': 1.0},
    'mass': {'kg': 1.0, 't': 1e3, 'lb': 0.45359237},
    'time': {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9, 'min': 60.0, 'h': 3600.0},
}
# Angles, as factors to radian.
_ANGLES: Final = {'rad': 1.0, 'deg': _DEGREE}
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
    """Return a unit by its name, or ``percent_of NUMBER UNIT``.

    Args:
        text: The name.
        quantity: 'speed', 'length', 'force', 'gradient', 'acceleration', 'mass' or 'time'.

    Raises:
        ValueError: The unit is not known for this quantity; the message says which are.
    """
    factors = _FACTORS[quantity]
    if text in factors:
        return Unit(text, factors[text])
    if quantity == 'gradient' and text in _ANGLES:
        return Unit(text, _ANGLES[text], is_angle=True)
    if text.startswith(_PERCENT_OF):
        return _percentage(text, factors)
    known = [*factors, *(_ANGLES if quantity == 'gradient' else ()), f'{_PERCENT_OF} NUMBER UNIT']
    raise ValueError(f'is not a unit of {quantity}; {did_you_mean(text, known)}')


def spelled(text: str, quantity: str) -> str:
    """Return the name of a unit of a quantity as it is spelled here; others may write another case, such as KM/H."""
    names = (*_FACTORS[quantity], *(_ANGLES if quantity == 'gradient' else ()))
    return next((name for name in names if name.lower() == text.lower()), text)


def _percentage(text: str, factors: dict[str, float]) -> Unit:
    words = text.split()
    try:
        _, number, name = words
        whole = float(number) * factors[name]
    except (ValueError, KeyError):
        whole = math.nan
    if not (math.isfinite(whole) and whole != 0.0):
        raise ValueError(
            f'must be like "{_PERCENT_OF} 300 {next(reversed(factors))}", with a unit of {", ".join(factors)}'
        )
    return Unit(text, whole / 100.0)
