# SPDX-License-Identifier: Apache-2.0
"""The line under the train: means over its length, tabulated per metre of the front's position."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from benchmarks.hidden_cases.world import Nuisance, Pairs, Route

    Array = NDArray[np.float64]

_MARGIN = 400


class Track:
    """True gradient, mapped gradient, curvature and tunnel share, averaged over the train length."""

    def __init__(self, route: Route, length: int, nuisance: Nuisance, rng: Generator) -> None:
        count = int(route.stops[-1]) + 2 * _MARGIN + 1
        place: Array = np.arange(count, dtype=np.float64) - _MARGIN + 0.5
        mapped = _steps(route.gradient, place)
        radius = _steps(route.curve, place)
        curvature = np.divide(1.0, radius, out=np.zeros_like(radius), where=radius > 0.0)
        tunnel = np.zeros(count)
        for low, high in route.tunnels:
            tunnel[(place > low) & (place < high)] = 1.0
        true = mapped + _map_error(count, nuisance, rng)
        self.length = length
        # Row k: front at k - margin metres for rising positions, rear one train length lower.
        self._table = np.column_stack([_mean_behind(of, length) for of in (true, mapped, curvature, tunnel)])
        self.rows: list[list[float]] = self._table.tolist()

    def index(self, front: float, heading: int) -> float:
        """Return the index in the table; a train with falling positions extends one length above its front."""
        return front + _MARGIN + (self.length if heading < 0 else 0)

    def under(self, front: Array, heading: Array) -> Array:
        """Return true and map gradient for rising position [per mille], curvature [1/m], tunnel share; shape (n, 4)."""
        at = front + _MARGIN + np.where(heading < 0, self.length, 0)
        low = np.clip(at.astype(int), 0, len(self.rows) - 2)
        share = (at - low)[:, None]
        means: Array = self._table[low] * (1.0 - share) + self._table[low + 1] * share
        return means


def _steps(pairs: Pairs, place: Array) -> Array:
    starts, values = np.array(pairs).T
    chosen: Array = values[np.clip(np.searchsorted(starts, place, side='right') - 1, 0, None)]
    return chosen


def _mean_behind(values: Array, length: int) -> Array:
    total = np.concatenate([[0.0], np.cumsum(values)])
    front = np.arange(len(total))
    rear = np.maximum(front - length, 0)
    mean: Array = (total[front] - total[rear]) / length
    return mean


def _map_error(count: int, nuisance: Nuisance, rng: Generator) -> Array:
    keep = math.exp(-1.0 / nuisance.map_length)
    value = nuisance.map_error * float(rng.standard_normal())
    path = np.empty(count)
    shocks = nuisance.map_error * math.sqrt(1.0 - keep * keep) * rng.standard_normal(count)
    for k, shock in enumerate(shocks.tolist()):
        path[k] = value
        value = keep * value + shock
    return path
