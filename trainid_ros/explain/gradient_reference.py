# SPDX-License-Identifier: Apache-2.0
"""How the gradient of a bag is to be read: as the train feels it, or as it is at one point of the train.

The interface wants the former. Bags with the latter look as if the map were shifted, and everything that is looked
for beside it suffers; so the readings are compared before anything else is.
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
"""Points of the train and how far they lie behind its front, in its length."""
_CERTAIN: Final = 15.0
"""2 ln of the Bayes factor that another reading needs."""
_WHOLE: Final = (0.5, 1.5)
"""So much of the change from one reading to the other must be there."""
_CELL_M: Final = 5.0
_PLACES: Final = 24


def read_at(point: str, runs: Sequence[Run], length: float) -> tuple[Run, ...]:
    """Return runs whose gradient, known at one of :data:`POINTS`, is averaged under a train of some length [m].

    What lies before and behind the point is known from all runs in the same direction.
    """
    profiles = {way: _Profile([run for run in runs if run.direction == way]) for way in {r.direction for r in runs}}
    behind = length * ((np.arange(_PLACES) + 0.5) / _PLACES - POINTS[point])
    return tuple(replace(run, gradient=profiles[run.direction].mean(run, behind)) for run in runs)


def preferred_point(model: Model, hyper: Hyperparameters, shift: float) -> str | None:
    """Return where gradients are known if the data call for one point more than for a shift of the map.

    Args:
        model: Model without effects.
        hyper: Sizes of noise and nuisances found with it.
        shift: Evidence of a shifted map.

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
    if evidence[best] > max(_CERTAIN, shift) and _WHOLE[0] < share[best] < _WHOLE[1]:
        return tuple(POINTS)[best]
    return None


class _Profile:
    """Gradient by the way travelled in one direction [m], mean of all runs in each cell."""

    def __init__(self, runs: Sequence[Run]) -> None:
        way = np.concatenate([_middles(run) for run in runs])
        gradient = np.concatenate([run.gradient for run in runs])
        cells, index = np.unique(np.floor(way / _CELL_M), return_inverse=True)
        self._way = (cells + 0.5) * _CELL_M
        self._gradient = np.bincount(index, gradient) / np.bincount(index)

    def mean(self, run: Run, behind: Array) -> Array:
        """Return the mean over some places behind the front [m] on each stage, shapes (k,) to (n,)."""
        places = _middles(run)[:, None] - behind
        return np.asarray(np.interp(places, self._way, self._gradient).mean(axis=1))


def _middles(run: Run) -> Array:
    """Return where the front is in the middle of each stage, rising in the direction of travel [m], shape (n,)."""
    return np.asarray(run.direction * run.position - 0.5 * run.dt * run.speed)
