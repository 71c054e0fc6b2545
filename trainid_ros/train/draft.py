# SPDX-License-Identifier: Apache-2.0
"""A train file in the making, from what files of other systems say of a train and its line.

OSRD (RailJSON) is read here: rolling stock and infrastructure in kg, m, m/s, N, per mille.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import Section, as_section, did_you_mean, shown
from trainid_ros.train.forces import davis, specific_force
from trainid_ros.train.train_file import Train, TrainFile

Stretch = tuple[float, float, float]
"""Start and end [m], and the value between them in the unit of the train file."""
_NEEDED: Final = ('train.mass', 'resistance.a', 'resistance.b', 'resistance.c')
_USUAL: Final = (
    'train.rotary_mass', 'train.length', 'train.cars', 'train.max_traction_force', 'train.max_traction_power',
    'train.max_speed', 'brake.time_constant', 'brake.delay', 'line.stops', 'line.gradient',
)  # fmt: skip
_USUAL_W: Final = (0.3, 30.0)
"""Resistance of trains at 10 m/s [N/kN]: the low end is the rolling part alone of the modified Davis formula of the
AREMA manual, 0.6 lb per short ton; the high end, a hundred times that, is a wide margin and not measured."""
_USUAL_MASS: Final = (1e3, 1e8)
"""Mass of trains [kg]: a light trolley has more than the low end, the heaviest train on record had 99 734 t (Port
Hedland, 2001)."""


FLAT: Final = ('train', 'resistance')
"""Sections whose fields the files of other systems replace one by one."""


@dataclass(slots=True)
class Draft:
    """Fields of a train file as far as they are stated, how they were read, and what it cannot say."""

    train: dict[str, Any] = field(default_factory=dict)
    resistance: dict[str, Any] = field(default_factory=dict)
    other: dict[str, Any] = field(default_factory=dict)  # The other sections
    stops: list[float] = field(default_factory=list)  # Positions [m]
    extent: tuple[float, float] = (0.0, 0.0)  # Positions at the ends of the line [m]
    # By name of the field of the line
    stretches: dict[str, list[Stretch]] = field(default_factory=dict)
    given: dict[str, dict[str, Any]] = field(default_factory=dict)  # Sections of train files, by name of the file
    notes: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def merge(self, name: str, sections: dict[str, Any]) -> None:
        """Take in the sections of a train file with a name."""
        self.given[name] = sections
        self.train |= sections.get('train', {})
        self.resistance |= sections.get('resistance', {})
        self.other |= {key: section for key, section in sections.items() if key not in FLAT}

    def drop_other_mass_std(self) -> None:
        """Drop the std of a mass that a file after its own has replaced."""
        stated = [sections.get('train', {}) for sections in self.given.values()]
        last = next((train for train in reversed(stated) if 'mass_std' in train), None)
        if last is not None and self.train.get('mass') != last.get('mass'):
            del self.train['mass_std']

    def kept(self) -> list[str]:
        """Return as text what comes from train files."""
        texts, own = [], {'train': self.train, 'resistance': self.resistance}
        for name, sections in self.given.items():
            values = [(part, key, value) for part in FLAT for key, value in sections.get(part, {}).items()]
            fields = [f'{part}.{key}' for part, key, value in values if own[part].get(key) == value]
            fields += [key for key in sections if key in self.other]
            texts += [f'{", ".join(fields)} of {name}'] if fields else []
        return texts

    def set_resistance(self, total: Iterable[float], mass: float) -> None:
        """Set a, b, c from A [N], B [N/(m/s)] and C [N/(m/s)^2] of a mass [kg]."""
        weight = max(mass, 1.0)  # a lower one is out of range
        each = zip('abc', total, strict=True)
        self.resistance = {key: float(f'{specific_force(force, weight):.7g}') for key, force in each}

    def set_traction(self, curve: Sequence[tuple[float, float]]) -> None:
        """Set force and power from rows of speed [m/s] and force [N]: the train file has no other curve."""
        force, power = max(f for _, f in curve), float(f'{max(v * f for v, f in curve):.7g}')
        off = max((min(force, power / v if v else math.inf) / f for v, f in curve if f > 0.0), default=1.0)
        self.train |= {'max_traction_force': force, 'max_traction_power': power}
        self.notes.append(f'traction: by its largest force and power, at most {off - 1.0:.0%} above its curve')

    def add(self, kind: str, start: float, end: float, value: float) -> None:
        """Add a stretch of the line; one without length is none, one of NaN is left out."""
        if end > start and math.isnan(value):
            self.left_out.append(f'{kind} from {start:g} to {end:g} m, without a value')
        if end > start and value and math.isfinite(value):
            self.stretches.setdefault(kind, []).append((start, end, abs(value) if kind == 'curve' else value))

    def sections(self) -> dict[str, Any]:
        """Return all sections of the train file; where the line has no limit of speed, that of the train holds."""
        line: dict[str, Any] = {kind: self._steps(kind, rows) for kind, rows in self.stretches.items()}
        if 'tunnel' in line:
            steps = [*line['tunnel'], [self.extent[1], 0.0]]
            line['tunnel'] = [[a, b] for (a, inside), (b, _) in pairwise(steps) if inside]
        if self.stops:
            line['stops'] = sorted(set(self.stops))
        found = {'train': self.train, 'resistance': self.resistance, **self.other}
        found |= {'line': line} if line else {}
        return {name: section for name, section in found.items() if section}

    def _steps(self, kind: str, stretches: Sequence[Stretch]) -> list[list[float]]:
        """Return position and value from it on; the least of several at a place."""
        (first, last), rows = self.extent, list[list[float]]()
        blank = self.train.get('max_speed', Train(1.0).max_speed) if kind == 'speed_limit' else 0.0
        edges = {first, last, *(x for a, b, _ in stretches for x in (a, b) if first < x < last)}
        for start, end in pairwise(sorted(edges)):
            value = min((v for a, b, v in stretches if a <= start and b >= end), default=blank)
            if not rows or rows[-1][1] != value:
                rows.append([start, value])
        return rows

    def missing(self) -> tuple[list[str], list[str]]:
        """Return what a train file needs and is not stated, and other fields that are not: their defaults hold."""
        given = {f'{name}.{key}' for name, section in self.sections().items() for key in section}
        given |= {'train.mass', 'train.length'} if isinstance(self.train.get('cars'), list) else set()
        return [name for name in _NEEDED if name not in given], [name for name in _USUAL if name not in given]


def doubts(file: TrainFile) -> list[str]:
    """Return the values of a train file that are in range, but no train has: their unit is wrong."""
    w, mass = float(davis(file.resistance, 10.0)), file.train.mass
    return [
        f'{name} = {value:.3g} {unit}, but trains have {low:g} to {high:g} {unit}: check the unit'
        for name, value, unit, (low, high) in (
            ('resistance at 10 m/s', w, 'N/kN', _USUAL_W), ('train.mass', mass, 'kg', _USUAL_MASS),
        ) if not low <= value <= high
    ]  # fmt: skip


def chosen(name: str, known: Sequence[str], source: str, option: str) -> str:
    """Return the name asked for, or the only one; InputError, which lists them, if there is no such choice."""
    if name in known or (not name and len(known) == 1):
        return name or known[0]
    hint = f'has no {name!r}; {did_you_mean(name, known)}' if name else f'has {", ".join(known[:12])}'
    raise InputError(f'{source}: {hint}; choose one with {option}{f" (of {len(known)})" * (len(known) > 12)}')


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
