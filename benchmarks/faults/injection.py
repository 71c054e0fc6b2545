# SPDX-License-Identifier: Apache-2.0
"""Kinds of faults: each maps the rows of a drive to those that a faulty train would send."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from trainid_ros.interface.records import BRAKE, FORCE, GRADIENT, MASS, NS_PER_S, SPEED, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Change = Callable[[float, float, float, bool], tuple[float, float, bool]]

_TOPICS: Final[Mapping[str, int]] = {
    'speed': SPEED,
    'force': FORCE,
    'gradient': GRADIENT,
    'command': BRAKE,
    'mass': MASS,
}
_SMOOTH: Final = (SPEED, FORCE)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one or more inputs.

    Attributes:
        name: What happens.
        change: Returns the rows that are sent instead of those between two stamps [ns].
        clock_step_s: Step of the clock that stamps all messages [s].
        shifts_stamps: True if only stamps are changed, but not the times at which messages are sent.

    """

    name: str
    change: Callable[[Sequence[Row], int, int], list[Row]]
    clock_step_s: float = 0.0
    shifts_stamps: bool = False


def injected(rows: Sequence[Row], faults: Sequence[Fault], start_ns: int, end_ns: int) -> list[Row]:
    """Return rows with faults between two stamps [ns]."""
    changed = list(rows)
    for fault in faults:
        changed = fault.change(changed, start_ns, end_ns)
    return changed


def no_fault() -> Fault:
    """Return a fault that changes nothing."""
    return Fault('nothing', lambda rows, _start_ns, _end_ns: list(rows))


def value_fault(name: str, topic: str, change: Change) -> Fault:
    """Return a fault that changes the values of a topic; ``change`` gets the time since the start [s] and the row."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        return [
            (t, stamp, *change((stamp - start_ns) / NS_PER_S, x, y, flag))
            if t == place and start_ns <= stamp < end_ns
            else (t, stamp, x, y, flag)
            for t, stamp, x, y, flag in rows
        ]

    return Fault(f'{topic} {name}', apply)


def scaled(name: str, topic: str, factor: float, offset: float = 0.0) -> Fault:
    """Return a fault that scales the first value of a topic and adds an offset to it."""
    return value_fault(name, topic, lambda _t, x, y, flag: (factor * x + offset, y, flag))


def frozen(topic: str) -> Fault:
    """Return a fault that repeats the last value of a topic, with new stamps."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        held: Row | None = None
        sent = []
        for row in rows:
            if row[0] == place and start_ns <= row[1] < end_ns:
                held = held or row
                sent.append((place, row[1], held[2], held[3] if place != SPEED else row[3], held[4]))
            else:
                sent.append(row)
        return sent

    return Fault(f'{topic} frozen', apply)


def frozen_position() -> Fault:
    """Return a fault that repeats the last position, with the speeds as they are."""

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        held = math.nan
        sent = []
        for row in rows:
            if row[0] == SPEED and start_ns <= row[1] < end_ns:
                held = row[3] if math.isnan(held) else held
                sent.append((SPEED, row[1], row[2], held, row[4]))
            else:
                sent.append(row)
        return sent

    return Fault('speed position frozen', apply)


def missing(topic: str, name: str = 'missing', seconds: float = math.inf) -> Fault:
    """Return a fault that drops the messages of a topic for some time [s], at most until the end of the fault."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        last_ns = min(end_ns, start_ns + int(min(seconds, 1e6) * NS_PER_S))
        return [row for row in rows if row[0] != place or not start_ns <= row[1] < last_ns]

    return Fault(f'{topic} {name}', apply)


def missing_for_ever(topic: str) -> Fault:
    """Return a fault that drops the messages of a topic from its start on, for ever."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, _end_ns: int) -> list[Row]:
        return [row for row in rows if row[0] != place or row[1] < start_ns]

    return Fault(f'{topic} missing for ever', apply)


def all_missing(seconds: float) -> Fault:
    """Return a fault that drops the messages of all topics for some time [s]."""
    duration_ns = round(seconds * NS_PER_S)

    def apply(rows: Sequence[Row], start_ns: int, _end_ns: int) -> list[Row]:
        return [row for row in rows if not start_ns <= row[1] < start_ns + duration_ns]

    return Fault(f'all missing {seconds:g} s', apply)


def ten_times_faster(topic: str) -> Fault:
    """Return a fault where a topic comes ten times as often, with values between those of the drive."""
    place, factor = _TOPICS[topic], 10

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        own = [row for row in rows if row[0] == place and start_ns <= row[1] < end_ns]
        between = [_between(*pair, k / factor) for pair in pairwise(own) for k in range(1, factor)]
        return sorted((*rows, *between), key=lambda row: row[1])

    return Fault(f'{topic} ten times as often', apply)


