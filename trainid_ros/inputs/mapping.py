# SPDX-License-Identifier: Apache-2.0
"""Mappings: from which fields of messages, or columns of a table, each input is made; read from YAML."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from datetime import tzinfo
from functools import cache
from pathlib import Path
from traceback import extract_tb
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from trainid_ros.inputs.times import CLOCK, EXCEL, date_time, find_zone
from trainid_ros.inputs.units import Unit, find_unit
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import BRAKE_TOPIC, FORCE_TOPIC, GRADIENT_TOPIC, MASS_TOPIC, SPEED_TOPIC
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.train.fields import Section, as_section, finite_number, parse_yaml, read_text, shown


def type_of(message: Any) -> str:
    """Return the type of a message as a bag names it, such as ``std_msgs/msg/Float64``."""
    kind = type(message)
    if name := getattr(message, '__msgtype__', ''):  # of rosbags
        return str(name)
    package, _, rest = kind.__module__.partition('.')
    return f'{package}/msg/{kind.__name__}' if rest.startswith('msg.') else kind.__name__


def _field_names(value: Any) -> tuple[str, ...]:
    """Return the names of the fields of a message or of a part of it, none of a number."""
    if hasattr(value, 'get_fields_and_field_types'):  # of rclpy
        return tuple(value.get_fields_and_field_types())
    names = (item.name for item in fields(value)) if is_dataclass(value) else ()
    return tuple(name for name in names if not name.startswith('_'))


@dataclass(frozen=True, slots=True)
class UserFunction:
    """A function of arrays of numbers, all of shape (n,), that returns such an array."""

    path: Path  # The Python file
    name: str  # Name of the function in it
    unit: Unit  # Unit of its values

    def __str__(self) -> str:
        return f'{self.path}:{self.name}'

    def load(self) -> Callable[..., object]:
        """Return the function; its file is run the first time. InputError if that fails, or it has no such function."""
        function: Callable[..., object] | None = _names_of(self.path).get(self.name)
        if function is None or not callable(function):
            raise InputError(f'{self.path}: has no function {self.name}')
        return function

    def of_columns(self, columns: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the values of columns in the unit of the interface, all of shape (n,); InputError if that fails."""
        function = self.load()
        try:
            result = np.asarray(function(*columns), dtype=np.float64)
        except (Exception, SystemExit) as error:  # whatever its code raises
            raise InputError(f'{self} failed{_line(self.path, error)}: {type(error).__name__}: {error}') from error
        if result.shape != columns[0].shape:
            raise InputError(f'{self} returned shape {result.shape}, {columns[0].shape} expected: one number a row')
        return np.array([self.unit.convert(value) for value in result.tolist()], dtype=np.float64)

    def of_numbers(self, numbers: Sequence[float]) -> float:
        """Return the value of single numbers, as :meth:`of_columns`."""
        return float(self.of_columns([np.array([number]) for number in numbers])[0])


@cache
def _names_of(path: Path) -> dict[str, Any]:
    """Run a file and return its names; unlike an import this writes no bytecode and finds no files beside it."""
    names: dict[str, Any] = {'__name__': path.stem, '__file__': str(path)}
    try:
        exec(compile(path.read_bytes(), path, 'exec'), names)
    except (Exception, SystemExit) as error:  # whatever its code raises
        raise InputError(f'{path}: cannot be run{_line(path, error)}: {type(error).__name__}: {error}') from error
    return names


def _line(path: Path, error: BaseException) -> str:
    """Return which line of a file raised an error, '' if none did."""
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f' in line {lines[-1]}' if lines else ''


UNKNOWN_EFFORT: Final = -math.inf
"""Brake command where a brake acts, or may act, and nothing says how much."""


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
    has_stamps: bool = True  # Whether its stamps are of headers; if not, they are the times of arrival

    @property
    def field(self) -> str:
        """The path as in the file, such as ``twist.linear.x`` or ``data.0``."""
        return '.'.join(map(str, self.path))

    def value(self, raw: float) -> float:
        """Return a number in the unit of the interface; NaN for one that is not in the table."""
        if self.table:
            raw = dict(self.table).get(raw, math.nan)
        if raw == UNKNOWN_EFFORT:
            return raw
        return self.unit.convert(self.sign * self.gain * raw + self.offset)

    def raw(self, message: Any) -> float:
        """Return the number in a message as it is; InputError, naming topic and field, if it has no such number."""
        value, steps = message, 0
        try:
            for step in self.path:
                value = value[step] if isinstance(step, int) else getattr(value, step)
                steps += 1
            return float(value)
        except (AttributeError, IndexError, TypeError, ValueError):
            names, reached = ', '.join(_field_names(value)), '.'.join(map(str, self.path[:steps]))
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

    columns: tuple[str, ...]  # Names of the columns they are made of; without a function the time, and perhaps its date
    unit: Unit  # Unit of times that are numbers
    start_ns: int | None = None  # What such times count from [ns], None if the file does not say so
    function: UserFunction | None = None  # Function of the columns, None without
    format: str = ''  # Form of the times: that of ``strptime``, a name, or '' if it is to be found out
    zone: tzinfo | None = None  # What their clock shows, None if the file does not say so


