# SPDX-License-Identifier: Apache-2.0
"""Estimate the hyperparameters of noise and nuisances by maximum marginal likelihood times a prior.

Hyperparameters that are wrong by a half lead to false effects; so they are estimated from the data, and again whenever
an effect is added to the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.noise import Grid, Noise, Whitener
from trainid_ros.explain.nuisances import Spread, prior_factor
from trainid_ros.explain.regression import Gram, eliminate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

# Median and std of the log of each hyperparameter: speed noise [m/s], gust [N/kN], gust time [s], jitter [s],
# payload [1], brake [1], map [per mille].
_WEIGHED: Final = 0.005
_UNWEIGHED: Final = 0.03
_MEDIAN: Final = np.log([0.03, 0.12, 8.0, 0.02, _WEIGHED, 0.01, 0.25])
_WIDTH: Final = np.array([1.0, 0.5, 0.4, 0.7, 0.5, 0.5, 0.4])
_STEP: Final = 0.05
_SMALL: Final = 1e-3
_LARGEST_MOVE: Final = 2.0
_SETTLED: Final = 0.05
_MAX_STEPS: Final = 30
_OUTER: Final = 4
_PAYLOAD: Final = 4
_GUST, _GUST_TIME = 1, 2


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """Standard deviations of noise and nuisances.

    Attributes:
        noise: Those of noise along a run.
        spread: Those of nuisances by run and by place.
        evidence: 2 ln of marginal likelihood times prior at these values, up to a constant.

    """

    noise: Noise
    spread: Spread
    evidence: float


class MarginalLikelihood:
    """Marginal likelihood of the data as a function of the logs of all hyperparameters."""

    def __init__(
        self, grid: Grid, columns: Array, factors: Array, common_std: Array, map_root: Array, *, weighed: bool
    ) -> None:
        """Prepare the evaluation.

        Args:
            grid: Grid of the nodes.
            columns: y [m/s], common nuisances, bins of the map, shape (m, 1 + q + k).
            factors: Columns of payload and brake, shape (m, 2).
            common_std: Prior std of the common nuisances, shape (q,).
            map_root: Cholesky factor of the correlation of map errors, shape (k, k).
            weighed: True if the mass is measured.

        """
        self._grid, self._factors = grid, factors.shape[1]
        self._spread = grid.spread(np.concatenate([columns, factors], axis=1))
        self._common = common_std
        self._root = map_root
        self._median = _MEDIAN.copy()
        self._median[_PAYLOAD] = math.log(_WEIGHED if weighed else _UNWEIGHED)
        self._gram: tuple[tuple[float, ...], Gram, float] | None = None

    def at(self, logs: Array) -> float:
        """Return 2 ln of likelihood times prior at the logs of all hyperparameters, shape (7,)."""
        return -self._value(logs)

    def usual(self, hyper: Hyperparameters) -> Hyperparameters:
        """Return hyperparameters with payload, brake and map at the median of their priors."""
        return replace(hyper, spread=_hyperparameters(self._median)[1])

    def excess(self, logs: Array) -> float:
        """Return how far gusts, payload, brake and map errors lie above the medians of their priors [1].

        That is the sum of squares of their distances in standard deviations of their priors. For gusts it is the
        distance of the speed error they cause, proportional to their std times the root of their correlation time.
        """
        above = logs - self._median
        drift = (above[_GUST] + 0.5 * above[_GUST_TIME]) / math.hypot(_WIDTH[_GUST], 0.5 * _WIDTH[_GUST_TIME])
        distances = np.maximum([drift, *(above / _WIDTH)[_OUTER:]], 0.0)
        return float(distances @ distances)

    def maximise(self, start: Array | None = None) -> tuple[Hyperparameters, Array]:
        """Return the best hyperparameters and their logs, starting from the prior's median or a better given start."""
        x, value = self._median.copy(), self._value(self._median)
        # Hyperparameters estimated without an effect can be far off with it.
        if start is not None and (there := self._value(start)) < value:
            x, value = start.copy(), there
        gradient, curvature = self._slopes(x, value)
        for _ in range(_MAX_STEPS):
            move = -np.linalg.solve(curvature, gradient)
            move *= min(1.0, _LARGEST_MOVE / float(np.abs(move).max()))
            while (found := self._value(x + move)) > value + 1e-6 and np.abs(move).max() > _SETTLED:
                move = 0.4 * move
            if found > value - _SETTLED:
                x, value = (x + move, found) if found < value else (x, value)
                break
            x, value, before = x + move, found, gradient
            gradient = self._gradient(x, value)
            curvature = _updated(curvature, np.asarray(move), gradient - before)
        return Hyperparameters(*_hyperparameters(x), -value), x

    def _slopes(self, x: Array, value: float) -> tuple[Array, Array]:
        """Return gradient and initial curvature, diagonal and positive, by central differences."""
        gradient, curvature = np.empty_like(x), np.empty_like(x)
        # Payload, brake and map first: they need no new filter, while noise, gusts and jitter do.
        for i, step in reversed([*enumerate(_STEP * np.eye(x.size))]):
            up, down = self._value(x + step), self._value(x - step)
            gradient[i] = (up - down) / (2.0 * _STEP)
            curvature[i] = max((up - 2.0 * value + down) / _STEP**2, 1.0 / _WIDTH[i] ** 2)
        return gradient, np.diag(curvature)

    def _gradient(self, x: Array, value: float) -> Array:
        """Return the gradient by forward differences, shape (7,)."""
        # Same order as in _slopes, to reuse the filter.
        up = [self._value(x + step) for step in _SMALL * np.eye(x.size)[::-1]]
        return np.asarray((np.array(up[::-1]) - value) / _SMALL)

    def _value(self, x: Array) -> float:
        """Return -2 ln of likelihood times prior."""
        noise, spread = _hyperparameters(x)
        key = tuple(x[:_OUTER].tolist())
        if self._gram is None or self._gram[0] != key:
            whitener = Whitener.of(self._grid, noise)
            gram = Gram.of(self._spread, self._factors, whitener)
            self._gram = (key, gram, float(whitener.log_det.sum()))
        _, gram, log_det = self._gram
        products, cost = gram.reduced(spread.of_run)
        factor = prior_factor(self._common, self._root, spread)
        information = eliminate(products, len(factor), factor)
        prior = float(np.sum(np.square((x - self._median) / _WIDTH)))
        return information.yy + log_det + cost + information.log_det + prior


def _updated(curvature: Array, move: Array, change: Array) -> Array:
    """Return the BFGS update of the curvature (7, 7) for a step ``move`` that changed the gradient by ``change``."""
    along = float(move @ change)
    seen = curvature @ move
    if along <= 1e-3 * float(move @ seen):
        return curvature
    return np.asarray(curvature + np.outer(change, change) / along - np.outer(seen, seen) / float(move @ seen))


def _hyperparameters(x: Array) -> tuple[Noise, Spread]:
    speed, gust, gust_time, jitter, payload, brake, line = np.exp(x).tolist()
    return Noise(speed, gust, gust_time, jitter), Spread(payload, brake, line)