def _between(row: Row, following: Row, share: float) -> Row:
    """Return a row at a share of the time to the following one; what is no smooth function of time is held."""
    topic, stamp, x, y, flag = row
    stamp += round(share * (following[1] - stamp))
    if topic not in _SMOOTH:
        return topic, stamp, x, y, flag
    return topic, stamp, x + share * (following[2] - x), y + share * (following[3] - y), flag


def at_one_hertz(topic: str) -> Fault:
    """Return a fault where a topic at 5 Hz comes at 1 Hz."""
    place, kept = _TOPICS[topic], 5

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        count, sent = 0, []
        for row in rows:
            inside = row[0] == place and start_ns <= row[1] < end_ns
            count += inside
            if not inside or count % kept == 0:
                sent.append(row)
        return sent

    return Fault(f'{topic} at 1 Hz', apply)


def late(topic: str, seconds: float) -> Fault:
    """Return a fault that stamps and sends the messages of a topic later than the values were true [s]."""
    place, shift = _TOPICS[topic], round(seconds * NS_PER_S)

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        moved = [
            (t, stamp + shift if t == place and start_ns <= stamp < end_ns else stamp, x, y, flag)
            for t, stamp, x, y, flag in rows
        ]
        return sorted(moved, key=lambda row: row[1])

    return Fault(f'{topic} {seconds:+g} s', apply)


def clock_apart(topic: str, seconds: float) -> Fault:
    """Return a fault where the clock that stamps a topic is off by a time [s]; messages are sent when they were."""
    place, shift = _TOPICS[topic], round(seconds * NS_PER_S)

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        return [
            (t, stamp + shift if t == place and start_ns <= stamp < end_ns else stamp, x, y, flag)
            for t, stamp, x, y, flag in rows
        ]

    return Fault(f'{topic} clock {seconds:+g} s', apply, shifts_stamps=True)


def spiked(topic: str, height: float, every: int = 20) -> Fault:
    """Return a fault that adds single spikes to a topic, one in every so many messages."""
    return _single(f'{topic} spikes', topic, lambda x: x + height, every)


def dropped(topic: str, every: int = 20) -> Fault:
    """Return a fault where single values of a topic are zero, one in every so many messages."""
    return _single(f'{topic} drops to zero', topic, lambda _: 0.0, every)


def _single(name: str, topic: str, change: Callable[[float], float], every: int) -> Fault:
    """Return a fault that changes the first value in one of every so many messages of a topic."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        count, sent = 0, []
        for t, stamp, x, y, flag in rows:
            inside = t == place and start_ns <= stamp < end_ns
            count += inside
            sent.append((t, stamp, change(x) if inside and count % every == 0 else x, y, flag))
        return sent

    return Fault(name, apply)


def duplicated(topic: str) -> Fault:
    """Return a fault that sends every message of a topic twice."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        return [row for row in rows for _ in range(2 if row[0] == place and start_ns <= row[1] < end_ns else 1)]

    return Fault(f'{topic} twice', apply)


def swapped(topic: str) -> Fault:
    """Return a fault that exchanges neighbouring messages of a topic."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        sent = list(rows)
        own = [k for k, row in enumerate(sent) if row[0] == place and start_ns <= row[1] < end_ns]
        for k, following in zip(own[::2], own[1::2], strict=False):
            sent[k], sent[following] = sent[following], sent[k]
        return sent

    return Fault(f'{topic} out of order', apply)


def clock_step(seconds: float) -> Fault:
    """Return a fault that steps the clock of all topics at the start of the fault, for ever."""
    shift = round(seconds * NS_PER_S)

    def apply(rows: Sequence[Row], start_ns: int, _end_ns: int) -> list[Row]:
        return [(t, stamp + shift if stamp >= start_ns else stamp, x, y, flag) for t, stamp, x, y, flag in rows]

    return Fault(f'clock {seconds:+g} s', apply, clock_step_s=seconds, shifts_stamps=True)


def second_command() -> Fault:
    """Return a fault where a second publisher says that the brake is released."""

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        sent = []
        for row in rows:
            sent.append(row)
            if row[0] == BRAKE and start_ns <= row[1] < end_ns:
                sent.append((BRAKE, row[1] + NS_PER_S // 10, -0.6 if row[2] == 0.0 else 0.0, 0.0, False))
        return sorted(sent, key=lambda row: row[1])

    return Fault('command second publisher', apply)