@dataclass(frozen=True, slots=True)
class CsvFormat:
    """How a CSV file is written; None where it is to be found out."""

    separator: str | None = None  # Character between cells
    decimal: str | None = None  # Decimal sign
    header_rows: int | None = None  # Number of rows with names, units and the like
    encoding: str | None = None  # Name of the encoding
    comments: bool | None = None  # Whether rows that start with ``#`` are comments


class Quantity(NamedTuple):
    """A key of a mapping: quantity of its unit, unit unless another is stated, and our own topic."""

    kind: str
    unit: str
    topic: str


QUANTITIES: Final = {
    'speed': Quantity('speed', 'm/s', SPEED_TOPIC.name),
    'position': Quantity('length', 'm', SPEED_TOPIC.name),
    'force': Quantity('force', 'N', FORCE_TOPIC.name),
    'gradient': Quantity('gradient', 'per_mille', GRADIENT_TOPIC.name),
    'brake_command': Quantity('acceleration', 'm/s^2', BRAKE_TOPIC.name),
    'mass': Quantity('mass', 'kg', MASS_TOPIC.name),
}
_QUANTITY_OF: Final = {quantity.topic: name for name, quantity in QUANTITIES.items() if name != 'position'}
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
    missing: frozenset[str] = frozenset()  # Cells of a table that hold no value, beside the usual ones
    # Kilometre posts [m] after which the posts jump, and by how much [m], in the order of the line
    chainage: tuple[tuple[float, ...], ...] = ()

    def alignment(self, config: AlignmentConfig) -> AlignmentConfig:
        """Return settings of the alignment that fit the mapping."""
        # A brake command published only on change holds for an hour, unless a parameter says otherwise.
        return replace(config, command_hold=3600.0) if self.on_change and config.command_hold == 0.0 else config

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

    def origin(self, topic: str) -> str:
        """Return as text what gives the input of one of our own topics."""
        signal = getattr(self, _QUANTITY_OF[topic])
        unread = f'the constant {signal.value:g}' if isinstance(signal, Constant) else 'the line'
        return ' + '.join(self.needed(topic)) or unread

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
        return tuple(source for signal in self.signals.values() for source in signal.sources)

    @property
    def signals(self) -> dict[str, Signal]:
        """What comes from topics or columns, by quantity."""
        found = {name: getattr(self, name) for name in QUANTITIES}
        return {name: signal for name, signal in found.items() if isinstance(signal, Signal)}


OWN: Final = Mapping()
"""All inputs come from their own topics."""
RAW: Final = Unit('', 1.0)
"""Unit of numbers that stay as they are, such as the arguments of a function."""


def load_mapping(path: str | Path) -> Mapping:
    """Read a mapping file of messages; InputError, naming file and field, if it says something impossible."""
    mapping = parse_mapping(read_text(path), str(path))
    for key in ('time', 'missing'):
        if getattr(mapping, key):
            raise InputError(f'{path}: {key} is of the rows of a table, which trainid import makes a bag of')
    return mapping


def load_table_mapping(path: str | Path) -> Mapping:
    """Read a mapping file of a table; raises as :func:`load_mapping`."""
    text = read_text(path)
    top = _top(text, str(path))
    for name in ('time', 'speed'):  # first, as without a time the fields are those of messages
        if name not in top.data:
            raise InputError(
                f'{path}: {name} is missing: a table needs a column for it, such as {name}: {{field: {name}}}'
            )
    return parse_mapping(text, str(path))


def parse_mapping(text: str, source: str) -> Mapping:
    """Return the mapping in a YAML text; ``source`` is named in errors, as in :func:`load_mapping`."""
    top = _top(text, source)
    brake = top.section('brake_command')
    return Mapping(
        speed=_signal(top, 'speed'),
        position=_position(top),
        force=_signal(top, 'force'),
        gradient=_gradient(top),
        brake_command=_constant(brake) or _signal(top, 'brake_command', 'on_change'),
        mass=_signal(top, 'mass'),
        on_change=brake.boolean('on_change', default=False),
        time=_time(top),
        csv=_csv(top.section('csv')),
        missing=frozenset(str(text).strip().lower() for text in top.items('missing')),
        chainage=_chainage(top),
    )


