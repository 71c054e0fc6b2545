# SPDX-License-Identifier: Apache-2.0
"""Definition of an effect: equation, parameters, the data that identify it and the effects it is confused with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from trainid_ros.interface.errors import InputError
from trainid_ros.train.forces import TrackPoint
from trainid_ros.train.train_file import Davis

Parameters = Mapping[str, float]
PLACE_UNIT: Final = 'm'
TIME_UNIT: Final = 's'
Resistance = Callable[[Parameters, Davis, TrackPoint], float]
"""Equivalent extra resistance [N/kN] at one time: the term added to w(v) + i that makes the balance hold."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect."""

    unit: str  # Unit, empty for a ratio
    low: float = -math.inf  # Lowest accepted value
    high: float = math.inf  # Highest accepted value
    # Search range of an unknown value. For a shape parameter, the range of candidate values; for the amplitude, the
    # side of neutral on which it can lie. None where the data give the candidates (positions in m, times in s since the
    # start) or the amplitude can have either sign.
    search: tuple[float, float] | None = None
    grid: Literal['linear', 'log'] = 'linear'  # Spacing of the candidate values over ``search``

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
    """Definition of an effect."""

    name: str  # Name in train files and on the command line
    title: str  # Short description
    equation: str  # Equation in one line
    parameters: Mapping[str, Parameter]  # Parameters by name
    amplitude: str  # Name of the parameter in which the effect is (nearly) linear
    # Typical distance of the amplitude from neutral: the scale of its prior in the search, in its unit
    typical_size: float
    # Equivalent extra resistance [N/kN]; None if the effect cannot be expressed as one
    resistance: Resistance | None = None
    neutral: float = 0.0  # Value of ``amplitude`` at which there is no effect
    linear: bool = False  # True if the resistance is proportional to the distance of the amplitude from neutral
    # 'physics' if the motion of the train differs, 'sensor' if only its data are wrong
    origin: Literal['physics', 'sensor'] = 'physics'
    # True if the effect acts on the records: the simulator corrupts them, the live estimators correct them, and neither
    # adds ``resistance``, which is for fits to data that cannot be corrected one by one
    on_records: bool = False
    needs: str = ''  # What the data must contain to identify the effect
    twins: tuple[Twin, ...] = ()  # Similar effects that it can be confused with

    @property
    def repeatable(self) -> bool:
        """True if the effect has its own position or time, so that it may occur several times."""
        return any(p.search is None for name, p in self.parameters.items() if name != self.amplitude)

    def __post_init__(self) -> None:
        """Raise InputError for an amplitude or neutral value that cannot be, or a shape parameter without a range."""
        limits = self.parameters.get(self.amplitude)
        if limits is None:
            raise InputError(
                f'effect {self.name}: amplitude = {self.amplitude!r} is not one of its parameters {[*self.parameters]}'
            )
        if not limits.low <= self.neutral <= limits.high:
            raise InputError(f'effect {self.name}: neutral = {self.neutral:g} is outside the range of {self.amplitude}')
        for name, parameter in self.parameters.items():
            given = parameter.search is not None or parameter.unit in {PLACE_UNIT, TIME_UNIT}
            if name != self.amplitude and not given:
                raise InputError(
                    f'effect {self.name}: parameter {name} needs search=(low, high), its range of values; only '
                    f'positions [m] and times [s] need none, its unit is {parameter.unit!r}'
                )
