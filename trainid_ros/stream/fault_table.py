# SPDX-License-Identifier: Apache-2.0
"""Table of the ways in which the inputs can be wrong, and of what healthy trains differ in.

A row is a hypothesis: how to correct the inputs if it is true, which quantities then differ from what is usual, and
which inputs it condemns. Those decide which estimators must wait. :mod:`input_check` scores all rows alike; a new kind
of fault is a new row here and a case in its test.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

from trainid_ros.interface.records import KM_H
from trainid_ros.train.forces import G


class Input(Enum):
    """An input as it is called in sentences."""

    SPEED = 'ato/speed'
    POSITION = 'the position in ato/speed'
    FORCE = 'ato/force'
    COMMAND = 'ato/brake_command'
    MASS = 'ato/mass'
    GRADIENT = 'ato/gradient'
    BRAKING = 'ato/force in braking'
    BRAKE = 'brake.delay of the train file'
    LINE = 'line.gradient of the train file'

    @property
    def topic(self) -> str:
        """Its topic; empty for what the train file states."""
        return next((word for word in self.value.split() if word.startswith('ato/')), '')


NOTHING: Final[frozenset[Input]] = frozenset()
RESISTANCE_USES: Final = frozenset({Input.SPEED, Input.FORCE, Input.MASS, Input.GRADIENT})
"""Inputs of resistance and speed model: while one of them is condemned, neither learns."""
BRAKE_RATE_USES: Final = frozenset({*RESISTANCE_USES, Input.COMMAND, Input.BRAKING, Input.BRAKE})
"""Inputs of the brake rate. No estimator depends on the position."""


@dataclass(frozen=True, slots=True)
class Usual:
    """A quantity in which healthy trains differ."""

    name: str
    mean: float  # What is usual, in the unit of the quantity
    std: float  # Standard deviation over trains and time
    time_s: float  # Time in which it varies [s]


# Places of the quantities in a filter, after the speed.
V: Final = 0
OFFSET: Final = 1
WIND: Final = 2
GAIN: Final = 3
BRAKE: Final = 4
FORCE_LATE: Final = 5
BRAKE_LATE: Final = 6

USUAL: Final = (
    Usual('the resistance', 0.0, 2.0, 60.0),  # Offset of a + b v + c v^2 [N/kN]: rain, curves, errors of the map, gusts
    Usual('the wind', 0.0, 6.0, 60.0),  # Head wind [m/s]
    Usual('the traction by ato/force and ato/mass', 1.0, 0.07, 1e4),  # Traction over force [1]: mass, force 5 % off
    Usual(
        'the brake rate', 1.0, 0.2, 120.0
    ),  # Brake rate over that of the file [1]: wet rail, isolated bogie, blending
    Usual('the delay of ato/force', 0.1, 0.12, 3000.0),  # Delay of the reported force [s]: bus cycles, filters
    Usual('the delay of the brake', 0.0, 0.25, 300.0),  # How much later it acts, as a share of dead time and lag [1]
)
"""What is usual, in the order of the places from ``OFFSET`` on."""
WHEEL: Final = Usual('ato/speed over its position', 0.0, 0.01, 3000.0)
"""Measured over true speed, minus one [1]: wear of a wheel between two turnings."""
LAG: Final = Usual('the lag of ato/speed', 0.0, 0.25, 3000.0)
"""Time by which a speed is behind the position beside it [s]: filters of tachometers, and of odometers."""
SLOPE: Final = Usual('ato/gradient over line.gradient', 0.0, 0.25, 3000.0)
"""Gradient of the topic less that of the line [per mille], mean over kilometres: heights of two maps, 1 m in 4 km."""


@dataclass(frozen=True, slots=True)
class Row:
    """A hypothesis: corrections of the inputs, and what is then unusual."""

    sentence: str  # What is wrong; in braces the size as estimated
    condemns: frozenset[Input]  # What it says must not be used
    force: float = 1.0  # Factors that correct force, command, gradient, speed and position [1]
    command: float = 1.0
    gradient: float = 1.0
    speed: float = 1.0
    position: float = 1.0
    signless: bool = False  # True if the force of a brake is reported as positive
    late: Input | None = None  # The input that comes too late
    late_s: float = 0.0  # By so much [s]
    early: bool = False  # True if it comes too early instead
    ignores: frozenset[Input] = NOTHING  # Inputs that follow nothing
    unusual: tuple[tuple[int, float, float], ...] = ()  # Places, means and standard deviations instead of the usual
    wheel_std: float = WHEEL.std  # Standard deviation of the wheel instead of the usual [1]
    asks: float = 0.0  # Evidence asked for beforehand, for a row that explains much [nats]
    misread: bool = False  # True for a unit, a sign or a stuck speed: no train and no train file looks like it

    @property
    def holds_resistance(self) -> bool:
        """True if resistance and speed model must wait."""
        return not self.condemns.isdisjoint(RESISTANCE_USES)

    @property
    def holds_brake_rate(self) -> bool:
        """True if the brake rate must wait."""
        return not self.condemns.isdisjoint(BRAKE_RATE_USES)

    @property
    def is_of_times(self) -> bool:
        """True if it is about times: while the brake acts, it is scored by its applications, not by blocks."""
        return self.late is not None

    @property
    def is_of_odometer(self) -> bool:
        """True if speed and position have the same wrong scale, as of one odometer."""
        return self.speed == self.position != 1.0

    @property
    def is_of_wheel(self) -> bool:
        """True if it says something about speed over position."""
        return self.speed != self.position or self.wheel_std != WHEEL.std


_FOLLOWS_NOTHING: Final = 20.0  # nats: explains any input
_SLIDES: Final = 60.0  # nats: 2 for each block of some 20 s in which sliding wheels follow nothing
_RARE: Final = 3.0  # nats: also explains what is more frequent, as tunnels that no file states, or a speed that is late
# Delays that are told apart [s]: up to five blocks, which are 0.6 s long at 5 Hz; longer ones show like the longest.
_LATE_S: Final = (0.6, 1.2, 1.8, 3.0)
_MPH: Final = 2.236936
_LBF: Final = 4.448222  # [N]


def _late(
    what: Input, sentence: str, delays: tuple[float, ...], *, early: bool = False, remedy: str = ''
) -> tuple[Row, ...]:
    asks = _RARE if early else 0.0
    return tuple(Row(f'{sentence} by about {s:.1f} s{remedy}', _only(what), late=what, late_s=s, early=early, asks=asks)
                 for s in delays)  # fmt: skip


def _only(*inputs: Input) -> frozenset[Input]:
    return frozenset(inputs)


def _nothing(sentence: str, *inputs: Input, asks: float = _FOLLOWS_NOTHING) -> Row:
    return Row(sentence, _only(*inputs), ignores=_only(*inputs), asks=asks, misread=Input.SPEED in inputs)


_WEIGHT: Final = 'ato/force, ato/mass or train.mass is off: the train follows {gain:.2g} times the force'
_RATE: Final = 'ato/brake_command or brake.rate of the train file is off: the train brakes {brake:.2g} times as much'

TABLE: Final[tuple[Row, ...]] = (
    Row('', NOTHING),
    Row(
        'the position in ato/speed is twice what it should be',
        _only(Input.POSITION),
        position=0.5,
        asks=_FOLLOWS_NOTHING,  # explains any noise of the position
        misread=True,
    ),
    Row('ato/speed is in km/h or ft/s', _only(Input.SPEED), speed=1.0 / KM_H, misread=True),
    Row(
        'ato/speed is in km/h and its position in km',
        _only(Input.SPEED, Input.POSITION),
        speed=1.0 / KM_H,
        position=1e3,
        ignores=_only(Input.LINE),
        misread=True,
    ),
    Row('ato/speed is in mph', _only(Input.SPEED), speed=1.0 / _MPH, misread=True),
    Row('ato/speed is half of what it should be', _only(Input.SPEED), speed=2.0, misread=True),
    *(
        Row(
            f'ato/speed is {size}, and its position with it',
            _only(Input.SPEED, Input.POSITION),
            speed=factor,
            position=factor,
            ignores=_only(Input.LINE),
            asks=_FOLLOWS_NOTHING,  # explains a force that is stuck at a small value
            misread=True,
        )
        for size, factor in (
            ('in km/h or ft/s', 1.0 / KM_H),
            ('in mph or twice what it should be', 1.0 / _MPH),
            ('half of what it should be', 2.0),
        )
    ),
    Row('ato/speed is about {wheel:+.0%} off what its position gives', _only(Input.SPEED), wheel_std=0.08),
    _nothing('ato/speed is stuck or follows nothing', Input.SPEED, asks=_SLIDES),
    _nothing('ato/speed and its position are stuck', Input.SPEED, Input.POSITION),
    _nothing('the position in ato/speed follows nothing', Input.POSITION),
    _nothing('ato/force in braking is not that of a nominal brake under ato/brake_command', Input.BRAKING, asks=_RARE),
    # Before those of the force, which hold back more: while the train brakes both look alike.
    *(Row(_RATE, _only(Input.COMMAND), command=factor) for factor in (0.3, 0.5, 0.7, 1.4, 2.0, 4.0)),
    Row(_WEIGHT, _only(Input.FORCE, Input.MASS), unusual=((GAIN, 0.5, 0.15),)),
    Row(_WEIGHT, _only(Input.FORCE, Input.MASS), unusual=((GAIN, 1.6, 0.3),)),
    Row('ato/force is in kN', _only(Input.FORCE), force=1e3, misread=True),
    Row('ato/force is in lbf', _only(Input.FORCE), force=_LBF, misread=True),
    Row('ato/force is in kgf or daN', _only(Input.FORCE), force=G, misread=True),
    # Before the wrong sign, which looks like it while the train brakes.
    Row('ato/force has no sign: that of a brake is positive', _only(Input.FORCE), signless=True, misread=True),
    Row('ato/force has the wrong sign', _only(Input.FORCE), force=-1.0, misread=True),
    Row(_WEIGHT, _only(Input.FORCE, Input.MASS), force=2.0, unusual=((GAIN, 1.0, 0.2),)),
    Row(_WEIGHT, _only(Input.FORCE, Input.MASS), force=1.35, unusual=((GAIN, 1.0, 0.1),)),
    Row(_WEIGHT, _only(Input.FORCE, Input.MASS), force=0.5, unusual=((GAIN, 1.0, 0.2),)),
    Row(_WEIGHT, _only(Input.FORCE, Input.MASS), force=0.75, unusual=((GAIN, 1.0, 0.1),)),
    Row(
        'the resistance is {offset:+.0f} N/kN off that of the train file: '
        'is ato/force or ato/gradient off, or a tunnel missing?',
        _only(Input.FORCE, Input.GRADIENT),
        unusual=((OFFSET, 0.0, 12.0),),
        asks=_RARE,
    ),
    _nothing('ato/force is stuck or follows nothing', Input.FORCE),
    *_late(Input.FORCE, 'ato/force is late', _LATE_S),
    *_late(Input.SPEED, 'ato/speed is late', _LATE_S),
    *_late(Input.FORCE, 'ato/force is early', _LATE_S[:3], early=True),
    Row('ato/brake_command is in g', _only(Input.COMMAND), command=G, misread=True),
    _nothing('ato/brake_command is stuck or follows nothing', Input.COMMAND),
    *_late(Input.COMMAND, 'ato/brake_command is late', _LATE_S[1:]),
    *_late(Input.BRAKE, 'the brake acts later than brake.delay says,', _LATE_S[2:], remedy=': see trainid fit --brake'),
    Row('ato/gradient has the wrong sign', _only(Input.GRADIENT), gradient=-1.0, misread=True),
    Row('ato/gradient is in per cent', _only(Input.GRADIENT), gradient=10.0, misread=True),
    _nothing('ato/gradient does not fit line.gradient of the train file', Input.GRADIENT, asks=0.0),
    Row(
        'the train climbs as ato/gradient says: the position in ato/speed or line.gradient of the train file is off',
        _only(Input.POSITION),
        ignores=_only(Input.LINE),
        asks=_FOLLOWS_NOTHING,
    ),
)
"""All hypotheses; the first one is that all is well."""
