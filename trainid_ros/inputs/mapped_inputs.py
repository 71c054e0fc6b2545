# SPDX-License-Identifier: Apache-2.0
"""Turn messages of any topics, or rows of a table, into the records of a train, by a mapping."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Callable
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

from trainid_ros.inputs.mapping import (
    UNKNOWN_EFFORT,
    Constant,
    LineLookup,
    Mapping,
    Signal,
    Source,
    SpeedIntegral,
    load_mapping,
    type_of,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
    stamp_of,
)
from trainid_ros.interface.text import pluralise
from trainid_ros.train.line import LineProfile, profile_of
from trainid_ros.train.train_file import Line, TrainFile

# Over a longer time without a speed the distance is unknown, and numbers farther apart are not interpolated [ns].
_MAX_GAP_NS: Final = NS_PER_S


class MappedInputs:
    """The inputs of one train; messages may come in any order of topics, and numbers in any order of sources."""

    def __init__(self, mapping: Mapping, train_file: TrainFile | None) -> None:
        """Take mapping and train; InputError if the gradient is to come from the line, but there is none."""
        self.mapping = mapping
        self._line = LineProfile(Line(), 1.0) if train_file is None else profile_of(train_file)
        line = self._line.line
        self.key = (mapping, line, train_file and train_file.train)  # inputs of equal keys give equal records
        if isinstance(mapping.gradient, LineLookup) and not line.gradient:
            missing = 'train file is given (--train)' if train_file is None else 'line.gradient is in the train file'
            raise InputError(f'mapping: gradient is to come from the line, but no {missing}')
        self._readers: dict[str, list[tuple[str, int, Source]]] = {}
        self._series: dict[str, JoinedSeries] = {}
        for quantity, signal in mapping.signals.items():
            self._series[quantity] = JoinedSeries(len(signal.sources))
            if signal.function is not None:
                signal.function.load()  # what cannot be used is said now
            for index, source in enumerate(signal.sources):
                self._readers.setdefault(source.topic, []).append((quantity, index, source))
        self._position = _DeadReckoning(mapping.position)
        self._chainage = _Chainage(mapping.chainage)
        # Messages by topic and number that is not in the table, and that of the last message of a topic.
        self._unlisted: Counter[tuple[str, float]] = Counter()
        self._last_unlisted: dict[str, float] = {}

    @property
    def warnings(self) -> list[str]:
        """Faults of the messages so far."""
        return [
            f'{topic}: {raw:g} is not in table ({pluralise(count, "message")})'
            for (topic, raw), count in sorted(self._unlisted.most_common(5))
        ] + self._chainage.doubts

    def problem(self, topic: str) -> str:
        """Return why the last message of a topic gives no number, '' if it does."""
        return f'{topic}: {raw:g} is not in table' if (raw := self._last_unlisted.get(topic)) is not None else ''

    @property
    def lacks_position(self) -> bool:
        """True while the gradient of the line cannot be looked up, as the position is not known."""
        return isinstance(self.mapping.gradient, LineLookup) and not math.isfinite(self._position.at)

    def stamp_ns(self, topic: str, message: Any, received_ns: int) -> int:
        """Return the stamp of a message [ns]; arguments and errors are those of :meth:`take`."""
        return _stamp(self._readers[topic][0][2], message, received_ns)

    def take(self, topic: str, message: Any, received_ns: int) -> list[Record]:
        """Return the records that a message completes, of any class with the fields of its type.

        The topic is named as in the mapping. InputError, naming topic and field, if the message lacks a field.
        """
        records: list[Record] = []
        self._last_unlisted.pop(topic, None)
        for quantity, index, source in self._readers[topic]:
            stamp_ns = _stamp(source, message, received_ns)
            value = source.value(raw := source.raw(message))
            if math.isnan(value) and source.table:
                self._unlisted[topic, raw] += 1
                self._last_unlisted[topic] = raw
            records += self.add(quantity, index, stamp_ns, value)
        return records

    def add(self, quantity: str, index: int, stamp_ns: int, value: float) -> list[Record]:
        """Return the records that a number of one source of a quantity, its :meth:`Source.value`, completes."""
        function = getattr(self.mapping, quantity).function
        records: list[Record] = []
        for at_ns, values in self._series[quantity].add(index, stamp_ns, value):
            whole = values[0] + sum(values[1:]) if function is None else function.of_numbers(values)
            records += self.put(quantity, at_ns, whole)
        return records

    def take_record(self, record: Record) -> list[Record]:
        """Return the records that a record of one of our own topics completes."""
        if not isinstance(record, SpeedRecord):
            return [record]
        return self._at_speed(record.stamp_ns, record.speed, record.position)

    def put(self, quantity: str, stamp_ns: int, value: float) -> list[Record]:
        """Return the records that a value of a quantity, in the unit of the interface, completes."""
        match quantity:
            case 'speed':
                return self._at_speed(stamp_ns, abs(value), math.nan)
            case 'position':
                near = self._position.at + self._position.travelled(stamp_ns)
                self._position.correct(stamp_ns, self._chainage.follow(value, near, self._position.direction))
                return []
            case 'force':
                return [ForceRecord(stamp_ns, value)]
            case 'gradient':
                return [self._gradient(stamp_ns, value)]
            case 'brake_command':
                is_known = value != UNKNOWN_EFFORT
                # A brake of unknown effort is taken for one of 0.1 m/s^2.
                return [BrakeRecord(stamp_ns, value if is_known else -0.1, emergency=not is_known)]
        return [MassRecord(stamp_ns, value)]

    def _at_speed(self, stamp_ns: int, speed: float, measured: float) -> list[Record]:
        """Return the records at a speed [m/s]: itself, and what comes from the line or is constant."""
        if self.mapping.position is None:
            self._position.correct(stamp_ns, measured)
        reckoned = self._position.move(stamp_ns, speed)
        position = measured if self.mapping.position is None else reckoned
        records: list[Record] = [SpeedRecord(stamp_ns, speed, position)]
        if isinstance(self.mapping.gradient, LineLookup) and math.isfinite(position):
            gradient = self._line.gradient(position, self._position.direction)
            records.append(self._gradient(stamp_ns, gradient))
        for quantity in ('gradient', 'brake_command'):
            if isinstance(constant := getattr(self.mapping, quantity), Constant):
                records += self.put(quantity, stamp_ns, constant.value)
        return records

    def _gradient(self, stamp_ns: int, gradient: float) -> GradientRecord:
        """Return the record of a gradient, with curve radius and tunnel of the line where the position is known."""
        position, direction = self._position.at, self._position.direction
        if not math.isfinite(position):
            return GradientRecord(stamp_ns, gradient, 0.0, tunnel=False)
        radius, tunnel = self._line.curve_radius(position, direction), self._line.tunnel(position, direction)
        return GradientRecord(stamp_ns, gradient, radius, tunnel)


def mapped_inputs(path: Path | None, train_file: TrainFile | None) -> Callable[[], MappedInputs] | None:
    """Return the factory of the inputs of a mapping file, None without one; InputError if it cannot be used."""
    if path is None:
        return None
    make = partial(MappedInputs, load_mapping(path), train_file)
    make()  # what does not fit the train file is said now
    return make


class _DeadReckoning:
    """Position ``at`` the last speed [m], NaN while it is not known, and direction: +1 while positions rise, or -1.

    The integral of the speed is corrected by measured positions.
    """

    def __init__(self, how: Signal | SpeedIntegral | None) -> None:
        self._how = how
        self._start_over()

    def _start_over(self) -> None:
        self.at, self.direction = math.nan, 1
        if isinstance(self._how, SpeedIntegral):
            self.at, self.direction = self._how.start, self._how.direction
        # Stamps of the last speed and of the one before it.
        self._stamp_ns = self._earlier_ns = 0
        self._speed = math.nan
        self._fix, self._fix_ns = math.nan, 0
        self._passed = math.nan

    def correct(self, stamp_ns: int, position: float) -> None:
        """Take in a measured position [m]; two of them show the direction if they are far enough apart."""
        if not math.isfinite(position):
            return
        if math.isnan(self._passed):
            self._passed = position
        elif abs(position - self._passed) >= 10.0:  # m; a smaller difference may be noise, above all at standstill
            self.direction = 1 if position > self._passed else -1
            self._passed = position
        self._fix, self._fix_ns = position, stamp_ns
        # To the stamp of the last speed, which may be earlier or later.
        self.at = position - self.travelled(stamp_ns)

    def travelled(self, stamp_ns: int) -> float:
        """Return the change of the position from the last speed to a stamp [m], 0 in a gap."""
        since_ns = stamp_ns - self._stamp_ns
        moves = math.isfinite(self._speed) and abs(since_ns) <= _MAX_GAP_NS
        return self.direction * self._speed * (since_ns / NS_PER_S) if moves else 0.0

    def move(self, stamp_ns: int, speed: float) -> float:
        """Follow a speed [m/s]; return the position at it [m]."""
        dt = (stamp_ns - self._stamp_ns) / NS_PER_S if self._stamp_ns else math.nan
        if self._stamp_ns and stamp_ns - self._stamp_ns < -_MAX_GAP_NS:
            # The stamps begin anew, as in a loop; or the last one was wrong, and the one before it was not.
            if not 0 <= stamp_ns - self._earlier_ns <= _MAX_GAP_NS:
                fix, fix_ns = self._fix, self._fix_ns
                self._start_over()
                if abs(stamp_ns - fix_ns) <= _MAX_GAP_NS:
                    self.correct(fix_ns, fix)
            self._stamp_ns, dt = stamp_ns, math.nan
        if 0.0 < dt <= _MAX_GAP_NS / NS_PER_S and math.isfinite(speed + self._speed):
            self.at += self.direction * 0.5 * (speed + self._speed) * dt
        if stamp_ns == self._fix_ns:
            self.at = self._fix
        if dt > 0.0:
            self._earlier_ns = self._stamp_ns
        self._stamp_ns, self._speed = max(stamp_ns, self._stamp_ns), speed
        return self.at


class _Chainage:
    """Kilometre posts of a line, which jump where it was rebuilt.

    A jump up leaves posts out; after a jump down some are there twice.
    """

    def __init__(self, jumps: tuple[tuple[float, ...], ...]) -> None:
        self._jumps, self._steps = jumps, [0.0] * len(jumps)  # of the distance at each jump, in sum [m]
        starts = (-math.inf, *(at + jump for at, jump in jumps))
        ends = (*(at for at, _ in jumps), math.inf)
        shifts = accumulate((0.0, *(-jump for _, jump in jumps)))
        self._sections = tuple(zip(starts, ends, shifts, strict=True))

    def follow(self, post: float, near: float, direction: int) -> float:
        """Return the distance as :meth:`distance`, and note a step of it where the posts jump, in this direction."""
        distance = self.distance(post, near)
        step = abs(distance - near)
        for place, ((_, jump), (_, end, shift)) in enumerate(zip(self._jumps, self._sections, strict=False)):
            if abs(distance - end - shift) < 3.0 * abs(jump) and 0.5 * abs(jump) < step < 2.5 * abs(jump):
                self._steps[place] += direction * (distance - near)
        return distance

    @property
    def doubts(self) -> list[str]:
        """What is doubtful: a jump of the wrong sign makes steps of twice its size, a right one none in sum."""
        return [
            f'chainage: is [{at:g}, {jump:g}] of the right sign? Position and speed disagree there by {abs(step):.0f} m'
            for (at, jump), step in zip(self._jumps, self._steps, strict=True)
            if abs(step) > 1.2 * abs(jump)
        ]

    def distance(self, post: float, near: float) -> float:
        """Return the distance along the line at a post, near another one if that is known [m]; NaN if unclear."""
        found = [post + shift for start, end, shift in self._sections if start <= post <= end]
        found.sort(key=lambda distance: abs(distance - near))
        if len(found) == 1 or (found and abs(found[0] - near) < 0.25 * abs(found[1] - found[0])):
            return found[0]
        return math.nan


def _stamp(source: Source, message: Any, received_ns: int) -> int:
    if not source.has_stamps:
        return received_ns
    try:
        return stamp_of(message)
    except AttributeError:
        raise InputError(f'topic {source.topic}: {type_of(message)} has no header; set stamp: receive') from None


class JoinedSeries:
    """The numbers of several series at the stamps of the first one; the others are interpolated linearly.

    They are ready as soon as all series have reached the stamp. One that is missing is NaN.
    """

    def __init__(self, count: int) -> None:
        # Stamps [ns] and numbers of each series, by stamp, over the last second.
        self._series: list[list[tuple[int, float]]] = [[] for _ in range(count)]
        self._open: list[tuple[int, float]] = []

    def add(self, index: int, stamp_ns: int, value: float) -> list[tuple[int, list[float]]]:
        """Add a number of a series; return those of all series that are ready, each with their stamp [ns]."""
        if len(self._series) == 1:
            return [(stamp_ns, [value])]
        series = self._series[index]
        if series and stamp_ns < series[-1][0] - _MAX_GAP_NS:
            # Stamps begin anew, as in a loop, or the last one was wrong.
            self._series, self._open = [[] for _ in self._series], []
        insort(self._series[index], (stamp_ns, value))
        if index == 0:
            insort(self._open, (stamp_ns, value))
        newest_ns = max(series[-1][0] for series in self._series if series)
        ready = []
        while self._open:
            at_ns, first = self._open[0]
            reached = all(series and series[-1][0] >= at_ns for series in self._series[1:])
            if not reached and newest_ns - at_ns <= _MAX_GAP_NS:
                break
            del self._open[0]
            ready.append((at_ns, [first, *(_interpolated(series, at_ns) for series in self._series[1:])]))
        needed_ns = newest_ns - _MAX_GAP_NS  # older ones are not open any more, and newer ones may still come
        for series in self._series:
            del series[: max(0, bisect_left(series, (needed_ns, -math.inf)) - 1)]
        return ready


def _interpolated(series: list[tuple[int, float]], at_ns: int) -> float:
    """Return the number of a series at a stamp, NaN outside it or in a long gap."""
    right = bisect_left(series, (at_ns, -math.inf))
    if right < len(series) and series[right][0] == at_ns:
        return series[right][1]
    if not 0 < right < len(series):
        return math.nan
    (start_ns, before), (end_ns, after) = series[right - 1], series[right]
    if end_ns - start_ns > _MAX_GAP_NS:
        return math.nan
    return before + (after - before) * (at_ns - start_ns) / (end_ns - start_ns)
