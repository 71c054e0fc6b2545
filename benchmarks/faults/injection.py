# SPDX-License-Identifier: Apache-2.0
"""Faults of single inputs: each maps the rows of a drive to those that a faulty train would send."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.records import BRAKE, FORCE, GRADIENT, NS_PER_S, SPEED, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Change = Callable[[float, float, float, bool], tuple[float, float, bool]]

KMH: Final = 3.6
G: Final = 9.81
_TOPICS: Final[Mapping[str, int]] = {'speed': SPEED, 'force': FORCE, 'gradient': GRADIENT, 'command': BRAKE}


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one or more inputs.

    Attributes:
        name: What happens.
        change: Returns the rows that are sent instead of those between two stamps [ns].
        clock_step_s: Step of the clock that stamps all messages [s].

    """

    name: str
    change: Callable[[Sequence[Row], int, int], list[Row]]
    clock_step_s: float = 0.0


def injected(rows: Sequence[Row], faults: Sequence[Fault], start_ns: int, end_ns: int) -> list[Row]:
    """Return rows with faults between two stamps [ns]."""
    changed = list(rows)
    for fault in faults:
        changed = fault.change(changed, start_ns, end_ns)
    return changed


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


def missing(topic: str, name: str = 'missing', seconds: float = math.inf) -> Fault:
    """Return a fault that drops the messages of a topic for some time [s]."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        last_ns = min(end_ns, start_ns + int(min(seconds, 1e6) * NS_PER_S))
        return [row for row in rows if row[0] != place or not start_ns <= row[1] < last_ns]

    return Fault(f'{topic} {name}', apply)


def late(topic: str, seconds: float) -> Fault:
    """Return a fault that stamps the messages of a topic later than the values were true, in the same order."""
    place, shift = _TOPICS[topic], round(seconds * NS_PER_S)

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        moved = [
            (t, stamp + shift if t == place and start_ns <= stamp < end_ns else stamp, x, y, flag)
            for t, stamp, x, y, flag in rows
        ]
        # A message is sent at its stamp.
        return sorted(moved, key=lambda row: row[1]) if shift > 0 else moved

    return Fault(f'{topic} {seconds:+g} s', apply)


def spiked(topic: str, height: float, every: int = 20) -> Fault:
    """Return a fault that adds single spikes to a topic, one in every so many messages."""
    place = _TOPICS[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        count, sent = 0, []
        for t, stamp, x, y, flag in rows:
            inside = t == place and start_ns <= stamp < end_ns
            count += inside
            sent.append((t, stamp, x + height if inside and count % every == 0 else x, y, flag))
        return sent

    return Fault(f'{topic} spikes', apply)


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

    return Fault(f'clock {seconds:+g} s', apply, seconds)


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


def _slipping(t: float, x: float, y: float, flag: bool) -> tuple[float, float, bool]:
    return x * (1.0 + 0.15 * max(0.0, math.sin(0.8 * t))), y, flag


FAULTS: Final = (
    scaled('in km/h', 'speed', KMH),
    scaled('5 % high', 'speed', 1.05),
    scaled('offset .5 m/s', 'speed', 1.0, 0.5),
    value_fault('slip', 'speed', _slipping),
    value_fault('not a number', 'speed', lambda _t, _x, y, flag: (math.nan, y, flag)),
    spiked('speed', 5.0),
    frozen('speed'),
    missing('speed'),
    missing('speed', 'missing 1 s', 1.0),
    late('speed', 0.5),
    late('speed', 1.0),
    late('speed', 3.0),
    duplicated('speed'),
    swapped('speed'),
    scaled('in kN', 'force', 1e-3),
    scaled('sign', 'force', -1.0),
    scaled('20 % high', 'force', 1.2),
    value_fault('drift', 'force', lambda t, x, y, flag: (x + 100.0 * t, y, flag)),
    value_fault('not a number', 'force', lambda _t, _x, y, flag: (math.nan, y, flag)),
    value_fault('infinite', 'force', lambda _t, _x, y, flag: (math.inf, y, flag)),
    spiked('force', 1e5),
    frozen('force'),
    missing('force'),
    late('force', 0.5),
    late('force', 1.0),
    duplicated('force'),
    swapped('force'),
    scaled('2 per mille high', 'gradient', 1.0, 2.0),
    scaled('sign', 'gradient', -1.0),
    value_fault('in per cent', 'gradient', lambda _t, x, y, flag: (0.1 * x, y, flag)),
    frozen('gradient'),
    missing('gradient'),
    late('gradient', 1.0),
    scaled('in g', 'command', 1.0 / G),
    scaled('sign', 'command', -1.0),
    value_fault('stuck braking', 'command', lambda _t, _x, y, flag: (-0.7, y, flag)),
    value_fault('stuck released', 'command', lambda _t, _x, y, flag: (0.0, y, flag)),
    second_command(),
    missing('command'),
    late('command', 1.0),
    clock_step(10.0),
    clock_step(-10.0),
    clock_step(-3000.0),
)
