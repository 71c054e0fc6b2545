# SPDX-License-Identifier: Apache-2.0
"""Suggest where speed and position come from, and their units: a speed is what a position is the integral of."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.mapping.evidence import Travel, at_times, common_times, compare_travel, correlation, derivative
from trainid_ros.mapping.names import is_nameless, score, unit_in
from trainid_ros.mapping.suggestion import Choice, Part, listed
from trainid_ros.mapping.units import find_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from trainid_ros.bag.number_series import NumberSeries
    from trainid_ros.mapping.evidence import Array

_SPEED_UNITS: Final = ('m/s', 'km/h', 'mph')
_LENGTH_UNITS: Final = ('m', 'km', 'mi', 'ft')
# Ratios of two units are told apart to this share [1].
_RATIO_ERROR: Final = 0.04
_CLOSE: Final = 0.9
_GOES_WITH: Final = 0.3
# A number with a larger maximum, or a larger 99th percentile of its changes a second, is no speed in m/s.
_FAST: Final = 60.0
_STEEP: Final = 1.6
# Without a name: the largest negative value, and change in a second, as shares of the largest value [1]; and the least
# correlation of the derivative with another number.
_NEGATIVE: Final = 0.02
_SUDDEN: Final = 0.25
_PUSHED: Final = 0.6


@dataclass(frozen=True, slots=True)
class Motion:
    """The speed that was chosen, at common times."""

    series: NumberSeries  # The speed as it is in the bag
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


def possible_speeds(series: Iterable[NumberSeries]) -> list[NumberSeries]:
    """Return what may be a speed."""
    found = []
    for item in series:
        moves = np.ptp(item.value) > 0.0 and item.time.size > 2 and item.rate >= 1.0
        if moves and score('speed', item.topic, item.field) > 0.0 >= score('acceleration', item.topic, item.field):
            found.append(item)
    return found


def speeds_by_numbers(series: Sequence[NumberSeries]) -> list[NumberSeries]:
    """Return what may be a speed although no name says so.

    It is never negative and changes slowly; and something is its integral, or goes with its derivative.
    """
    found = []
    for item in series:
        if not is_nameless(item.topic, item.field) or item.is_whole or not item.rate >= 1.0:
            continue
        top = float(np.max(item.value))
        if not top > 0.0 or float(np.min(item.value)) < -_NEGATIVE * top:
            continue
        steps = derivative(at_times(item, common_times(item)))
        if not np.isfinite(steps).any() or float(np.nanpercentile(np.abs(steps), 99.0)) > _SUDDEN * top:
            continue
        rank = _rank(item, series)
        if rank.position is not None or abs(rank.push[0]) > _PUSHED:
            found.append(item)
    return found


class _Ranked(NamedTuple):
    points: float
    speed: NumberSeries
    position: NumberSeries | None
    travel: Travel
    push: tuple[float, str]


def choose_speed(speeds: Sequence[NumberSeries], series: Sequence[NumberSeries]) -> tuple[Choice, list[Choice], Motion]:
    """Return the choice of the speed, that of the position, if there is one, and the motion.

    Args:
        speeds: What the speed may be.
        series: What position, force and accelerations may be.
    """
    ranked = sorted((_rank(item, series) for item in speeds), key=lambda item: -item.points)
    best = ranked[0]
    unit, reasons, decisions = _speed_unit(best)
    factor = find_unit(unit, 'speed').factor
    times = common_times(best.speed)
    speed_si = factor * np.abs(at_times(best.speed, times))
    motion = Motion(best.speed, times, speed_si, derivative(speed_si))
    choice = Choice('speed', (Part(best.speed, unit),), decisions=decisions)
    if is_nameless(best.speed.topic, best.speed.field):
        choice.reasons.append(
            f'no name says speed; by its numbers: never negative, up to {np.max(best.speed.value):.3g}'
        )
        choice.decisions.append('whether this is the speed')
    if abs(best.push[0]) > _GOES_WITH:
        choice.reasons.append(f'correlation {best.push[0]:.2f} of its derivative with {best.push[1]} {motion.minutes}')
    choice.reasons += reasons
    alike = [
        f'{item.speed.topic} {item.speed.field}'
        for item in ranked[1:]
        if abs(correlation(motion.speed, np.abs(at_times(item.speed, times)))) > _CLOSE
    ]
    if alike:
        choice.decisions.append(f'also like a speed: {listed(alike, 3)}')
    return choice, _position(best, unit), motion


def _rank(speed: NumberSeries, series: Sequence[NumberSeries]) -> _Ranked:
    """Return how much speaks for a speed: its name, a position that is its integral, a force or acceleration."""
    times, by_numbers = common_times(speed), is_nameless(speed.topic, speed.field)
    slope = derivative(np.abs(at_times(speed, times)))
    position, travel, push = None, Travel(0.0, math.nan), (0.0, '')
    for item in series:
        if item is speed or np.ptp(item.value) == 0.0:
            continue
        where = item.topic, item.field
        unnamed = by_numbers and is_nameless(*where)
        if unnamed or (score('position', *where) > 0.0 and score('speed', item.field, item.field) <= 0.0):
            found = compare_travel(speed, item)
            if found.correlation > travel.correlation:
                position, travel = item, found
        if unnamed or max(score('force', *where), score('acceleration', *where)) > 0.0:
            with_it = correlation(slope, at_times(item, times))
            if abs(with_it) > abs(push[0]):
                push = (with_it, f'{item.topic} {item.field}')
    if travel.correlation < _CLOSE:
        position = None
    points = score('speed', speed.topic, speed.field) + 2.0 * (position is not None) + 1.5 * abs(push[0])
    return _Ranked(points + 0.1 * speed.has_stamps + 0.001 * min(speed.rate, 50.0), speed, position, travel, push)


def _pairs(ratio: float) -> list[tuple[str, str]]:
    """Return units of speed and position that fit change of the position for each unit of the speed and second."""
    return [
        (speed, length)
        for length in _LENGTH_UNITS
        for speed in _SPEED_UNITS
        if abs(ratio * find_unit(length, 'length').factor / find_unit(speed, 'speed').factor - 1.0) < _RATIO_ERROR
    ]


def _pair(best: _Ranked) -> tuple[str, str]:
    """Return the units of speed and position, '' if none fit; names decide between several."""
    if best.position is None or not (pairs := _pairs(best.travel.ratio)):
        return '', ''
    named = unit_in(f'{best.speed.topic} {best.speed.field}', _SPEED_UNITS)
    also = unit_in(f'{best.position.topic} {best.position.field}', _LENGTH_UNITS)
    return max(pairs, key=lambda pair: (pair[0] == named) + (pair[1] == also))


def _speed_unit(best: _Ranked) -> tuple[str, list[str], list[str]]:
    """Return the unit of the speed, the reasons, and what to decide."""
    speed, position = best.speed, best.position
    named = unit_in(f'{speed.topic} {speed.field}', _SPEED_UNITS)
    unit, length = _pair(best)
    if position is not None and unit:
        reason = (
            f'unit {unit}: {position.topic} {position.field} changes by {best.travel.ratio:.4g} for each unit and '
            f'second (correlation {best.travel.correlation:.2f}), so positions are in {length}'
        )
        contradiction = f'its name says {named}, its integral {unit}'
        return unit, [reason], [contradiction] if named not in {'', unit} else []
    if named:
        return named, [f'unit {named}: by its name'], []
    top = float(np.max(np.abs(speed.value)))
    steep = float(np.nanpercentile(np.abs(derivative(at_times(speed, common_times(speed)))), 99.0))
    unit = 'km/h' if top > _FAST or steep > _STEEP else 'm/s'
    text = f'unit {unit}: up to {top:.3g}, and 99 % of its changes below {steep:.2g} a second'
    return unit, [text], ['nothing but its range shows the unit of the speed']


def _position(best: _Ranked, unit: str) -> list[Choice]:
    if (position := best.position) is None:
        return []
    _, length = _pair(best)
    choice = Choice('position', (Part(position, length or 'm'),))
    choice.reasons.append(f'correlation {best.travel.correlation:.2f} of its changes with the integral of the speed')
    if not length:
        choice.decisions.append(f'no units fit {best.travel.ratio:.4g} for each {unit} and second: gain or unit')
    return [choice]
