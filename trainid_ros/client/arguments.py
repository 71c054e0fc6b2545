# SPDX-License-Identifier: Apache-2.0
"""Arguments of the client: names, units and ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Final

from trainid_ros.client.bounds import MOST_SPEED
from trainid_ros.errors import InputError
from trainid_ros.settings import SettingInfo, check_value
from trainid_ros.train.fields import shown


@dataclass(frozen=True, slots=True)
class Argument:
    """A number, its unit and its closed range."""

    name: str
    unit: str
    low: float
    high: float

    def checked(self, value: object) -> float:
        """Return a number, which may be one of numpy, as a float.

        Raises:
            InputError: It is not a number, not finite or out of range.

        """
        if not isinstance(value, (float, Real)):  # float first, because an abstract class takes long
            msg = f'{self.name} = {shown(value)} must be a number in {self.unit or "1"}'
            raise InputError(msg)
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not self.low <= number <= self.high:
            check_value(self.name, number, SettingInfo('', self.unit, self.low, self.high))
        return number


SPEED: Final = Argument('speed', 'm/s', 0.0, MOST_SPEED)
GRADIENT: Final = Argument('gradient', 'per mille', -500.0, 500.0)
ACCELERATION: Final = Argument('acceleration', 'm/s^2', -20.0, 20.0)
MASS: Final = Argument('mass', 'kg', 1.0, 1e9)
# The weakest brake command is -0.001 m/s^2.
COMMAND: Final = Argument('command', 'm/s^2', -20.0, -1e-3)
APPLIED: Final = Argument('applied', 'm/s^2', -20.0, 0.0)
CONFIDENCE: Final = Argument('confidence', '', 0.5, 1.0 - 1e-6)
MAX_AGE: Final = Argument('max_age', 's', 0.01, 1e12)
DISTANCE: Final = Argument('distance', 'm', 0.0, 1e5)
STOP: Final = Argument('stop', 'm', -1e9, 1e9)
_POSITION: Final = Argument('position', 'm', -1e9, 1e9)


def checked_direction(direction: int) -> int:
    """Return a direction; InputError unless it is 1 or -1."""
    if direction not in (1, -1):
        msg = f'direction = {direction!r} must be 1 or -1'
        raise InputError(msg)
    return int(direction)


def distance_to(stop: float, position: float, direction: int) -> float:
    """Return the distance [m] from a position to a stop in the direction of travel, 0 beyond it."""
    return DISTANCE.checked(max(0.0, direction * (stop - _POSITION.checked(position))))
