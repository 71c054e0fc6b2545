# SPDX-License-Identifier: Apache-2.0
"""Named effects as families of columns: one column for each value of the shape parameters that is tried.

An effect is nearly linear in its amplitude. Its other parameters, its shape, are tried on a grid, and the evidence is
averaged over the grid: a family that can look like anything pays for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.physics.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from trainid_ros.discrepancy.nodes import Drive
    from trainid_ros.discrepancy.points import Points
    from trainid_ros.physics.effects import EffectKind

    Array = NDArray[np.float64]

_SHAPES: Final = 6
_MOST_TIMES: Final = 40
SECTIONS: Final = ('gradient_error', 'local_drag')
"""Families scanned by sums over stretches of the line: all starts and ends at once."""


@dataclass(frozen=True, slots=True)
class Family:
    """Columns of one named effect.

    Attributes:
        name: Name of the effect.
        shapes: Shape parameters of each column.
        resistance: Resistance per unit of amplitude [N/kN], shape (n, k).
        std: Prior standard deviation of the amplitude.
        sign: +1 or -1 if the amplitude lies above or below its neutral value only, otherwise 0.

    """

    name: str
    shapes: tuple[Mapping[str, float], ...]
    resistance: Array
    std: float
    sign: int


def named_families(points: Points) -> tuple[Family, ...]:
    """Return the families of all effects of the library but those of :data:`SECTIONS`, without empty ones."""
    families = []
    for kind in EFFECTS.values():
        if kind.resistance is None or kind.name in SECTIONS:
            continue
        shapes = tuple(dict(zip(shape_names(kind), values, strict=True)) for values in _grid(kind, points.drive))
        columns = [unit_resistance(points, kind, shape) for shape in shapes]
        seen = [i for i, column in enumerate(columns) if np.any(column)]
        if seen:
            resistance = np.stack([columns[i] for i in seen], axis=1)
            families.append(Family(kind.name, tuple(shapes[i] for i in seen), resistance, usual(kind), sign(kind)))
    return tuple(families)


def unit_resistance(points: Points, kind: EffectKind, shape: Mapping[str, float]) -> Array:
    """Return the resistance of an effect of usual size, per unit of its amplitude, shape (n,)."""
    size = usual(kind)
    parameters = {**shape, kind.amplitude: kind.neutral + size}
    return points.resistance(kind.name, parameters) / size


def shape_names(kind: EffectKind) -> tuple[str, ...]:
    """Return the names of all parameters but the amplitude."""
    return tuple(name for name in kind.parameters if name != kind.amplitude)


def usual(kind: EffectKind) -> float:
    """Return the usual size of an amplitude, away from its neutral value."""
    return kind.usual


def sign(kind: EffectKind) -> int:
    """Return which side of its neutral value an amplitude can lie on, 0 for both."""
    limits = kind.parameters[kind.amplitude]
    if limits.search is not None:
        low, high = limits.search
        return int(low >= kind.neutral) - int(high <= kind.neutral)
    return int(limits.low >= kind.neutral) - int(limits.high <= kind.neutral)


def _grid(kind: EffectKind, drive: Drive) -> list[tuple[float, ...]]:
    axes = [_axis(kind, name, drive) for name in shape_names(kind)]
    return list(product(*axes))


def _axis(kind: EffectKind, name: str, drive: Drive) -> list[float]:
    limits = kind.parameters[name]
    if limits.search is None:
        # Times: whenever the train moves.
        moving = drive.time[:: max(1, drive.time.size // _MOST_TIMES)]
        return [float(t) for t in moving[1:]]
    low, high = limits.search
    values = np.geomspace(low, high, _SHAPES) if limits.grid == 'log' else np.linspace(low, high, _SHAPES)
    return [float(value) for value in values]
