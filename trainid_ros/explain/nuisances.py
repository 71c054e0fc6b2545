# SPDX-License-Identifier: Apache-2.0
"""Nuisances that are estimated beside every candidate: their columns and the standard deviations of their priors.

What all runs share are a, b, c, times and gains of the forces; each run has its own load, brake and wind, and each
place its own error of the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from trainid_ros.explain.dataset import Array, Dataset
    from trainid_ros.train.train_file import TrainFile

DAVIS: Final = slice(0, 3)
"""Indices of a, b, c among the nuisances."""
# Std of the mean headwind of a run of minutes about that of all runs [m/s]: a turbulence of a fifth of 3.5 m/s.
_WIND: Final = 0.7


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard deviations of nuisances that differ from run to run and from place to place."""

    payload: float  # Relative error of the mass of a run [1]
    brake: float  # Relative change of the brake force from run to run [1]
    map: float  # Error of the map's gradient [per mille]

    @property
    def of_run(self) -> Array:
        """Prior std of the factors of single runs, payload and brake [1], wind [m/s]; see :func:`run_columns`."""
        return np.array([self.payload, self.brake, _WIND])


@dataclass(frozen=True, slots=True)
class Bins:
    """Sections of the line of equal length."""

    low: float  # Start of the first section [m]
    width: float  # Their length [m]
    count: int  # Their number

    @classmethod
    def of(cls, dataset: Dataset, length: float, *, fine: bool = False) -> Bins:
        """Return bins over the line that a train of a length [m] has passed; half as long for effects (``fine``)."""
        position = dataset.joined('position')
        low, high = float(position.min()) - length, float(position.max()) + length
        # At least 100 m; at most 100 of them, to bound time and memory.
        width = max(100.0, (high - low) / 100) / (2.0 if fine else 1.0)
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
        return np.asarray(np.diff(np.clip(self.edges, low, high), axis=1) / length)

    def covariance(self) -> Array:
        """Return the correlation matrix of the map errors of bins, shape (count, count); its length is 200 m."""
        middle = self.edges[:-1]
        return np.asarray(np.exp(-np.abs(middle[:, None] - middle[None, :]) / 200.0))


def common_columns(dataset: Dataset, gradient_std: float) -> Array:
    """Return the resistances [N/kN per unit] of nuisances that all runs share, shape (n, 13); see :func:`common_std`.

    Gradients have a noise of ``gradient_std`` [per mille], of which the share to be expected returns to their mean.
    """
    v, traction, brake, gradient = dataset.speed, *map(dataset.joined, ('traction', 'brake', 'gradient'))
    slope = _rate(gradient, dataset) / np.maximum(v, 1.0)
    rates = _rate(traction, dataset), _rate(brake, dataset)
    gains = -traction, -brake, -(traction + brake)
    noise = gradient_std**2 / max(gradient_std**2 + float(np.mean(np.square(gradient))), 1e-9) * gradient
    # Losses between motor and wheel oppose both signs of its force; without energy fed back they are a gain.
    size = np.abs(traction)
    losses = (1.0 - abs(float(traction.sum())) / max(float(size.sum()), 1e-9)) * size
    # Applications and releases take different times, and hand-over between brakes is near the stop.
    brakes = np.abs(rates[1]), -brake * np.exp(-v / _HANDOVER)
    return np.stack((np.ones_like(v), v, v * v, *rates, slope, *gains, noise, losses, *brakes), axis=1)


_HANDOVER: Final = 3.0  # Speed below which electric brakes fade out [m/s]
# Half the difference of the times of applications and releases, as a share of dead time and lag [1]: what they have in
# common is `brake_delay`.
_UNEVEN: Final = 0.1
_LOW: Final = 0.05  # Change of the brake force toward standstill [1]: hand-over, friction of blocks and pads


def common_std(train_file: TrainFile, period: float, *, weighed: bool) -> Array:
    """Return the prior standard deviations of :func:`common_columns`, shape (13,).

    They are a, b, c; skew of traction and of brake [s]; shift of the map [m]; gains of traction, brake and mass [1];
    share of the expected noise of gradients [1]; losses of a motor that feeds back [1]; half the time by which
    applications of the brake are later than releases [s]; gain of the brake at standstill [1].

    ``period`` is the time between samples [s]: a change was at any time since the sample before. Assumed, without a
    source, are the sizes of a, b, c, of a clock (0.1 s is half a sample at 5 Hz), of the shift, and of gains, which no
    sensor states; a mass that is not weighed is off by half of `train.mass_std`, the rest differs by run.
    """
    davis, brake = train_file.resistance, train_file.brake
    sampled = period / math.sqrt(12.0)
    skews, uneven = np.hypot((0.1, 0.04), sampled), _UNEVEN * (brake.delay + brake.time_constant)
    std = 0.4 * np.abs(np.array([davis.a, davis.b, davis.c])) + np.array([0.15, 0.02, 0.0004])
    gains = 0.003, 0.004, 0.003 if weighed else 0.015
    brakes = uneven, _LOW
    return np.concatenate([std, skews, (15.0,), gains, (1.0, train_file.train.force_std), brakes])


def prior_factor(common: Array, map_root: Array, spread: Spread) -> Array:
    """Return L with L L' the prior covariance of nuisances that all runs share and of map errors.

    ``common`` is the prior std of the former (q,), ``map_root`` the Cholesky factor of the correlation of the latter
    (k, k).
    """
    q, k = len(common), len(map_root)
    factor = np.zeros((q + k, q + k))
    factor[np.arange(q), np.arange(q)] = common
    factor[q:, q:] = spread.map * map_root
    return factor


def run_columns(dataset: Dataset, c: float) -> Array:
    """Return the resistances [N/kN] that each run scales with its own factors, shape (n, 3).

    They are payload, brake and headwind; ``c`` is that of the train file [N/kN per (m/s)^2].
    """
    return np.stack((-dataset.joined('traction'), -dataset.joined('brake'), 2.0 * c * dataset.speed), axis=1)


def _rate(force: Array, dataset: Dataset) -> Array:
    """Return the rate of change of a force over each stage, per second, shape (n,)."""
    change = np.zeros_like(force)
    change[1:-1] = 0.5 * (force[2:] - force[:-2])
    change[dataset.starts] = 0.0
    change[np.append(dataset.starts[1:], force.size) - 1] = 0.0
    return np.asarray(change / np.maximum(dataset.dt, 0.05))
