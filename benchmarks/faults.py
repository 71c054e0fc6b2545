# SPDX-License-Identifier: Apache-2.0
"""Faults of the inputs: each maps the rows of a drive to those that a faulty train would send; the matrix of faults."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Final

from trainid_ros.interface.records import BRAKE, FORCE, GRADIENT, MASS, NS_PER_S, SPEED, Row

_TOPIC_OF: Final[Mapping[str, int]] = {
    'speed': SPEED,
    'force': FORCE,
    'gradient': GRADIENT,
    'command': BRAKE,
    'mass': MASS,
}
_SMOOTH: Final = (SPEED, FORCE)
# Of so many messages one has a spike; a topic at 1 Hz keeps one of so many; one that comes faster has so many for one.
_SPIKE_EVERY, _KEPT_EVERY, _FASTER = 20, 5, 10
# Returns the rows sent instead of one, from its number (from 0 on) and time since the start of the fault [s], and the
# first row of the topic since then.
Send = Callable[[int, float, Row, Row], Sequence[Row]]


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one or more inputs."""

    name: str  # What happens
    # Returns the rows that are sent instead of those between two stamps [ns].
    change: Callable[[Sequence[Row], int, int], list[Row]]
    clock_step_s: float = 0.0  # Step of the clock that stamps all messages [s]
    shifts_stamps: bool = False  # True if only stamps are changed, but not the times at which messages are sent


def injected(rows: Sequence[Row], faults: Sequence[Fault], start_ns: int, end_ns: int) -> list[Row]:
    """Return rows with faults between two stamps [ns]."""
    sent = list(rows)
    for fault in faults:
        sent = fault.change(sent, start_ns, end_ns)
    return sent


def changed(
    name: str,
    topic: str,
    send: Send,
    *,
    lasts: bool = False,
    moves: bool = False,
    stamps: bool = False,
    step: float = 0.0,
) -> Fault:
    """Return a fault that replaces rows one by one.

    Args:
        name: Its name.
        topic: The topic, all if empty.
        send: Returns what is sent instead of a row.
        lasts: True if it lasts for ever.
        moves: True if messages are sent at other times: in the order of their new stamps.
        stamps: True if only stamps are changed.
        step: Step of the clock of all topics [s].

    """
    place = _TOPIC_OF.get(topic)

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        first: Row | None = None
        count, sent = 0, list[Row]()
        for row in rows:
            if place in (None, row[0]) and start_ns <= row[1] and (lasts or row[1] < end_ns):
                first = first or row
                sent += send(count, (row[1] - start_ns) / NS_PER_S, row, first)
                count += 1
            else:
                sent.append(row)
        return sorted(sent, key=lambda row: row[1]) if moves else sent

    return Fault(name, apply, step, stamps)


def value_fault(
    name: str, topic: str, change: Callable[[float, float, float, bool], tuple[float, float, bool]]
) -> Fault:
    """Return a fault that changes the values of a topic; ``change`` gets the time since its start [s] and them."""
    return changed(f'{topic} {name}', topic, lambda _k, t, row, _: [(*row[:2], *change(t, *row[2:]))])


def scaled(name: str, topic: str, factor: float, offset: float = 0.0) -> Fault:
    """Return a fault that scales the first value of a topic and adds an offset to it."""
    return value_fault(name, topic, lambda _t, x, y, flag: (factor * x + offset, y, flag))


def frozen(topic: str) -> Fault:
    """Return a fault that repeats the last value of a topic, with new stamps; positions go on."""
    return changed(
        f'{topic} frozen',
        topic,
        lambda _k, _t, row, first: [(*row[:2], first[2], row[3] if row[0] == SPEED else first[3], first[4])],
    )


def all_missing(seconds: float) -> Fault:
    """Return a fault that drops the messages of all topics for some time [s]."""
    return changed(f'all missing {seconds:g} s', '', lambda _k, t, row, _: [] if t < seconds else [row], lasts=True)


def _shifted(seconds: float) -> Send:
    return lambda _k, _t, row, _: [(row[0], row[1] + round(seconds * NS_PER_S), *row[2:])]


def clock_step(seconds: float) -> Fault:
    """Return a fault that steps the clock of all topics at the start of the fault, for ever."""
    return changed(f'clock {seconds:+g} s', '', _shifted(seconds), lasts=True, stamps=True, step=seconds)


def _single(name: str, topic: str, change: Callable[[float], float]) -> Fault:
    """Return a fault that changes the first value in one of every so many messages of a topic."""
    return changed(
        f'{topic} {name}',
        topic,
        lambda k, _t, row, _: [(*row[:2], change(row[2]) if (k + 1) % _SPIKE_EVERY == 0 else row[2], *row[3:])],
    )