def _top(text: str, source: str) -> Section:
    return parse_yaml(text, source).only((*QUANTITIES, 'time', 'csv', 'missing', 'chainage'))


def _position(top: Section) -> Position | None:
    section = top.section('position')
    if 'chainage' in section.data:
        section.fail('chainage', 'stands beside position, on a line of its own')
    if 'from' not in section.data:
        return _signal(top, 'position')
    section.only(('from', 'start', 'direction')).choice('from', ('speed',))
    direction = section.integer('direction', 1, low=-1, high=1)
    if direction == 0:
        section.fail('direction', '= 0 must be 1 (positions rise) or -1')
    return SpeedIntegral(section.number('start', 'm', 0.0), direction)


def _chainage(top: Section) -> tuple[tuple[float, ...], ...]:
    jumps = top.rows('chainage', ('m', 'm'))
    if jumps and ('position' not in top.data or 'from' in top.section('position').data):
        top.fail('chainage', 'is of measured positions, and position: {field: ...} is missing')
    for place, (at, jump) in enumerate(jumps):
        if jump == 0.0 or (place and at <= sum(jumps[place - 1])):
            top.fail(f'chainage[{place}]', f'= [{at:g}, {jump:g}] must jump, and lie behind the jump before it')
    return jumps


def _gradient(top: Section) -> Gradient | None:
    section = top.section('gradient')
    if 'from' not in section.data:
        return _constant(section) or _signal(top, 'gradient')
    section.only(('from',)).choice('from', ('line',))
    return LineLookup()


def _constant(section: Section) -> Constant | None:
    if 'value' not in section.data:
        return None
    unit = _unit(section.only(('value', 'unit')), section.path)
    value = unit.convert(section.number('value', unit.name))
    if section.path == 'brake_command':
        _check_braking(section, 'value', value)
    return Constant(value)


def _signal(top: Section, key: str, *more: str) -> Signal | None:
    if key not in top.data:
        return None
    section, is_table = top.section(key, required=True), 'time' in top.data
    if 'function' in section.data:
        section.only(('function', 'of', 'unit', *more))
        sources = tuple(_source(part, '', is_table=is_table) for part in _parts(section, 'of'))
        return Signal(sources, _function(section, _unit(section, key)))
    if 'sum' not in section.data:
        return Signal((_source(section, key, *more, is_table=is_table),))
    section.only(('sum', *more))
    parts = _parts(section, 'sum')
    sources = tuple(_source(part, key, is_table=is_table) for part in parts)
    for place, source in enumerate(sources):
        if any((source.topic, source.path) == (other.topic, other.path) for other in sources[:place]):
            parts[place].fail('field', f'= {shown(source.field)} is in the sum already: it would count twice')
    return Signal(sources)


def _parts(section: Section, key: str) -> list[Section]:
    """Return the sources in a list; a text is the name of a column."""
    parts = section.data.get(key)
    if not isinstance(parts, list) or not parts:
        section.fail(key, f'= {shown(parts)} must be a list of sources')
    named = ({'field': part} if isinstance(part, str) else part for part in parts)
    return [as_section(section.source, f'{section.name(key)}[{place}]', part) for place, part in enumerate(named)]


def _function(section: Section, unit: Unit) -> UserFunction:
    """Return the function that a section names, such as ``force.py:wheel_force``, which returns a unit."""
    text, folder = section.text('function'), Path(section.source).parent
    file, _, name = text.partition(':')
    path, problem = (folder / file).resolve(), ''
    if not (file.endswith('.py') and name.isidentifier()):
        problem = 'must be a Python file and a function in it, like force.py:wheel_force'
    elif Path(file).name != file or path.parent != folder.resolve():
        problem = 'must lie in the folder of the mapping itself'
    elif not path.is_file():
        problem = f'is not there: no file {path}'
    if problem:
        section.fail('function', f'= {shown(text)} {problem}')
    return UserFunction(path, name, unit)


def _unit(section: Section, key: str) -> Unit:
    kind, usual = ('time', 's') if key == 'time' else QUANTITIES[key][:2]
    try:
        return find_unit(section.text('unit', usual), kind)
    except ValueError as error:
        section.fail('unit', f'= {shown(section.data["unit"])} {error}')


def _topic(section: Section) -> str:
    if 'topic' not in section.data:
        section.fail('topic', 'is missing; where the field is a column of a table, time: {field: ...} is missing')
    return section.text('topic')


