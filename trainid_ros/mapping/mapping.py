# SPDX-License-Identifier: Apache-2.0
"""What a mapping says: from which fields of messages, or columns of a table, each input is made."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import BRAKE_TOPIC, FORCE_TOPIC, GRADIENT_TOPIC, MASS_TOPIC, SPEED_TOPIC
from trainid_ros.mapping.message_fields import names_of, type_of
from trainid_ros.mapping.units import Unit

if TYPE_CHECKING:
    from trainid_ros.mapping.user_function import UserFunction
    from trainid_ros.stream.alignment import AlignmentConfig


UNKNOWN_EFFORT: Final = -math.inf
"""Brake command where a brake acts, or may act, and nothing says how much."""


class StampSource(Enum):
    """Where the stamp of a value comes from."""

    HEADER = 'header'
    RECEIVE = 'receive'


@dataclass(frozen=True, slots=True)
class Source:
    """One number in the messages of one topic, or in one column of a table."""

    topic: str  # Name of the topic; a relative one lies in the namespace of the train. '' for a column.
    path: tuple[str | int, ...]  # Names of fields and indices of arrays that lead to the number; for a column its name
    unit: Unit  # Its unit
    sign: float = 1.0  # 1, or -1 where it counts the other way
    gain: float = 1.0  # Factor on it [1]
    offset: float = 0.0  # Added after sign and gain, in its unit
    # Value in its unit by raw number, such as that of a notch; empty without
    table: tuple[tuple[float, float], ...] = ()
    stamp: StampSource = StampSource.HEADER  # Where its stamp comes from

    @property
    def field(self) -> str:
        """The path as in the file, such as ``twist.linear.x`` or ``data.0``."""
        return '.'.join(map(str, self.path))

    def read(self, message: Any) -> float:
        """Return the value in a message, as :meth:`value`.

        Raises:
            InputError: The message has no such number; the error names topic and field.
        """
        return self.value(self.raw(message))

    def value(self, raw: float) -> float:
        """Return a number in the unit of the interface; NaN for one that is not in the table."""
        if self.table:
            raw = dict(self.table).get(raw, math.nan)
        if raw == UNKNOWN_EFFORT:
            return raw
        return self.unit.convert(self.sign * self.gain * raw + self.offset)

    def raw(self, message: Any) -> float:
        """Return the number in a message as it is; raises as :meth:`read`."""
        value, reached = message, ''
        try:
            for step in self.path:
                value = value[step] if isinstance(step, int) else getattr(value, step)
                reached = f'{reached}.{step}'.lstrip('.')
            return float(value)
        except (AttributeError, IndexError, TypeError, ValueError):
            names = ', '.join(names_of(value))
            hint = f' (fields{" of " if reached else ""}{reached}: {names})' if names else ''
            raise InputError(
                f'topic {self.topic}: field {self.field} is not a number of {type_of(message)}{hint}'
            ) from None


@dataclass(frozen=True, slots=True)
class Signal:
    """A quantity as the sum of one or more sources, or as a function of them."""

    sources: tuple[Source, ...]
    function: UserFunction | None = None


@dataclass(frozen=True, slots=True)
class SpeedIntegral:
    """The position as the integral of the speed, from ``start`` [m], rising (+1) or falling (-1)."""

    start: float = 0.0
    direction: int = 1


@dataclass(frozen=True, slots=True)
class LineLookup:
    """Gradient, curve radius and tunnel of the line of the train file, by position."""


@dataclass(frozen=True, slots=True)
class Constant:
    """A value that does not change, in the unit of the interface."""

    value: float


@dataclass(frozen=True, slots=True)
class TimeColumn:
    """The times of the rows of a table."""

    columns: tuple[str, ...]  # Names of the columns they are made of: one, without a function
    unit: Unit  # Unit of times that are numbers
    start_ns: int | None = None  # What such times count from [ns], None if the file does not say so
    function: UserFunction | None = None  # Function of the columns, None without


@dataclass(frozen=True, slots=True)
class CsvFormat:
    """How a CSV file is written; None where it is to be found out."""

    separator: str | None = None  # Character between cells
    decimal: str | None = None  # Decimal sign
    header_rows: int | None = None  # Number of rows with names, units and the like
    encoding: str | None = None  # Name of the encoding


# How long a brake command published only on change holds, unless a parameter says otherwise [s].
_HOLD_S: Final = 3600.0
_QUANTITY_OF: Final = {
    SPEED_TOPIC.name: 'speed',
    FORCE_TOPIC.name: 'force',
    GRADIENT_TOPIC.name: 'gradient',
    BRAKE_TOPIC.name: 'brake_command',
    MASS_TOPIC.name: 'mass',
}
Position: TypeAlias = Signal | SpeedIntegral
Gradient: TypeAlias = Signal | LineLookup | Constant


@dataclass(frozen=True, slots=True)
class Mapping:
    """Where each input comes from; None: from its own topic of trainid_msgs, and in a table not at all."""

    speed: Signal | None = None  # Speed [m/s]; its sign is ignored
    position: Position | None = None  # Position [m]
    force: Signal | None = None  # Force [N]
    gradient: Gradient | None = None  # Gradient [per mille]
    brake_command: Signal | Constant | None = None  # Target acceleration [m/s^2]
    mass: Signal | None = None  # Mass [kg]
    on_change: bool = False  # Whether brake commands are published only when they change
    time: TimeColumn | None = None  # Times of the rows of a table, None for messages
    csv: CsvFormat = CsvFormat()  # How the table is written, if it is a CSV file

    def alignment(self, config: AlignmentConfig) -> AlignmentConfig:
        """Return settings of the alignment that fit the mapping."""
        if self.on_change and config.command_hold == 0.0:
            return replace(config, command_hold=_HOLD_S)
        return config

    @property
    def replaced(self) -> frozenset[str]:
        """Our own topics that are not read."""
        return frozenset(topic for topic, name in _QUANTITY_OF.items() if getattr(self, name) is not None)

    def needed(self, topic: str) -> tuple[str, ...]:
        """Return the topics that the input of one of our own topics needs."""
        signal = getattr(self, _QUANTITY_OF[topic])
        if signal is None:
            return (topic,)
        return tuple(source.topic for source in signal.sources) if isinstance(signal, Signal) else ()

    def named(self, text: str) -> str:
        """Return a text for people with the topics that are read in place of our own ones, which it may name."""
        for topic in self.replaced:
            read = ' + '.join(dict.fromkeys(self.needed(topic))) or f'the {_QUANTITY_OF[topic]} of the mapping'
            text = re.sub(rf'(?<![\w/]){topic}(?![\w/])', read, text)
        return text

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics that are read, each once."""
        return tuple(dict.fromkeys(source.topic for source in self.sources))

    @property
    def sources(self) -> tuple[Source, ...]:
        """All numbers that are read."""
        signals = (getattr(self, item.name) for item in fields(self))
        return tuple(source for signal in signals if isinstance(signal, Signal) for source in signal.sources)


OWN: Final = Mapping()
"""All inputs come from their own topics."""
