# SPDX-License-Identifier: Apache-2.0
"""Nuisances estimated together with every candidate: base Davis, payload, brakes, clocks and map errors.

If the base model were fixed, its own errors would be named as effects. Each nuisance is a column with a Gaussian prior;
standard deviations that the data determine (payload, brake, map) are hyperparameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

_MAX_BINS: Final = 100
_MIN_BIN_M: Final = 100.0
# Effects on sections are searched on a finer scale than map errors, which are smooth.
_FINER: Final = 2.0
_MAP_LENGTH_M: Final = 200.0
"""Correlation length of map errors [m]."""
# Prior std of a, b, c: share of the train file's value plus a minimum in their units.
_DAVIS_SHARE: Final = 0.4
_DAVIS_FLOOR: Final = np.array([0.15, 0.02, 0.0004])
_TRACTION_SKEW_S: Final = 0.1
_BRAKE_SKEW_S: Final = 0.04
_TRACTION_GAIN: Final = 0.003
_BRAKE_GAIN: Final = 0.004
_MAP_SHIFT_M: Final = 15.0
_MASS_WEIGHED: Final = 0.003
_MASS_UNWEIGHED: Final = 0.015
DAVIS: Final = slice(0, 3)
"""Indices of a, b, c among the nuisances."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard deviations of nuisances that differ from run to run and from place to place.

    Attributes:
        payload: Relative error of the mass of a run [1].
        brake: Relative change of the brake force from run to run [1].
        map: Error of the map's gradient [per mille].

    """

    payload: float
    brake: float
    map: float

    @property
    def of_run(self) -> Array:
        """Prior std of the factors of single runs, payload and brake [1]; see :func:`run_columns`."""
        return np.array([self.payload, self.brake])


@dataclass(frozen=True, slots=True)
class Bins:
    """Sections of the line of equal length.

    Attributes:
        low: Start of the first section [m].
        width: Their length [m].
        count: Their number.

    """

    low: float
    width: float
    count: int

    @classmethod
    def of(cls, dataset: Dataset, length: float, *, fine: bool = False) -> Bins:
        """Return bins over the line that a train of the given length [m] has passed."""
        position = dataset.joined('position')
        low, high = float(position.min()) - length, float(position.max()) + length
        width = max(_MIN_BIN_M, (high - low) / _MAX_BINS) / (_FINER if fine else 1.0)
        return cls(low, width, math.ceil((high - low) / width))

    @property
    def edges(self) -> Array:
        """Positions of the edges [m], shape (count + 1,)."""
        return np.asarray(self.low + self.width * np.arange(self.count + 1))

    def shares(self, dataset: Dataset, length: float) -> Array:
        """Return the share of the train's length [m] on each bin [1], shape (n, count)."""
        front = dataset.joined('position')
        rear = front - dataset.direction * length
        low, high = np.minimum(front, rear)[:, None], np.maximum(front, rear)[:, None]
        edges = self.edges
        inside = np.minimum(high, edges[None, 1:]) - np.maximum(low, edges[None, :-1])
        return np.asarray(np.maximum(inside, 0.0) / length)

    def covariance(self) -> Array:
        """Return the correlation matrix of the map errors of bins, shape (count, count)."""
        middle = self.edges[:-1]
        return np.asarray(np.exp(-np.abs(middle[:, None] - middle[None, :]) / _MAP_LENGTH_M))


def common_columns(dataset: Dataset) -> Array:
    """Return the resistances [N/kN per unit] of nuisances that all runs share, shape (n, 9); see :func:`common_std`."""
    v, traction, brake = dataset.speed, dataset.joined('traction'), dataset.joined('brake')
    slope = _rate(dataset.joined('gradient'), dataset) / np.maximum(v, 1.0)
    rates = _rate(traction, dataset), _rate(brake, dataset)
    gains = -traction, -brake, -(traction + brake)
    return np.stack((np.ones_like(v), v, v * v, *rates, slope, *gains), axis=1)


def common_std(train_file: TrainFile, *, weighed: bool) -> Array:
    """Return the prior standard deviations of :func:`common_columns`, shape (9,).

    They are a, b, c; skew of traction and of brake [s]; shift of the map [m]; gains of traction, brake and mass [1].
    """
    davis = train_file.resistance
    magnitude = np.abs(np.array([davis.a, davis.b, davis.c]))
    mass = _MASS_WEIGHED if weighed else _MASS_UNWEIGHED
    others = (_TRACTION_SKEW_S, _BRAKE_SKEW_S, _MAP_SHIFT_M, _TRACTION_GAIN, _BRAKE_GAIN, mass)
    return np.concatenate([_DAVIS_SHARE * magnitude + _DAVIS_FLOOR, others])


def prior_factor(common: Array, map_root: Array, spread: Spread) -> Array:
    """Return L with L L' the prior covariance of nuisances that all runs share and of map errors.

    Args:
        common: Prior std of the former, shape (q,).
        map_root: Cholesky factor of the correlation of the latter, shape (k, k).
        spread: Standard deviations, of which that of the map is used.

    """
    q, k = len(common), len(map_root)
    factor = np.zeros((q + k, q + k))
    factor[np.arange(q), np.arange(q)] = common
    factor[q:, q:] = spread.map * map_root
    return factor


def run_columns(dataset: Dataset) -> Array:
    """Return the resistances [N/kN] that each run scales with its own factors, payload and brake, shape (n, 2)."""
    return np.stack((-dataset.joined('traction'), -dataset.joined('brake')), axis=1)


def _rate(force: Array, dataset: Dataset) -> Array:
    """Return the rate of change of a force over each stage, per second, shape (n,)."""
    change = np.zeros_like(force)
    change[1:-1] = 0.5 * (force[2:] - force[:-2])
    change[dataset.starts] = 0.0
    change[np.append(dataset.starts[1:], force.size) - 1] = 0.0
    return np.asarray(change / np.maximum(dataset.dt, 0.05))
