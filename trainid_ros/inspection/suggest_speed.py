# SPDX-License-Identifier: Apache-2.0
"""Choose the speed among the numbers of a bag or a table, with its unit and the position that is its integral."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_ros.inputs.units import find_unit, unit_factors
from trainid_ros.inspection.choice import Choice, Part
from trainid_ros.inspection.number_series import (
    Array,
    NumberSeries,
    Travel,
    at_times,
    common_times,
    compare_travel,
    correlation,
    derivative,
    is_nameless,
    jumps,
    score,
    unit_in,
)
from trainid_ros.interface.text import listed
from trainid_ros.train.train_file import TrainFile

# Correlation of two speeds of one train, and of a position with the integral of its speed [1].
_MIN_ALIKE: Final = 0.9
# Correlation of a force or a brake with the acceleration [1], and without a name that says so.
MIN_CORRELATION: Final = 0.3
MIN_NAMELESS: Final = 0.6


def trains_in(series: Sequence[NumberSeries]) -> tuple[str, ...]:
    """Return the namespaces of the trains if there are several, empty if not."""
    groups: dict[tuple[str, str, str], dict[str, NumberSeries]] = defaultdict(dict)
    for item in possible_speeds(series):
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
class Motion:
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


def possible_speeds(series: Iterable[NumberSeries]) -> list[NumberSeries]:
    """Return the numbers that change and have a name of a speed, at least one a second."""
    return [
        item
        for item in series
        if np.ptp(item.value) > 0.0 and item.time.size > 2 and item.rate >= 1.0
        if score('speed', item.topic, item.field) > 0.0 >= score('acceleration', item.topic, item.field)
    ]


def speeds_by_numbers(series: Sequence[NumberSeries]) -> list[NumberSeries]:
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
        if rank.position is not None or abs(rank.push[0]) > MIN_NAMELESS:
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


def choose_speed(
    speeds: Sequence[NumberSeries], series: Sequence[NumberSeries], train_file: TrainFile | None
) -> tuple[Choice, list[Choice], Motion]:
    """Return the choice among speeds, that of the position, if there is one, and the motion."""
    ranked = sorted((_rank(item, series) for item in speeds), key=lambda item: -item.points)
    best = ranked[0] if ranked[0].position is not None else _with_position(ranked[0], series)
    unit, length, reason, decisions = _speed_unit(best)
    times = common_times(best.speed)
    speed_si = find_unit(unit, 'speed').factor * np.abs(at_times(best.speed, times))
    motion = Motion(train_file, times, speed_si, derivative(speed_si))
    choice = Choice('speed', (Part(best.speed, unit),), decisions=decisions)
    if is_nameless(best.speed):
        top = np.max(best.speed.value)
        choice.reasons.append(f'no name says speed; by its numbers: never negative, up to {top:.3g}')
        choice.decisions.append('whether this is the speed')
    if abs(best.push[0]) > MIN_CORRELATION:
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
        position.decisions.append(
            f'it jumps while the train runs; if kilometre posts do, add a line beside position: chainage: [{rows}]'
        )
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
