# SPDX-License-Identifier: Apache-2.0
"""Named effects as families of columns: one column for each value of the shape parameters that is tried.

An effect is nearly linear in its amplitude. Its other parameters, the shape, are tried on a grid, and the Bayes factor
is averaged over the grid, which penalises flexible families.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.explain.effect_evaluation import EffectEvaluator
    from trainid_ros.train.effects import EffectKind, Parameter

    Array = NDArray[np.float64]

_SHAPES: Final = 6
"""Grid points of a shape parameter."""
_MAX_TIMES: Final = 40
"""Maximum number of grid points of a time."""
_PLACES: Final = {1: 40, 2: 16}
"""Grid points of each position, by the number of positions in a shape."""
_PLACES_OF_MANY: Final = 6
"""Grid points of each position of shapes with more positions."""
_LASTING_S: Final = 60.0
"""Driving time needed before and after a change in time to detect it [s]."""
_SIZES: Final = (1.0, -1.0, 2.0, -2.0)
"""Amplitudes tried for an effect without shape parameters, in units of its usual value: it may be non-linear."""
_SAME: Final = 0.05
"""Relative tolerance within which two columns count as equal."""
SECTIONS: Final = ('gradient_error', 'local_drag')
"""Effects on a section of the line, scanned over all starts and ends at once by sums over bins."""


@dataclass(frozen=True, slots=True)
class Family:
    """Columns of one named effect.

    Attributes:
        name: Name of the effect.
        shapes: Shape parameters of each column, in the units of the effect.
        resistance: Resistance per unit of amplitude [N/kN], shape (n, k).
        std: Prior standard deviation of the amplitude, in its unit.
        sign: +1 or -1 if the amplitude can only lie above or below its neutral value, otherwise 0.

    """

    name: str
    shapes: tuple[Mapping[str, float], ...]
    resistance: Array
    std: float
    sign: int


def named_families(evaluator: EffectEvaluator) -> tuple[Family, ...]:
    """Return the families of all effects of the library except :data:`SECTIONS` and those without any response."""
    families = []
    for kind in EFFECTS.values():
        if kind.resistance is None or kind.name in SECTIONS:
            continue
        shapes, columns = _columns(kind, evaluator)
        seen = [i for i, column in enumerate(columns) if np.any(column)]
        if seen:
            resistance = np.stack([columns[i] for i in seen], axis=1)
            families.append(Family(kind.name, tuple(shapes[i] for i in seen), resistance, kind.usual, sign(kind)))
    return tuple(families)


def unit_resistance(
    evaluator: EffectEvaluator, kind: EffectKind, shape: Mapping[str, float], times: float = 1.0
) -> Array:
    """Return the resistance [N/kN] of an effect at ``times`` its usual amplitude, per unit of amplitude, shape (n,)."""
    size = times * kind.usual
    parameters = {**shape, kind.amplitude: kind.neutral + size}
    return evaluator.resistance(kind.name, parameters) / size


def shape_names(kind: EffectKind) -> tuple[str, ...]:
    """Return the names of all parameters except the amplitude."""
    return tuple(name for name in kind.parameters if name != kind.amplitude)


def sign(kind: EffectKind) -> int:
    """Return the side of its neutral value on which an amplitude can lie: +1, -1, or 0 for both."""
    limits = kind.parameters[kind.amplitude]
    low, high = limits.search or (limits.low, limits.high)
    return int(low >= kind.neutral) - int(high <= kind.neutral)


def _columns(kind: EffectKind, evaluator: EffectEvaluator) -> tuple[list[dict[str, float]], list[Array]]:
    """Return shapes and their columns; a shape is repeated where the response is not linear in the amplitude."""
    shapes = _shapes(kind, evaluator.dataset)
    if shape_names(kind) or sign(kind):
        return shapes, [unit_resistance(evaluator, kind, shape) for shape in shapes]
    columns: list[Array] = []
    for times in _SIZES:
        column = unit_resistance(evaluator, kind, shapes[0], times)
        if not any(np.allclose(column, other, rtol=_SAME, atol=_SAME * np.abs(other).max()) for other in columns):
            columns.append(column)
    return shapes * len(columns), columns


def _shapes(kind: EffectKind, dataset: Dataset) -> list[dict[str, float]]:
    """Return the grid of all parameters except the amplitude."""
    names = shape_names(kind)
    axes = [_axis(kind.parameters[name], dataset, _place_count(kind, names)) for name in names]
    shapes = (dict(zip(names, values, strict=True)) for values in product(*axes))
    return [shape for shape in shapes if not ('start' in shape and 'end' in shape and shape['start'] >= shape['end'])]


def _place_count(kind: EffectKind, names: Sequence[str]) -> int:
    """Return the number of grid points of each position, which limits the number of combinations."""
    places = sum(kind.parameters[name].is_place for name in names)
    return _PLACES.get(places, _PLACES_OF_MANY)


def _axis(limits: Parameter, dataset: Dataset, places: int) -> list[float]:
    """Return the grid points of one parameter."""
    if limits.is_place:
        if not dataset.positioned:
            return []
        position = dataset.joined('position')
        # Positions outside the section driven have no effect on the data.
        tried = np.linspace(position.min(), position.max(), places + 2)[1:-1]
        return [float(place) for place in tried if limits.low <= place <= limits.high]
    if limits.search is None:
        # Times: while the train moves, with enough driving before and after for a change to be detectable.
        driven = np.cumsum(dataset.dt)
        moving = dataset.time[(driven > _LASTING_S) & (driven < driven[-1] - _LASTING_S)]
        return [float(t) for t in moving[:: max(1, moving.size // _MAX_TIMES)]]
    low, high = limits.search
    values = np.geomspace(low, high, _SHAPES) if limits.grid == 'log' else np.linspace(low, high, _SHAPES)
    return [float(value) for value in values]