def _source(section: Section, key: str, *more: str, is_table: bool) -> Source:
    """Return a source of a quantity; without a key that of an argument of a function: the number as it is."""
    places = () if is_table else ('topic', 'stamp')
    section.only(('field', *places, *(('unit', 'sign', 'gain', 'offset', 'table', *more) if key else ())))
    unit = _unit(section, key) if key else RAW
    sign = section.number('sign', '', 1.0)
    if abs(sign) != 1.0:
        section.fail('sign', f'= {sign:g} must be 1 or -1; other factors are a gain')
    source = Source(
        topic='' if is_table else _topic(section),
        path=(section.text('field'),) if is_table else _path(section),
        unit=unit,
        sign=sign,
        gain=section.number('gain', '', 1.0),
        offset=section.number('offset', unit.name, 0.0),
        table=_table(section, unit.name),
        has_stamps=section.choice('stamp', ('header', 'receive'), 'header') == 'header',
    )
    if key == 'brake_command':
        for raw, _ in source.table:
            _check_braking(section, f'table.{raw:g}', source.value(raw))
    return source


def _check_braking(section: Section, key: str, acceleration: float) -> None:
    """Raise InputError for a brake command that would accelerate the train."""
    if acceleration > 0.0:
        section.fail(key, f'gives {acceleration:g} m/s^2, but a brake command is negative or 0; sign: -1 turns a table')


def _path(section: Section) -> tuple[str | int, ...]:
    steps = section.text('field').replace('[', '.').replace(']', '').split('.')
    if not all(step.isidentifier() or step.isdecimal() for step in steps):
        section.fail('field', f'= {shown(section.data["field"])} must be names of fields and indices, like data.0')
    return tuple(int(step) if step.isdecimal() else step for step in steps)


def _table(section: Section, unit: str) -> tuple[tuple[float, float], ...]:
    if 'table' not in section.data:
        return ()
    table, name = section.data['table'], section.name('table')
    if not isinstance(table, dict) or not table:
        section.fail('table', f'= {shown(table)} must have a value for each number, like {{0: 0.0, 1: -0.3}}')
    may_be_unknown = name.startswith('brake_command')
    return tuple(
        (
            finite_number(section.source, name, raw, ''),
            UNKNOWN_EFFORT
            if may_be_unknown and value == 'unknown'
            else finite_number(section.source, f'{name}.{raw}', value, unit),
        )
        for raw, value in table.items()
    )


def _time(top: Section) -> TimeColumn | None:
    if 'time' not in top.data:
        return None
    section = top.section('time', required=True)
    unit, start, zone, form = _unit(section, 'time'), None, None, section.text('format', '')
    # When numbers of a column of times start to count.
    if 'start' in section.data and (start := date_time(str(section.data['start']))) is None:
        section.fail('start', f'= {shown(section.data["start"])} must be a date and time, like 2024-03-08T12:00:00Z')
    if 'zone' in section.data:
        try:
            zone = find_zone(section.text('zone'))
        except ValueError as error:
            section.fail('zone', f'= {shown(section.data["zone"])} {error}')
    if start is not None and start.has_zone and zone is not None:
        section.fail('zone', 'is of a start without a zone, and this one has one')
    if form and form not in {EXCEL, CLOCK} and '%' not in form:
        section.fail('format', f"= {shown(form)} must be like '%d/%m/%Y', '%d/%m/%Y %H:%M:%S', {EXCEL} or {CLOCK}")
    start_ns = None if start is None else start.ns
    if 'function' not in section.data:
        dates = (section.text('date'),) if 'date' in section.data else ()
        section.only(('field', 'format', 'zone', *(['date'] if dates else ['unit', 'start'])))
        return TimeColumn((section.text('field'), *dates), unit, start_ns, None, form, zone)
    section.only(('function', 'of', 'unit', 'start'))
    columns = tuple(_source(part, '', is_table=True).field for part in _parts(section, 'of'))
    return TimeColumn(columns, unit, start_ns, _function(section, unit))


def _csv(section: Section) -> CsvFormat:
    section.only(item.name for item in fields(CsvFormat))
    for key in ('separator', 'decimal'):
        if key in section.data and len(section.text(key)) != 1:
            section.fail(key, f'= {shown(section.data[key])} must be one character')
    section.choice('decimal', ('.', ','), '.')
    if 'encoding' in section.data:
        try:
            codecs.lookup(section.text('encoding'))
        except LookupError:
            section.fail('encoding', f'= {shown(section.data["encoding"])} is not known')
    return CsvFormat(
        separator=section.text('separator', '') or None,
        decimal=section.text('decimal', '') or None,
        header_rows=section.integer('header_rows', 1, low=1, high=1000) if 'header_rows' in section.data else None,
        encoding=section.text('encoding', '') or None,
        comments=section.boolean('comments', default=True) if 'comments' in section.data else None,
    )
