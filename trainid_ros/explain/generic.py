# SPDX-License-Identifier: Apache-2.0
"""Generic dependences of the gap: groups of columns without a physical name that compete with the named effects.

If such a group explains far more than any effect of the library, no named effect fits. The residual after the named
effects is described by the group that explains most of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.nuisances import Bins
from trainid_ros.explain.run_data import BRAKING, PULLING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset

    Array = NDArray[np.float64]

_KNOTS: Final = 5
"""Knots of a piecewise-linear dependence."""
_MAX_RUNS: Final = 60
"""With more runs than this, the dependence on the run is replaced by one on time."""


@dataclass(frozen=True, slots=True)
class Group:
    """Columns of one dependence, with coefficients in N/kN.

    Attributes:
        name: Short name.
        text: What the resistance depends on, as text.
        resistance: Resistance per unit of each coefficient [1], shape (n, k).

    """

    name: str
    text: str
    resistance: Array


def generic_groups(dataset: Dataset, length: float) -> tuple[Group, ...]:
    """Return all groups for a dataset and the length of the train [m]."""
    v, traction, brake = dataset.speed, dataset.joined('traction'), dataset.joined('brake')
    pulling, braking = traction > PULLING, brake < BRAKING
    coasting = ~pulling & ~braking
    direction = dataset.direction.astype(float)[:, None]
    tunnel, radius = dataset.joined('tunnel'), dataset.joined('radius')
    curvature = np.where(radius > 0.0, 300.0 / np.maximum(radius, 100.0), 0.0)
    since = dataset.time - dataset.time[dataset.starts][dataset.run_of]
    # Acceleration implied by the forces: the measured one would bring the noise of the speed into the regressors.
    acceleration = traction + brake - dataset.joined('gradient') - 2.0
    relative = v / max(float(v.max()), 1.0)
    heat = dataset.joined('heat')
    heat = heat / max(float(heat.max()), 1.0)
    powers = np.stack((np.ones_like(v), relative, relative**2), axis=1)
    heats = np.stack((heat, heat**2, heat * relative), axis=1)
    modes = np.stack((pulling, braking), axis=1)
    places = (
        (Group('place', 'the place', Bins.of(dataset, length).shares(dataset, length)),) if dataset.positioned else ()
    )
    return (
        Group('run', 'the run', _runs(dataset)),
        *places,
        Group('time', 'the time', _hats(dataset.time, 6)),
        Group('start', 'the time since departure', _hats(np.minimum(since, 120.0), 7)),
        Group('speed', 'the speed', _hats(v, 7)),
        Group('traction-speed', 'the speed in traction', _hats(v, _KNOTS) * pulling[:, None]),
        Group('coast-speed', 'the speed while coasting', _hats(v, _KNOTS) * coasting[:, None]),
        Group('traction', 'the tractive force', _hats(np.maximum(traction, 0.0), _KNOTS) * pulling[:, None]),
        Group('brake-speed', 'the speed while braking', _hats(v, _KNOTS) * brake[:, None] / 30.0),
        Group('brake', 'the braking force', _hats(brake, _KNOTS) * braking[:, None]),
        Group('brake-heat', 'the heat of the brake', heats * brake[:, None] / 30.0),
        Group('direction', 'the direction', direction * powers),
        Group('inertia', 'the acceleration', np.stack((acceleration, np.abs(acceleration)), axis=1) / 50.0),
        Group('tunnel', 'the tunnel', tunnel[:, None] * powers),
        Group('curve', 'curves', np.stack((curvature, curvature**2, curvature * relative**2), axis=1)),
        Group('gradient', 'the gradient', _gradient(dataset)),
        Group('mode-direction', 'the direction and the driving mode', direction * modes),
    )


def _runs(dataset: Dataset) -> Array:
    """Return a column for each run, or functions of time if there are many runs, shape (n, k)."""
    if len(dataset.runs) > _MAX_RUNS:
        return _hats(dataset.time, _MAX_RUNS)
    return np.asarray(dataset.run_of[:, None] == np.arange(len(dataset.runs)), dtype=float)


def _gradient(dataset: Dataset) -> Array:
    i = dataset.joined('gradient') / 10.0
    return np.stack((i, np.abs(i)), axis=1)


def _hats(x: Array, count: int) -> Array:
    """Return piecewise-linear hat functions with knots at quantiles, which sum to one; shape (n, up to count)."""
    knots = np.unique(np.quantile(x, np.linspace(0.0, 1.0, count)))
    if knots.size < 2:
        return np.ones((x.size, 1))
    columns = [np.interp(x, knots, np.eye(knots.size)[i]) for i in range(knots.size)]
    return np.stack(columns, axis=1)
