# SPDX-License-Identifier: Apache-2.0
"""Read mapping files."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Final

from trainid_ros.inputs.mapping import (
    UNKNOWN_EFFORT,
    Constant,
    CsvFormat,
    LineLookup,
    Mapping,
    Signal,
    Source,
    SpeedIntegral,
    StampSource,
    TimeColumn,
    Unit,
    UserFunction,
    date_time_ns,
    find_unit,
    user_function,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import Section, as_section, finite_number, parse_yaml, read_text, shown

QUANTITIES: Final = {
    'speed': ('speed', 'm/s'),
    'position': ('length', 'm'),
    'force': ('force', 'N'),
    'gradient': ('gradient', 'per_mille'),
    'brake_command': ('acceleration', 'm/s^2'),
    'mass': ('mass', 'kg'),
}
"""Keys, each with the quantity of its unit and the unit unless another is stated."""
_COLUMN_KEYS: Final = ('field', 'unit', 'sign', 'gain', 'offset', 'table')
_SOURCE_KEYS: Final = ('topic', 'stamp', *_COLUMN_KEYS)
# Of what a function is given, in its own unit.
_RAW: Final = Unit('', 1.0)


def load_mapping(path: str | Path) -> Mapping:
    """Read a mapping file of messages.

    Raises:
        InputError: The file cannot be read or says something impossible; the error names file and field.
    """
    mapping = parse_mapping(read_text(path), str(path))
    if mapping.time is not None:
        raise InputError(
            f'{path}: time is of the rows of a table, which trainid import makes a bag of; a bag has stamps'
        )
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
    )


def _top(text: str, source: str) -> Section:
    return parse_yaml(text, source).only((*QUANTITIES, 'time', 'csv'))


def _position(top: Section) -> Signal | SpeedIntegral | None:
    section = top.section('position')
    if 'from' not in section.data:
        return _signal(top, 'position')
    section.only(('from', 'start', 'direction')).choice('from', ('speed',))
    direction = section.integer('direction', 1, low=-1, high=1)
    if direction == 0:
        section.fail('direction', '= 0 must be 1 (positions rise) or -1')
    return SpeedIntegral(section.number('start', 'm', 0.0), direction)


def _gradient(top: Section) -> Signal | LineLookup | Constant | None:
    section = top.section('gradient')
    if 'from' not in section.data:
        return _constant(section) or _signal(top, 'gradient')
    section.only(('from',)).choice('from', ('line',))
    return LineLookup()


def _constant(section: Section) -> Constant | None:
    if 'value' not in section.data:
        return None
    section.only(('value', 'unit'))
    unit = _unit(section, section.path)
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
        sources = tuple(_raw(part, is_table=is_table) for part in _parts(section, 'of'))
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
    try:
        return user_function(Path(section.source).parent, section.text('function'), unit)
    except ValueError as error:
        section.fail('function', f'= {shown(section.data["function"])} {error}')


def _unit(section: Section, key: str) -> Unit:
    quantity, usual = QUANTITIES[key]
    try:
        return find_unit(section.text('unit', usual), quantity)
    except ValueError as error:
        section.fail('unit', f'= {shown(section.data["unit"])} {error}')


def _raw(section: Section, *, is_table: bool) -> Source:
    """Return a source of what a function is given: the number as it is."""
    if is_table:
        return Source('', (section.only(('field',)).text('field'),), _RAW)
    section.only(('topic', 'field', 'stamp'))
    return Source(_topic(section), _path(section), _RAW, stamp=_stamp(section))


def _topic(section: Section) -> str:
    if 'topic' not in section.data:
        section.fail('topic', 'is missing; where the field is a column of a table, time: {field: ...} is missing')
    return section.text('topic')


def _stamp(section: Section) -> StampSource:
    return StampSource(section.choice('stamp', tuple(item.value for item in StampSource), 'header'))


def _source(section: Section, key: str, *more: str, is_table: bool) -> Source:
    section.only((*(_COLUMN_KEYS if is_table else _SOURCE_KEYS), *more))
    unit = _unit(section, key)
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
        stamp=_stamp(section),
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
    try:
        unit = find_unit(section.text('unit', 's'), 'time')
    except ValueError as error:
        section.fail('unit', f'= {shown(section.data["unit"])} {error}')
    start_ns = _start(section)
    if 'function' not in section.data:
        section.only(('field', 'unit', 'start'))
        return TimeColumn((section.text('field'),), unit, start_ns)
    section.only(('function', 'of', 'unit', 'start'))
    columns = tuple(_raw(part, is_table=True).field for part in _parts(section, 'of'))
    return TimeColumn(columns, unit, start_ns, _function(section, unit))


def _start(section: Section) -> int | None:
    """Return when numbers of a column of times start to count [ns], None if it is not said."""
    if 'start' not in section.data:
        return None
    value = section.data['start']
    if (start_ns := date_time_ns(str(value))) is None:
        section.fail('start', f'= {shown(value)} must be a date and time, like 2024-03-08T12:00:00Z')
    return start_ns


def _csv(section: Section) -> CsvFormat:
    section.only(('separator', 'decimal', 'header_rows', 'encoding', 'comments'))
    for key in ('separator', 'decimal'):
        if key in section.data and len(section.text(key)) != 1:
            section.fail(key, f'= {shown(section.data[key])} must be one character')
    if section.text('decimal', '.') not in {'.', ','}:
        section.fail('decimal', f'= {shown(section.data["decimal"])} must be . or ,')
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
