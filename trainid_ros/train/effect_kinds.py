# SPDX-License-Identifier: Apache-2.0
"""Definition of an effect: equation, parameters, the data that identify it and the effects it is confused with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from trainid_ros.interface.errors import InputError
from trainid_ros.train.forces import TrackPoint
from trainid_ros.train.train_file import Davis

Parameters = Mapping[str, float]
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
        return self.search is None and self.unit == 'm'


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
    typical_size: float  # Typical distance of the amplitude from neutral: scale of its prior in the search, in its unit
    resistance: Resistance | None = None  # Equivalent extra resistance [N/kN]; None if it cannot be expressed as one
    neutral: float = 0.0  # Value of ``amplitude`` at which there is no effect
    linear: bool = False  # True if the resistance is proportional to the distance of the amplitude from neutral
    origin: Literal['physics', 'sensor'] = 'physics'  # 'sensor' if only the data of the train are wrong
    # True if the effect acts on the records: the simulator corrupts them, the live estimators correct them, and neither
    # adds ``resistance``, which is for fits to data that cannot be corrected one by one
    on_records: bool = False
    needs: str = ''  # What the data must contain to identify the effect
    twins: tuple[Twin, ...] = ()  # Similar effects that it can be confused with

    @property
    def shape(self) -> tuple[str, ...]:
        """Names of all parameters except the amplitude."""
        return tuple(name for name in self.parameters if name != self.amplitude)

    @property
    def sign(self) -> int:
        """Side of neutral on which the amplitude can lie: +1, -1, or 0 for both."""
        limits = self.parameters[self.amplitude]
        low, high = limits.search or (limits.low, limits.high)
        return int(low >= self.neutral) - int(high <= self.neutral)

    @property
    def repeatable(self) -> bool:
        """True if the effect has its own position or time, so that it may occur several times."""
        return any(self.parameters[name].search is None for name in self.shape)

    def __post_init__(self) -> None:
        """Raise InputError for an amplitude or neutral value that cannot be, or a shape parameter without a range."""
        limits = self.parameters.get(self.amplitude)
        if limits is None:
            raise InputError(
                f'effect {self.name}: amplitude = {self.amplitude!r} is not one of its parameters {[*self.parameters]}'
            )
        if not limits.low <= self.neutral <= limits.high:
            raise InputError(f'effect {self.name}: neutral = {self.neutral:g} is outside the range of {self.amplitude}')
        for name in self.shape:
            parameter = self.parameters[name]
            if parameter.search is None and parameter.unit not in {'m', 's'}:
                raise InputError(
                    f'effect {self.name}: parameter {name} needs search=(low, high), its range of values; only '
                    f'positions [m] and times [s] need none, its unit is {parameter.unit!r}'
                )
            if parameter.search is not None and parameter.grid == 'log' and not parameter.search[0] > 0.0:
                raise InputError(f'effect {self.name}: parameter {name}: search of a log grid must begin above 0')
