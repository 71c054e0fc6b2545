# SPDX-License-Identifier: Apache-2.0
"""Definition of an effect: equation, parameters, the data that identify it and the effects it is confused with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from trainid_ros.errors import InputError
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.train_file import Davis

Parameters = Mapping[str, float]
PLACE_UNIT: Final = 'm'
TIME_UNIT: Final = 's'
Resistance = Callable[[Parameters, Davis, TrackPoint], float]
"""Equivalent extra resistance [N/kN] at one time: the term added to w(v) + i that makes the balance hold."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        unit: Unit, empty for a ratio.
        low: Lowest accepted value.
        high: Highest accepted value.
        search: Search range of an unknown value. For a shape parameter, the range of candidate values; for the
            amplitude, the side of neutral on which it can lie. None where the data give the candidates (positions
            in m, times in s since the start) or the amplitude can have either sign.
        grid: Spacing of the candidate values over ``search``.

    """

    unit: str
    low: float = -math.inf
    high: float = math.inf
    search: tuple[float, float] | None = None
    grid: Literal['linear', 'log'] = 'linear'

    @property
    def is_place(self) -> bool:
        """True for a position on the line, searched wherever the train has run."""
        return self.search is None and self.unit == PLACE_UNIT


@dataclass(frozen=True, slots=True)
class Twin:
    """Name of a similar effect, and the test run that distinguishes the two."""

    name: str
    drive: str


@dataclass(frozen=True, slots=True)
class EffectKind:
    """Definition of an effect.

    Attributes:
        name: Name in train files and on the command line.
        title: Short description.
        equation: Equation in one line.
        parameters: Parameters by name.
        amplitude: Name of the parameter in which the effect is (nearly) linear.
        typical_size: Typical distance of the amplitude from neutral: the scale of its prior in the search, in its unit.
        resistance: Equivalent extra resistance [N/kN]; None if the effect cannot be expressed as one.
        neutral: Value of ``amplitude`` at which there is no effect.
        linear: True if the resistance is proportional to the distance of the amplitude from neutral.
        origin: 'physics' if the motion of the train differs, 'sensor' if only its data are wrong.
        on_records: True if the effect acts on the records: the simulator corrupts them, the live estimators correct
            them, and neither adds ``resistance``, which is for fits to data that cannot be corrected one by one.
        needs: What the data must contain to identify the effect.
        twins: Similar effects that it can be confused with.

    """

    name: str
    title: str
    equation: str
    parameters: Mapping[str, Parameter]
    amplitude: str
    typical_size: float
    resistance: Resistance | None = None
    neutral: float = 0.0
    linear: bool = False
    origin: Literal['physics', 'sensor'] = 'physics'
    on_records: bool = False
    needs: str = ''
    twins: tuple[Twin, ...] = ()

    @property
    def repeatable(self) -> bool:
        """True if the effect has its own position or time, so that it may occur several times."""
        return any(p.search is None for name, p in self.parameters.items() if name != self.amplitude)

    def __post_init__(self) -> None:
        """Check the fields for consistency.

        Raises:
            InputError: The amplitude is not a parameter, the neutral value is outside its range, or a shape parameter
                has no search range.

        """
        limits = self.parameters.get(self.amplitude)
        if limits is None:
            msg = (
                f'effect {self.name}: amplitude = {self.amplitude!r} is not one of its parameters {[*self.parameters]}'
            )
            raise InputError(msg)
        if not limits.low <= self.neutral <= limits.high:
            msg = f'effect {self.name}: neutral = {self.neutral:g} is outside the range of {self.amplitude}'
            raise InputError(msg)
        for name, parameter in self.parameters.items():
            given = parameter.search is not None or parameter.unit in {PLACE_UNIT, TIME_UNIT}
            if name != self.amplitude and not given:
                msg = (
                    f'effect {self.name}: parameter {name} needs search=(low, high), its range of values; only '
                    f'positions [m] and times [s] need none, its unit is {parameter.unit!r}'
                )
                raise InputError(msg)
