# SPDX-License-Identifier: Apache-2.0
"""What is always estimated together with any candidate: base Davis, payload, brakes, clocks and the map's errors.

A base that stands still has its own errors named as effects. Each nuisance is a column with a Gaussian prior; sizes
that the data tell (payload, brake, map) are hyperparameters.
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

_MOST_BINS: Final = 100
_LEAST_BIN_M: Final = 100.0
# Stretches are looked for on a finer scale than errors of the map, which are smooth.
_FINER: Final = 2.0
_MAP_LENGTH_M: Final = 200.0
"""Correlation length of map errors [m]."""
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
"""Where a, b, c stand among the nuisances."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Sizes of what differs from run to run and from place to place.

    Attributes:
        payload: Relative error of the mass of a run.
        brake: Relative change of the brake from run to run.
        map: Error of the map's gradient [per mille].

    """

    payload: float
    brake: float
    map: float

    @property
    def of_run(self) -> Array:
        """Prior std of the factors of single runs, payload and brake; see :func:`run_columns`."""
        return np.array([self.payload, self.brake])


@dataclass(frozen=True, slots=True)
class Bins:
    """Stretches of the line of equal length.

    Attributes:
        low: Where the first one begins [m].
        width: Their length [m].
        count: Their number.

    """

    low: float
    width: float
    count: int

    @classmethod
    def of(cls, dataset: Dataset, length: float, *, fine: bool = False) -> Bins:
        """Return bins over all that the train, of some length [m], has passed."""
        position = dataset.joined('position')
        low, high = float(position.min()) - length, float(position.max()) + length
        width = max(_LEAST_BIN_M, (high - low) / _MOST_BINS) / (_FINER if fine else 1.0)
        return cls(low, width, math.ceil((high - low) / width))

    @property
    def edges(self) -> Array:
        """Where they begin and end [m], shape (count + 1,)."""
        return np.asarray(self.low + self.width * np.arange(self.count + 1))

    def shares(self, dataset: Dataset, length: float) -> Array:
        """Return how much of the train is on each bin, shape (n, count)."""
        front = dataset.joined('position')
        rear = front - dataset.direction * length
        low, high = np.minimum(front, rear)[:, None], np.maximum(front, rear)[:, None]
        edges = self.edges
        inside = np.minimum(high, edges[None, 1:]) - np.maximum(low, edges[None, :-1])
        return np.asarray(np.maximum(inside, 0.0) / length)

    def covariance(self) -> Array:
        """Return the correlation of map errors of bins, shape (count, count)."""
        middle = self.edges[:-1]
        return np.asarray(np.exp(-np.abs(middle[:, None] - middle[None, :]) / _MAP_LENGTH_M))


def common_columns(dataset: Dataset) -> Array:
    """Return resistances of the nuisances that all runs share, shape (n, 9); see :func:`common_std`."""
    v, traction, brake = dataset.speed, dataset.joined('traction'), dataset.joined('brake')
    slope = _rate(dataset.joined('gradient'), dataset) / np.maximum(v, 1.0)
    rates = _rate(traction, dataset), _rate(brake, dataset)
    gains = -traction, -brake, -(traction + brake)
    return np.stack((np.ones_like(v), v, v * v, *rates, slope, *gains), axis=1)


def common_std(train_file: TrainFile, *, weighed: bool) -> Array:
    """Return the prior standard deviations of :func:`common_columns`, shape (9,).

    They are a, b, c; skew of traction and brake [s]; shift of the map [m]; gains of traction, brake and mass.
    """
    davis = train_file.resistance
    believed = np.abs(np.array([davis.a, davis.b, davis.c]))
    mass = _MASS_WEIGHED if weighed else _MASS_UNWEIGHED
    others = (_TRACTION_SKEW_S, _BRAKE_SKEW_S, _MAP_SHIFT_M, _TRACTION_GAIN, _BRAKE_GAIN, mass)
    return np.concatenate([_DAVIS_SHARE * believed + _DAVIS_FLOOR, others])


def prior_factor(common: Array, map_root: Array, spread: Spread) -> Array:
    """Return L with L L' the prior covariance of nuisances that all runs share and errors of the map.

    Args:
        common: Prior std of the former, shape (q,).
        map_root: Factor of the correlation of the latter, shape (k, k).
        spread: Sizes.

    """
    q, k = len(common), len(map_root)
    factor = np.zeros((q + k, q + k))
    factor[np.arange(q), np.arange(q)] = common
    factor[q:, q:] = spread.map * map_root
    return factor


def run_columns(dataset: Dataset) -> Array:
    """Return resistances that each run has a factor of its own for, payload and brake, shape (n, 2)."""
    return np.stack((-dataset.joined('traction'), -dataset.joined('brake')), axis=1)


def _rate(force: Array, dataset: Dataset) -> Array:
    """Return the rate of change of a force over each stage, per second."""
    change = np.zeros_like(force)
    change[1:-1] = 0.5 * (force[2:] - force[:-2])
    change[dataset.starts] = 0.0
    change[np.append(dataset.starts[1:], force.size) - 1] = 0.0
    return np.asarray(change / np.maximum(dataset.dt, 0.05))
