# SPDX-License-Identifier: Apache-2.0
"""What an effect is: its equation, its parameters, what shows it and what it can be mistaken for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from trainid_ros.core.errors import InputError
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis

Parameters = Mapping[str, float]
PLACE_UNIT: Final = 'm'
TIME_UNIT: Final = 's'
Resistance = Callable[[Parameters, Davis, TrackPoint], float]
"""Equivalent extra resistance [N/kN] at one moment: what must be added to w(v) + i for the balance to hold."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        unit: Its unit, empty for a ratio.
        low: Lowest value that is accepted.
        high: Highest value that is accepted.
        search: Range to look in for a value that is not known: of a shape, the values to try; of the amplitude, the
            side of neutral on which it can lie. None where the data give it (positions in m, times in s since the
            start) or it has either sign.
        grid: How values to try are spaced over ``search``.

    """

    unit: str
    low: float = -math.inf
    high: float = math.inf
    search: tuple[float, float] | None = None
    grid: Literal['linear', 'log'] = 'linear'

    @property
    def is_place(self) -> bool:
        """True for a position on the line, looked for wherever was driven."""
        return self.search is None and self.unit == PLACE_UNIT


@dataclass(frozen=True, slots=True)
class Twin:
    """An effect that looks alike, and the drive that would tell the two apart."""

    name: str
    drive: str


@dataclass(frozen=True, slots=True)
class EffectKind:
    """What is known of an effect.

    Attributes:
        name: Name in train files and on the command line.
        title: What it is, in words.
        equation: Its equation in one line.
        parameters: Its parameters by name.
        amplitude: Name of the parameter that the effect is (nearly) linear in.
        usual: How far from neutral the amplitude usually is: the scale of its prior when it is looked for.
        resistance: Equivalent extra resistance; None if it cannot be expressed as one.
        neutral: Value of ``amplitude`` at which there is no effect.
        origin: Whether the train runs otherwise, or only its data are wrong.
        on_records: True if records show the effect themselves: the simulator spoils them, the live estimators
            mend them, and neither adds ``resistance``, which is for fits to data that cannot be mended one by one.
        needs: What the data must hold to show it.
        twins: What it can be mistaken for.

    """

    name: str
    title: str
    equation: str
    parameters: Mapping[str, Parameter]
    amplitude: str
    usual: float
    resistance: Resistance | None = None
    neutral: float = 0.0
    origin: Literal['physics', 'sensor'] = 'physics'
    on_records: bool = False
    needs: str = ''
    twins: tuple[Twin, ...] = ()

    @property
    def repeatable(self) -> bool:
        """True if it has a place or a time of its own, so that there may be several."""
        return any(p.search is None for name, p in self.parameters.items() if name != self.amplitude)

    def __post_init__(self) -> None:
        """Check what a user can get wrong.

        Raises:
            InputError: The amplitude is no parameter, the neutral value lies outside its range, or nothing tells which
                values of a shape parameter to try.

        """
        limits = self.parameters.get(self.amplitude)
        if limits is None:
            msg = f'effect {self.name}: amplitude = {self.amplitude!r} is none of its parameters {[*self.parameters]}'
            raise InputError(msg)
        if not limits.low <= self.neutral <= limits.high:
            msg = f'effect {self.name}: neutral = {self.neutral:g} is outside the range of {self.amplitude}'
            raise InputError(msg)
        for name, parameter in self.parameters.items():
            given = parameter.search is not None or parameter.unit in {PLACE_UNIT, TIME_UNIT}
            if name != self.amplitude and not given:
                msg = (
                    f'effect {self.name}: parameter {name} needs search=(low, high), the values to try; only positions '
                    f'[m] and times [s] are known from the drive, its unit is {parameter.unit!r}'
                )
                raise InputError(msg)
