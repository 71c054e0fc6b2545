# SPDX-License-Identifier: Apache-2.0
"""The faults of the matrix: single ones, and pairs of them."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Final

from benchmarks.faults.injection import (
    Fault,
    all_missing,
    at_one_hertz,
    clock_apart,
    clock_step,
    dropped,
    duplicated,
    frozen,
    frozen_position,
    late,
    missing,
    missing_for_ever,
    no_fault,
    scaled,
    second_command,
    spiked,
    swapped,
    ten_times_faster,
    value_fault,
)

if TYPE_CHECKING:
    from collections.abc import Callable

_KMH: Final = 3.6
_MPH: Final = 2.236936
_LBF: Final = 0.2248089
_G: Final = 9.81


def _slipping(t: float, x: float, y: float, flag: bool) -> tuple[float, float, bool]:
    return x * (1.0 + 0.15 * max(0.0, math.sin(0.8 * t))), y, flag


def _sliding(t: float, x: float, y: float, flag: bool) -> tuple[float, float, bool]:
    return x * (1.0 - 0.3 * max(0.0, math.sin(0.8 * t))), y, flag


def _position(name: str, change: Callable[[float, float], float]) -> Fault:
    """Return a fault that changes the position by the time since its start [s]."""
    return value_fault(f'position {name}', 'speed', lambda t, x, y, flag: (x, change(t, y), flag))


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
    scaled('offset .5 m/s', 'speed', 1.0, 0.5),
    _drifting('drift', 'speed', 0.02),
    value_fault('slip', 'speed', _slipping),
    value_fault('slide', 'speed', _sliding),
    _constant('not a number', 'speed', math.nan),
    _constant('infinite', 'speed', math.inf),
    _position('double', lambda _t, y: 2.0 * y),
    _position('in km', lambda _t, y: 1e-3 * y),
    _position('5 % high', lambda _t, y: 1.05 * y),
    frozen_position(),
    _position('jumps', lambda t, y: y + 300.0 * (1.0 + t // 20.0)),
    spiked('speed', 5.0),
    frozen('speed'),
    missing('speed'),
    missing('speed', 'missing 1 s', 1.0),
    missing_for_ever('speed'),
    late('speed', 0.5),
    late('speed', 1.0),
    late('speed', 3.0),
    *(clock_apart('speed', seconds) for seconds in (0.5, 1.0, 3.0, -0.5, -1.0, -3.0)),
    duplicated('speed'),
    swapped('speed'),
    ten_times_faster('speed'),
    at_one_hertz('speed'),
)
_FORCE: Final = (
    scaled('in kN', 'force', 1e-3),
    scaled('in lbf', 'force', _LBF),
    scaled('sign', 'force', -1.0),
    scaled('20 % high', 'force', 1.2),
    _drifting('drift', 'force', 100.0),
    _constant('not a number', 'force', math.nan),
    _constant('infinite', 'force', math.inf),
    spiked('force', 1e5),
    frozen('force'),
    missing('force'),
    missing('force', 'missing 1 s', 1.0),
    missing_for_ever('force'),
    late('force', 0.5),
    late('force', 1.0),
    late('force', 3.0),
    *(clock_apart('force', seconds) for seconds in (0.5, 1.0, 3.0, -0.5, -1.0, -3.0)),
    duplicated('force'),
    swapped('force'),
    ten_times_faster('force'),
    at_one_hertz('force'),
)
_GRADIENT: Final = (
    scaled('1 per mille high', 'gradient', 1.0, 1.0),
    scaled('2 per mille high', 'gradient', 1.0, 2.0),
    scaled('sign', 'gradient', -1.0),
    scaled('in per cent', 'gradient', 0.1),
    _drifting('drift', 'gradient', 0.05),
    _constant('not a number', 'gradient', math.nan),
    spiked('gradient', 30.0),
    frozen('gradient'),
    missing('gradient'),
    missing('gradient', 'missing 1 s', 1.0),
    missing_for_ever('gradient'),
    late('gradient', 1.0),
    clock_apart('gradient', -1.0),
    duplicated('gradient'),
    swapped('gradient'),
    ten_times_faster('gradient'),
    at_one_hertz('gradient'),
)
_COMMAND: Final = (
    scaled('half', 'command', 0.5),
    scaled('double', 'command', 2.0),
    scaled('in g', 'command', 1.0 / _G),
    scaled('sign', 'command', -1.0),
    _constant('not a number', 'command', math.nan),
    _constant('stuck braking', 'command', -0.7),
    _constant('stuck released', 'command', 0.0),
    spiked('command', -0.8),
    dropped('command'),
    frozen('command'),
    second_command(),
    missing('command'),
    missing('command', 'missing 1 s', 1.0),
    missing_for_ever('command'),
    late('command', 1.0),
    clock_apart('command', -1.0),
    duplicated('command'),
    swapped('command'),
    ten_times_faster('command'),
    at_one_hertz('command'),
)
_MASS: Final = (
    scaled('in t', 'mass', 1e-3),
    scaled('20 % high', 'mass', 1.2),
    _constant('not a number', 'mass', math.nan),
    missing('mass'),
)
_ALL: Final = (all_missing(10.0), clock_step(10.0), clock_step(-10.0), clock_step(-3000.0))

FAULTS: Final = (*_SPEED, *_FORCE, *_GRADIENT, *_COMMAND, *_MASS, *_ALL)
NOTHING: Final = no_fault()
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
