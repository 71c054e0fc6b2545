# SPDX-License-Identifier: Apache-2.0
"""What callers give the client: numbers with unit and range, plans over time, and a clock that only goes forward."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from numbers import Real
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.client.stopping import MAX_SPEED
from trainid_ros.interface.errors import InputError, SettingInfo, check_value
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from trainid_ros.client.prediction import Steps


@dataclass(frozen=True, slots=True)
class Argument:
    """A number, its unit and its closed range."""

    name: str  # as in error messages
    unit: str  # empty if there is none
    low: float  # lowest value [unit]
    high: float  # highest value [unit]

    def checked(self, value: object) -> float:
        """Return a number, which may be one of numpy, as a float; raise InputError if it is none or out of range."""
        if not isinstance(value, (float, Real)):  # float first, because an abstract class takes long
            raise InputError(f'{self.name} = {shown(value)} must be a number in {self.unit or "1"}')
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not self.low <= number <= self.high:
            check_value(self.name, number, SettingInfo('', self.unit, self.low, self.high))
        return number


SPEED: Final = Argument('speed', 'm/s', 0.0, MAX_SPEED)  # accepted speeds
GRADIENT: Final = Argument('gradient', 'per mille', -500.0, 500.0)  # accepted gradients, > 0 uphill
ACCELERATION: Final = Argument('acceleration', 'm/s^2', -20.0, 20.0)  # accepted accelerations
MASS: Final = Argument('mass', 'kg', 1.0, 1e9)  # accepted masses of the train
COMMAND: Final = Argument('command', 'm/s^2', -20.0, -1e-3)  # accepted brake commands
APPLIED: Final = Argument('applied', 'm/s^2', -20.0, 0.0)  # accepted brake commands that act now, 0 without
CONFIDENCE: Final = Argument('confidence', '', 0.5, 1.0 - 1e-6)  # accepted probabilities that a bound holds [1]
MAX_AGE: Final = Argument('max_age', 's', 0.01, 1e12)  # accepted limits of the age of the last estimate
MAX_STAMP_AGE: Final = Argument('max_stamp_age', 's', 0.1, 1e12)  # accepted differences between stamp and clock
DISTANCE: Final = Argument('distance', 'm', 0.0, 1e5)  # accepted distances to go
STOP: Final = Argument('stop', 'm', -1e9, 1e9)  # accepted positions of the stop
HORIZON: Final = Argument('horizon', 's', 0.01, 600.0)  # accepted times to predict
FORCE: Final = Argument('force', 'N', -1e9, 1e9)  # accepted forces at the wheel rim
_SINCE: Final = Argument('time of a force or command', 's', -60.0, 600.0)
POSITION: Final = Argument('position', 'm', -1e9, 1e9)
PLANNED: Final = Argument('command', 'm/s^2', -20.0, 0.0)
TARGET: Final = Argument('target_position', 'm', -1e9, 1e9)


def checked_direction(direction: int) -> int:
    """Return a direction; InputError unless it is 1 or -1."""
    if not isinstance(direction, (float, Real)) or direction not in (1, -1):
        raise InputError(f'direction = {shown(direction)} must be 1 or -1')
    return int(direction)


def distance_to(stop: float, position: object, direction: int) -> float:
    """Return the distance [m] from a position to a stop in the direction of travel, 0 beyond it."""
    return DISTANCE.checked(max(0.0, direction * (stop - POSITION.checked(position))))


_TIME: Final = Argument('clock()', 's', -1e12, 1e12)


STOPPED_S: Final = 2.0
"""Time after which a clock that stands still is taken to have stopped [s]; ``/clock`` comes several times a second."""


class ForwardClock:
    """The time of a clock [s] plus all that it has gone back: it goes on from where the clock jumped.

    A clock that returns no finite number stands still. One that has done so for ``STOPPED_S`` of a ``steady`` clock,
    goes on with that, so that silence is noticed; with ``runs`` also one that stands at a number, while a simulation
    may wait. A clock that is not callable, or returns no number at first, raises InputError.
    """

    def __init__(
        self, clock: Callable[[], float], steady: Callable[[], float] = time.monotonic, *, runs: bool = False
    ) -> None:
        self._steady, self._runs, self._offset_s, self._stood_s = steady, runs, 0.0, 0.0
        self._start(clock)

    def _start(self, clock: Callable[[], float]) -> None:
        if not callable(clock):
            raise InputError(f'clock = {clock!r} must be a function that returns the time in s')
        self._last_s, self._clock = _TIME.checked(clock()), clock
        self._moved_s = self._steady()

    def follow(self, clock: Callable[[], float]) -> None:
        """Go on with another clock from the present time; InputError as for the first one."""
        now = self.now()
        self._start(clock)
        self._offset_s, self._stood_s = now - self._last_s, 0.0

    def now(self) -> float:
        """Return the time [s], which is not before that of the last call."""
        read_s, steady_s = _number(self._clock()), self._steady()
        if math.isfinite(read_s) and (read_s != self._last_s or not self._runs):
            self._offset_s += self._stood_s + max(0.0, self._last_s - read_s)
            self._last_s, self._moved_s, self._stood_s = read_s, steady_s, 0.0
        elif steady_s - self._moved_s > STOPPED_S:
            self._stood_s = steady_s - self._moved_s
        return self._last_s + self._offset_s + self._stood_s


def _number(value: object) -> float:
    """Return a number as a float, NaN if it is none."""
    return float(value) if isinstance(value, (float, Real)) else math.nan


def steps_of(values: float | Steps, argument: Argument) -> list[tuple[float, float]]:
    """Return values from their time on; InputError if one is out of range, or the times do not rise."""
    if isinstance(values, (float, Real)):
        return [(0.0, argument.checked(values))]
    steps = []
    for row in rows_of(values, argument):
        if not isinstance(row, Sequence) or len(row) != 2:
            raise InputError(f'{argument.name} = {shown(row)} must be a number, or rows (time in s, {argument.unit})')
        steps.append((_SINCE.checked(row[0]), argument.checked(row[1])))
    if any(after <= before for (before, _), (after, _) in pairwise(steps)):
        raise InputError(f'{argument.name}: its times must rise')
    return steps


def rows_of(values: Any, argument: Argument) -> Sequence[Any]:
    """Return one value or several as a sequence; InputError if they are neither, or there is none."""
    if isinstance(values, (float, Real)):
        return (values,)
    try:
        rows = () if isinstance(values, (str, bytes, Mapping)) else tuple(values)
    except TypeError:
        rows = ()
    if not rows:
        raise InputError(f'{argument.name} = {shown(values)} must be a number in {argument.unit}, or several')
    return rows