def swapped(topic: str) -> Fault:
    """Return a fault that exchanges neighbouring messages of a topic."""
    place = _TOPIC_OF[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        sent = list(rows)
        own = [k for k, row in enumerate(sent) if row[0] == place and start_ns <= row[1] < end_ns]
        for k, following in zip(own[::2], own[1::2], strict=False):
            sent[k], sent[following] = sent[following], sent[k]
        return sent

    return Fault(f'{topic} out of order', apply)


def ten_times_faster(topic: str) -> Fault:
    """Return a fault where a topic comes ten times as often, with values between those of the drive."""
    place = _TOPIC_OF[topic]

    def apply(rows: Sequence[Row], start_ns: int, end_ns: int) -> list[Row]:
        own = [row for row in rows if row[0] == place and start_ns <= row[1] < end_ns]
        between = [_between(*pair, k / _FASTER) for pair in pairwise(own) for k in range(1, _FASTER)]
        return sorted((*rows, *between), key=lambda row: row[1])

    return Fault(f'{topic} ten times as often', apply)


def _between(row: Row, following: Row, share: float) -> Row:
    """Return a row at a share of the time to the following one; what is no smooth function of time is held."""
    topic, stamp, x, y, flag = row
    stamp += round(share * (following[1] - stamp))
    if topic not in _SMOOTH:
        return topic, stamp, x, y, flag
    return topic, stamp, x + share * (following[2] - x), y + share * (following[3] - y), flag


def of_messages(topic: str, late_s: Sequence[float] = (1.0,), apart_s: Sequence[float] = (-1.0,)) -> tuple[Fault, ...]:
    """Return faults of the messages of a topic, whatever they say.

    They are missing, for a second and for ever, stamped and sent later than the values were true by some times [s],
    sent when they were but stamped by a clock that is off, sent twice, out of order, ten times as often, and at 1 Hz
    instead of 5 Hz.
    """
    return (
        changed(f'{topic} missing', topic, lambda _k, _t, _row, _: []),
        changed(f'{topic} missing 1 s', topic, lambda _k, t, row, _: [] if t < 1.0 else [row]),
        changed(f'{topic} missing for ever', topic, lambda _k, _t, _row, _: [], lasts=True),
        *(changed(f'{topic} {off:+g} s', topic, _shifted(off), moves=True) for off in late_s),
        *(changed(f'{topic} clock {off:+g} s', topic, _shifted(off), stamps=True) for off in apart_s),
        changed(f'{topic} twice', topic, lambda _k, _t, row, _: [row, row]),
        swapped(topic),
        ten_times_faster(topic),
        changed(f'{topic} at 1 Hz', topic, lambda k, _t, row, _: [row] if (k + 1) % _KEPT_EVERY == 0 else []),
    )


SECOND_COMMAND: Final = changed(
    'command second publisher',
    'command',
    lambda _k, _t, row, _: [row, (BRAKE, row[1] + NS_PER_S // 10, -0.6 if row[2] == 0.0 else 0.0, 0.0, False)],
    moves=True,
)
"""A second publisher says the opposite of the brake command."""

_KMH: Final = 3.6
_MPH: Final = 2.236936
_LBF: Final = 0.2248089
_G: Final = 9.81
# Delays of messages, and errors of the clock that stamps them [s].
_LATE_S: Final = (0.5, 1.0, 3.0)
_APART_S: Final = (*_LATE_S, -0.5, -1.0, -3.0)


def _slipping(t: float, x: float, y: float, flag: bool) -> tuple[float, float, bool]:
    return x * (1.0 + 0.15 * max(0.0, math.sin(0.8 * t))), y, flag


def _sliding(t: float, x: float, y: float, flag: bool) -> tuple[float, float, bool]:
    return x * (1.0 - 0.3 * max(0.0, math.sin(0.8 * t))), y, flag


def _position(name: str, change: Callable[[float, float], float]) -> Fault:
    """Return a fault that changes the position by the time since its start [s]."""
    return value_fault(f'position {name}', 'speed', lambda t, x, y, flag: (x, change(t, y), flag))


def _odometer(name: str, factor: float) -> Fault:
    """Return a fault that scales speed and position alike."""
    return value_fault(name, 'speed', lambda _t, x, y, flag: (factor * x, factor * y, flag))


def _drifting(name: str, topic: str, per_second: float) -> Fault:
    """Return a fault whose offset grows with time, without limit."""
    return value_fault(name, topic, lambda t, x, y, flag: (x + per_second * t, y, flag))


def _constant(name: str, topic: str, value: float) -> Fault:
    return value_fault(name, topic, lambda _t, _x, y, flag: (value, y, flag))


_SPEED: Final = (
    scaled('in km/h', 'speed', _KMH),
    scaled('in mph', 'speed', _MPH),
    scaled('half', 'speed', 0.5),
    scaled('3 % high', 'speed', 1.03),
    scaled('5 % high', 'speed', 1.05),
    scaled('3 % low', 'speed', 0.97),
    scaled('offset .5 m/s', 'speed', 1.0, 0.5),
    _odometer('in km/h with its position', _KMH),
    _odometer('half with its position', 0.5),
    _drifting('drift', 'speed', 0.02),
    value_fault('slip', 'speed', _slipping),
    value_fault('slide', 'speed', _sliding),
    _constant('not a number', 'speed', math.nan),
    _constant('infinite', 'speed', math.inf),
    _position('double', lambda _t, y: 2.0 * y),
    _position('in km', lambda _t, y: 1e-3 * y),
    _position('5 % high', lambda _t, y: 1.05 * y),
    changed('speed position frozen', 'speed', lambda _k, _t, row, first: [(*row[:3], first[3], row[4])]),
    _position('jumps', lambda t, y: y + 300.0 * (1.0 + t // 20.0)),
    _single('spikes', 'speed', lambda x: x + 5.0),
    frozen('speed'),
    *of_messages('speed', _LATE_S, _APART_S),
)
_FORCE: Final = (
    scaled('in kN', 'force', 1e-3),
    scaled('in lbf', 'force', _LBF),
    scaled('sign', 'force', -1.0),
    value_fault('without sign', 'force', lambda _t, x, y, flag: (abs(x), y, flag)),
    scaled('5 % high', 'force', 1.05),
    scaled('20 % high', 'force', 1.2),
    scaled('half', 'force', 0.5),
    _drifting('drift', 'force', 100.0),
    _constant('not a number', 'force', math.nan),
    _constant('infinite', 'force', math.inf),
    _single('spikes', 'force', lambda x: x + 1e5),
    frozen('force'),
    *of_messages('force', _LATE_S, _APART_S),
)
_GRADIENT: Final = (
    scaled('1 per mille high', 'gradient', 1.0, 1.0),
    scaled('2 per mille high', 'gradient', 1.0, 2.0),
    scaled('sign', 'gradient', -1.0),
    scaled('zero', 'gradient', 0.0),
    scaled('in per cent', 'gradient', 0.1),
    _drifting('drift', 'gradient', 0.05),
    _constant('not a number', 'gradient', math.nan),
    _single('spikes', 'gradient', lambda x: x + 30.0),
    frozen('gradient'),
    *of_messages('gradient'),
)
_COMMAND: Final = (
    scaled('half', 'command', 0.5),
    scaled('double', 'command', 2.0),
    scaled('in g', 'command', 1.0 / _G),
    scaled('sign', 'command', -1.0),
    _constant('not a number', 'command', math.nan),
    _constant('stuck braking', 'command', -0.7),
    _constant('stuck released', 'command', 0.0),
    _single('spikes', 'command', lambda x: x - 0.8),
    _single('drops to zero', 'command', lambda _: 0.0),
    frozen('command'),
    SECOND_COMMAND,
    *of_messages('command'),
)
_MASS: Final = (
    scaled('in t', 'mass', 1e-3),
    scaled('20 % high', 'mass', 1.2),
    _constant('not a number', 'mass', math.nan),
    of_messages('mass')[0],
)
_ALL: Final = (all_missing(10.0), clock_step(10.0), clock_step(-10.0), clock_step(-3000.0))

FAULTS: Final = (*_SPEED, *_FORCE, *_GRADIENT, *_COMMAND, *_MASS, *_ALL)
NOTHING: Final = Fault('nothing', lambda rows, _start_ns, _end_ns: list(rows))
"""What a drive has by itself, beside the faults."""
BY_NAME: Final = {fault.name: fault for fault in (NOTHING, *FAULTS)}

# Of each kind one fault of each topic, in the order of TOPICS.
_TOPICS: Final = ('speed', 'force', 'gradient', 'command')
_UNIT: Final = dict(zip(_TOPICS, ('in km/h', 'in kN', 'in per cent', 'in g'), strict=True))
# The kinds that meet in each pair of topics: the first in the earlier topic, the second in the later one.
_KINDS: Final = (
    ('missing', '+1 s'),
    ('unit', 'sign'),
    ('not a number', '+1 s'),
    ('frozen', 'spikes'),
    ('+1 s', 'clock -1 s'),
    ('twice', 'missing 1 s'),
)


def _named(topic: str, kind: str) -> str:
    return f'{topic} {_UNIT[topic] if kind == "unit" else kind}'


PAIRS: Final = (
    *(
        (_named(first, kinds[0]), _named(second, kinds[1]))
        for first, second in combinations(_TOPICS, 2)
        for kinds in _KINDS
    ),
    *((_named(topic, kind), 'clock -10 s') for topic in _TOPICS for kind in ('missing', 'unit')),
)
"""Six pairs of kinds in each pair of topics, and two kinds in each topic together with a step of the clock."""
