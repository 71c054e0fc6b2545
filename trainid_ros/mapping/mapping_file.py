# SPDX-License-Identifier: Apache-2.0
"""Read mapping files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.mapping.mapping import LineLookup, Mapping, Signal, Source, SpeedIntegral, StampSource
from trainid_ros.mapping.units import find_unit
from trainid_ros.train.fields import Section, as_section, finite_number, parse_yaml, read_text, shown

if TYPE_CHECKING:
    from pathlib import Path

_QUANTITIES: Final = {
    'speed': ('speed', 'm/s'),
    'position': ('length', 'm'),
    'force': ('force', 'N'),
    'gradient': ('gradient', 'per_mille'),
    'brake_command': ('acceleration', 'm/s^2'),
    'mass': ('mass', 'kg'),
}
_SOURCE_KEYS: Final = ('topic', 'field', 'unit', 'sign', 'gain', 'offset', 'stamp', 'table')
_FROM: Final = 'from'
_SUM: Final = 'sum'
_ON_CHANGE: Final = 'on_change'


def load_mapping(path: str | Path) -> Mapping:
    """Read a mapping file.

    Raises:
        InputError: The file cannot be read or says something impossible; the error names file and field.

    """
    return parse_mapping(read_text(path), str(path))


def parse_mapping(text: str, source: str) -> Mapping:
    """Return the mapping in a YAML text; ``source`` is named in errors, as in :func:`load_mapping`."""
    top = parse_yaml(text, source).only(_QUANTITIES)
    brake = top.section('brake_command')
    return Mapping(
        speed=_signal(top, 'speed'),
        position=_position(top),
        force=_signal(top, 'force'),
        gradient=_gradient(top),
        brake_command=_signal(top, 'brake_command', _ON_CHANGE),
        mass=_signal(top, 'mass'),
        on_change=brake.boolean(_ON_CHANGE, default=False),
    )


def _position(top: Section) -> Signal | SpeedIntegral | None:
    section = top.section('position')
    if _FROM not in section.data:
        return _signal(top, 'position')
    section.only((_FROM, 'start', 'direction')).choice(_FROM, ('speed',))
    direction = section.integer('direction', 1, low=-1, high=1)
    if direction == 0:
        section.fail('direction', '= 0 must be 1 (positions rise) or -1')
    return SpeedIntegral(section.number('start', 'm', 0.0), direction)


def _gradient(top: Section) -> Signal | LineLookup | None:
    section = top.section('gradient')
    if _FROM not in section.data:
        return _signal(top, 'gradient')
    section.only((_FROM,)).choice(_FROM, ('line',))
    return LineLookup()


def _signal(top: Section, key: str, *more: str) -> Signal | None:
    if key not in top.data:
        return None
    section = top.section(key, required=True)
    if _SUM not in section.data:
        return Signal((_source(section, key, *more),))
    section.only((_SUM, *more))
    parts = section.data[_SUM]
    if not isinstance(parts, list) or not parts:
        section.fail(_SUM, f'= {shown(parts)} must be a list of sources')
    return Signal(
        tuple(
            _source(as_section(section.source, f'{section.name(_SUM)}[{place}]', part), key)
            for place, part in enumerate(parts)
        )
    )


def _source(section: Section, key: str, *more: str) -> Source:
    section.only((*_SOURCE_KEYS, *more))
    quantity, usual = _QUANTITIES[key]
    try:
        unit = find_unit(section.text('unit', usual), quantity)
    except ValueError as error:
        section.fail('unit', f'= {shown(section.data["unit"])} {error}')
    sign = section.number('sign', '', 1.0)
    if abs(sign) != 1.0:
        section.fail('sign', f'= {sign:g} must be 1 or -1; other factors are a gain')
    return Source(
        topic=section.text('topic'),
        path=_path(section),
        unit=unit,
        sign=sign,
        gain=section.number('gain', '', 1.0),
        offset=section.number('offset', unit.name, 0.0),
        table=_table(section, unit.name),
        stamp=StampSource(section.choice('stamp', tuple(item.value for item in StampSource), 'header')),
    )


def _path(section: Section) -> tuple[str | int, ...]:
    steps = section.text('field').replace('[', '.').replace(']', '').split('.')
    if not all(step.isidentifier() or step.isdigit() for step in steps):
        section.fail('field', f'= {shown(section.data["field"])} must be names of fields and indices, like data.0')
    return tuple(int(step) if step.isdigit() else step for step in steps)


def _table(section: Section, unit: str) -> tuple[tuple[float, float], ...]:
    if 'table' not in section.data:
        return ()
    table, name = section.data['table'], section.name('table')
    if not isinstance(table, dict) or not table:
        section.fail('table', f'= {shown(table)} must have a value for each number, like {{0: 0.0, 1: -0.3}}')
    return tuple(
        (finite_number(section.source, name, raw, ''), finite_number(section.source, f'{name}.{raw}', value, unit))
        for raw, value in table.items()
    )
