# SPDX-License-Identifier: Apache-2.0
"""Determine whether the gradient of a bag is the mean under the train, or the value at one point of the train.

The interface specifies the mean. Bags with the value at a point look as if the map were shifted, which disturbs the
search for effects; so both interpretations are compared before the search.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.effect_scores import reduced_information
from trainid_ros.explain.regression import log_bayes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.marginal_likelihood import Hyperparameters
    from trainid_ros.explain.model import Model
    from trainid_ros.explain.run_data import Run

    Array = NDArray[np.float64]

POINTS: Final = {'front': 0.0, 'middle': 0.5, 'rear': 1.0}
"""Points of the train and their distance behind its front, as a share of its length."""
_MIN_EVIDENCE: Final = 15.0
"""2 ln of the Bayes factor required for the value at a point."""
_SHARES: Final = (0.5, 1.5)
"""Limits of the estimated share of the change from the mean to the value at a point."""
_CELL_M: Final = 5.0
"""Length of a cell of the gradient profile [m]."""
_PLACES: Final = 24
"""Points under the train over which the gradient is averaged."""


def read_at(point: str, runs: Sequence[Run], length: float) -> tuple[Run, ...]:
    """Return runs with the gradient, given at one of :data:`POINTS`, averaged under the train.

    The gradient ahead of and behind the point is taken from all runs in the same direction.

    Args:
        point: Point of the train at which the gradient is given.
        runs: The runs.
        length: Length of the train [m].

    """
    profiles = {way: _Profile([run for run in runs if run.direction == way]) for way in {r.direction for r in runs}}
    behind = length * ((np.arange(_PLACES) + 0.5) / _PLACES - POINTS[point])
    return tuple(replace(run, gradient=profiles[run.direction].mean(run, behind)) for run in runs)


def preferred_point(model: Model, hyper: Hyperparameters, shift: float) -> str | None:
    """Return the point at which gradients are given, if the data support it more than a shift of the map; else None.

    Args:
        model: Model without effects.
        hyper: Hyperparameters estimated with it.
        shift: Evidence of a shifted map, 2 ln of its Bayes factor.

    """
    dataset, length = model.dataset, model.train_file.train.length
    given = dataset.joined('gradient')
    changes = [
        np.concatenate([run.gradient for run in read_at(point, dataset.runs, length)]) - given for point in POINTS
    ]
    found = reduced_information(model, hyper, dataset.column(np.stack(changes, axis=1)))
    A, b = np.diag(found.A), found.b
    share, evidence = b / (A + 1.0), log_bayes(A, b, 1.0, 1)
    best = int(np.argmax(evidence))
    if evidence[best] > max(_MIN_EVIDENCE, shift) and _SHARES[0] < share[best] < _SHARES[1]:
        return tuple(POINTS)[best]
    return None


class _Profile:
    """Gradient [per mille] by position in one direction [m], mean of all runs in each cell."""

    def __init__(self, runs: Sequence[Run]) -> None:
        way = np.concatenate([_middles(run) for run in runs])
        gradient = np.concatenate([run.gradient for run in runs])
        cells, index = np.unique(np.floor(way / _CELL_M), return_inverse=True)
        self._way = (cells + 0.5) * _CELL_M
        self._gradient = np.bincount(index, gradient) / np.bincount(index)

    def mean(self, run: Run, behind: Array) -> Array:
        """Return the mean over points at given distances behind the front [m] on each stage, shapes (k,) to (n,)."""
        places = _middles(run)[:, None] - behind
        return np.asarray(np.interp(places, self._way, self._gradient).mean(axis=1))


def _middles(run: Run) -> Array:
    """Return the position of the front at mid-stage, rising in the direction of travel [m], shape (n,)."""
    return np.asarray(run.direction * run.position - 0.5 * run.dt * run.speed)
