# SPDX-License-Identifier: Apache-2.0
"""Locate the gap between simulation and data: the missing resistance by position, speed, driving mode and so on.

Each axis is divided into parts, and the mean resistance that the model lacks in each part is estimated jointly with all
nuisances, by the same whitened regression as the effects; its standard deviation thus allows for errors that are
correlated in time. What all parts of an axis have in common is Davis ``a``, which is fitted anyway, so each part is
given as its deviation from the mean of all parts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.result import Location, Place, place_text
from trainid_ros.explain.run_data import BRAKING, PULLING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.explain.model import Model

    Array = NDArray[np.float64]

PRIOR: Final = 3.0
"""Prior std of the missing resistance in one part [N/kN]: without data the estimate stays near zero with this std."""
RELEASED_S: Final = 10.0
"""Time after brake release for which the mode is 'just released' [s]."""
_PLACES: Final = 40
# Where an effect is reported to act: number of places, and significance of each in standard deviations.
_NAMED_PLACES: Final = 3
_CLEAR: Final = 3.0


@dataclass(frozen=True, slots=True)
class _Axis:
    """One axis: labels and edges of its k parts, and the samples that lie in each, shape (n, k)."""

    name: str
    unit: str
    labels: tuple[str, ...]
    edges: tuple[tuple[float, float], ...]
    inside: NDArray[np.bool_]


def locate(before: Model, after: Model, hyper: Hyperparameters) -> tuple[Location, ...]:
    """Return the missing resistance along all axes that the data cover.

    Args:
        before: Model without the effects.
        after: Model with the effects.
        hyper: Hyperparameters of noise and nuisances.

    """
    axes = _axes(before.dataset)
    columns = [before.dataset.column(axis.inside.astype(float)) for axis in axes]
    estimates = [_estimate(model, hyper, columns) for model in (before, after)]
    weight = before.dataset.dt / before.dataset.dt.sum()
    locations = []
    for k, axis in enumerate(axes):
        share = weight @ axis.inside
        (first, std), (second, _) = (_deviation_from_mean(*estimate[k], share / share.sum()) for estimate in estimates)
        rows = zip(axis.labels, axis.edges, first.tolist(), second.tolist(), std.tolist(), share.tolist(), strict=True)
        places = tuple(Place(label, low, high, a, b, s, part) for label, (low, high), a, b, s, part in rows)
        locations.append(Location(axis.name, axis.unit, places))
    return tuple(locations)


def where(resistance: Array, dataset: Dataset, locations: Sequence[Location]) -> str:
    """Return as text where the resistance of an effect differs most significantly from its mean.

    Args:
        resistance: Resistance of the effect on each stage [N/kN], shape (n,).
        dataset: The dataset.
        locations: Result of :func:`locate` for the dataset.

    """
    weight = dataset.dt / dataset.dt.sum()
    mean = float(weight @ resistance)
    found = []
    for axis, location in zip(_axes(dataset), locations, strict=True):
        if axis.name == 'run':
            continue
        total, share = np.stack((weight * resistance, weight)) @ axis.inside
        found += [
            (abs(size) / place.std, f'{place_text(axis.name, place.label)} ({size:+.2f} N/kN)')
            for size, place in zip((total / share - mean).tolist(), location.places, strict=True)
            if place.std > 0.0
        ]
    clear = [text for z, text in sorted(found, reverse=True)[:_NAMED_PLACES] if z > _CLEAR]
    return ', '.join(clear) or 'no distinct location'


def _estimate(model: Model, hyper: Hyperparameters, columns: list[Array]) -> list[tuple[Array, Array]]:
    """Return means and covariances of the parts of each axis, one axis at a time."""
    estimates: list[tuple[Array, Array]] = []
    for found in model.informations(hyper, columns, terms=False):
        covariance = np.asarray(np.linalg.inv(found.A + np.eye(len(found.b)) / PRIOR**2))
        estimates.append((covariance @ found.b, covariance))
    return estimates


def _deviation_from_mean(value: Array, covariance: Array, share: Array) -> tuple[Array, Array]:
    """Return deviations from the mean of all parts, weighted by their shares, and their standard deviations."""
    deviation = np.eye(share.size) - share[None, :]
    variance = np.einsum('ij,jk,ik->i', deviation, covariance, deviation)
    return deviation @ value, np.sqrt(np.maximum(variance, 0.0))


def _axes(dataset: Dataset) -> list[_Axis]:
    v, traction, brake = dataset.speed, dataset.joined('traction'), dataset.joined('brake')
    position, heat, release = dataset.joined('position'), dataset.joined('heat'), dataset.joined('since_release')
    rising, inside, curved = dataset.direction > 0, dataset.joined('tunnel') >= 0.5, dataset.joined('radius') > 0.0
    braking, pulling = brake < BRAKING, traction > PULLING
    released = ~braking & (release < RELEASED_S)
    modes = (pulling & ~released, ~pulling & ~braking & ~released, braking, released)
    runs = tuple(dataset.run_of == k for k in range(len(dataset.runs)))
    ways = [('position', np.full(v.size, dataset.positioned))]
    if dataset.positioned and rising.any() and not rising.all():
        ways = [('position, rising', rising), ('position, falling', ~rising)]
    axes = [
        *(_cut(name, 'm', np.where(way, position, np.nan), _PLACES) for name, way in ways),
        _cut('speed', 'm/s', v, 8),
        _kinds('mode', ('traction', 'coasting', 'braking', 'just released'), modes),
        _kinds('direction', ('rising', 'falling'), (rising, ~rising)),
        _kinds('tunnel', ('open air', 'tunnel'), (~inside, inside)),
        _kinds('curve', ('straight', 'curve'), (~curved, curved)),
        _cut('heat of the brake', 'J/kg', np.where(braking, heat, np.nan), 6),
        _kinds('run', tuple(str(k + 1) for k in range(len(runs))), runs),
    ]
    return [axis for axis in axes if len(axis.labels) > 1]


def _cut(name: str, unit: str, x: Array, count: int) -> _Axis:
    """Return an axis divided into ``count`` parts of equal length, without empty ones; NaN lies outside the axis."""
    known = x[np.isfinite(x)]
    if known.size == 0 or known.max() <= known.min():
        return _Axis(name, unit, (), (), np.zeros((x.size, 0), dtype=bool))
    cuts = np.linspace(known.min(), known.max(), count + 1)
    part = np.clip(np.digitize(x, cuts) - 1, 0, count - 1)
    inside = (part[:, None] == np.arange(count)) & np.isfinite(x)[:, None]
    seen = np.flatnonzero(inside.any(axis=0)).tolist()
    edges = tuple((float(cuts[i]), float(cuts[i + 1])) for i in seen)
    labels = tuple(f'{low:.0f} to {high:.0f} {unit}' for low, high in edges)
    return _Axis(name, unit, labels, edges, inside[:, seen])


def _kinds(name: str, labels: tuple[str, ...], kinds: tuple[NDArray[np.bool_], ...]) -> _Axis:
    """Return an axis of categories, without empty ones."""
    inside = np.stack(kinds, axis=1)
    seen = np.flatnonzero(inside.any(axis=0)).tolist()
    edges = ((math.nan, math.nan),) * len(seen)
    return _Axis(name, '', tuple(labels[i] for i in seen), edges, inside[:, seen])
