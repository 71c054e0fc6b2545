# SPDX-License-Identifier: Apache-2.0
"""A train file in the making, from what files of other systems say of a train and its line."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import did_you_mean
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
    notes: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

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
