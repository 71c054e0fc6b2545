# SPDX-License-Identifier: Apache-2.0
"""Rolling stock and infrastructure of OSRD (RailJSON): kg, m, m/s, N, per mille."""

from __future__ import annotations

import json
from typing import Final

from trainid_ros.interface.errors import InputError
from trainid_ros.train.draft import Draft, chosen
from trainid_ros.train.fields import Section, as_section, shown

_READ: Final = (
    'mass', 'length', 'max_speed', 'inertia_coefficient', 'rolling_resistance', 'effort_curves', 'track_sections',
    'speed_sections', 'operational_points', 'id', 'name', 'railjson_version', 'version', 'locked', 'metadata',
)  # fmt: skip
"""What is read, and what says nothing of train and line."""


def read_osrd(text: str, source: str, track: str, draft: Draft) -> None:
    """Add what a file states to a draft, the line along one track; InputError for a file that cannot be used."""
    try:
        top = as_section(source, '', json.loads(text))
    except (ValueError, RecursionError) as error:
        raise InputError(f'{source}: is not valid JSON: {error}') from None
    if 'track_sections' in top.data:
        _read_line(top, track, draft)
    elif 'rolling_resistance' in top.data:
        _read_train(top, draft)
    else:
        raise InputError(f'{source}: has neither rolling_resistance nor track_sections, as files of OSRD have')
    for key, value in top.data.items():
        if value and key not in _READ:
            draft.left_out.append(f'{key} ({len(value)})' if isinstance(value, list) else f'{key} = {shown(value)}')


def _read_train(top: Section, draft: Draft) -> None:
    mass, rotary_mass = top.number('mass', 'kg'), round(top.number('inertia_coefficient', '') - 1.0, 9)
    draft.train |= {'mass': mass, 'rotary_mass': rotary_mass}
    draft.train |= {'length': top.number('length', 'm'), 'max_speed': top.number('max_speed', 'm/s')}
    drag = top.section('rolling_resistance', required=True)
    drag.choice('type', ('davis',))
    draft.set_resistance((drag.number(key, 'N and m/s') for key in 'ABC'), mass)
    if 'effort_curves' in top.data:
        modes = top.section('effort_curves')
        mode = modes.section('modes', required=True).section(modes.text('default_mode'), required=True)
        curve = mode.section('default_curve', required=True)
        speeds, efforts = curve.numbers('speeds', 'm/s'), curve.numbers('max_efforts', 'N')
        if not speeds or len(speeds) != len(efforts):
            curve.fail('max_efforts', f'has {len(efforts)} values for {len(speeds)} speeds')
        draft.set_traction(list(zip(speeds, efforts, strict=True)))


def _read_line(top: Section, track: str, draft: Draft) -> None:
    sections = {section.text('id'): section for section in _each(top, 'track_sections')}
    track = chosen(track, list(sections), top.source, '--track')
    draft.extent = 0.0, sections[track].number('length', 'm')
    for key, kind, value, unit in (('slopes', 'gradient', 'gradient', 'per mille'), ('curves', 'curve', 'radius', 'm')):
        for row in _each(sections[track], key):
            draft.add(kind, row.number('begin', 'm'), row.number('end', 'm'), row.number(value, unit))
    for limit in _each(top, 'speed_sections'):
        for row in _each(limit, 'track_ranges'):
            is_limit = row.text('track') == track and limit.data.get('speed_limit') is not None
            if is_limit and row.text('applicable_directions', 'BOTH') != 'STOP_TO_START':
                ends = row.number('begin', 'm'), row.number('end', 'm')
                draft.add('speed_limit', *ends, limit.number('speed_limit', 'm/s'))
    parts = [part for point in _each(top, 'operational_points') for part in _each(point, 'parts')]
    draft.stops = [part.number('position', 'm') for part in parts if part.text('track') == track]
    draft.notes.append(f'line: track {track}, with its operational points as stops')


def _each(of: Section, key: str) -> list[Section]:
    return [as_section(of.source, f'{of.name(key)}[{i}]', item) for i, item in enumerate(of.items(key))]
