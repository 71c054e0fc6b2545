# SPDX-License-Identifier: Apache-2.0
"""Noise and nuisances of the speed gap: what simulated and measured speed differ by although the model is correct.

Noise is gusts, a random resistance modelled as an Ornstein-Uhlenbeck process whose response is its integral; noise of
the measured speed; and the unknown initial speed. A Kalman filter on the state [speed error, gust] turns them into
independent unit noise. It is linear, so the columns of all candidates pass through it with the same gains.

Nuisances are estimated together with every candidate: base Davis, payload, brakes, clocks and map errors. If the base
model were fixed, its own errors would be named as effects. Each nuisance is a column with a Gaussian prior; standard
deviations that the data determine (payload, brake, map) are hyperparameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.linalg import cholesky_banded

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

_DIFFUSE: Final = 1e2
"""Variance of an unknown initial speed error [(m/s)^2]."""
_MIN_VARIANCE: Final = 1e-12
"""Minimum process noise of a step [(m/s)^2, (N/kN)^2], which keeps the information matrix finite."""
# Share of the variance that neighbouring samples have in common: quantised speeds repeat.
_SHARED: Final = 0.1


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of the noise along a run.

    Attributes:
        speed: Noise of one measured speed [m/s].
        gust: Standard deviation of gusts [N/kN].
        gust_time: Correlation time of gusts [s].
        jitter: Random delay of each change of traction or brake [s], since forces are sampled a few times a second.

    """

    speed: float
    gust: float
    gust_time: float
    jitter: float


@dataclass(frozen=True, slots=True)
class Grid:
    """Nodes of all runs side by side, padded to the longest; N nodes by R runs.

    Attributes:
        index: Index of the node, equal to ``nodes`` for padding, shape (N, R).
        dt: Time since the previous node [s], shape (N, R).
        share: Noise variance of a node relative to that of one speed [1]; infinite without a measurement, shape (N, R).
        change: Change of the force since the previous node, as acceleration [m/s^2], shape (N, R).
        inertia: Specific force per acceleration [N/kN per m/s^2].
        nodes: Number of nodes of all runs.

    """

    index: NDArray[np.intp]
    dt: Array
    share: Array
    change: Array
    inertia: float
    nodes: int

    @classmethod
    def of(cls, dataset: Dataset) -> Grid:
        """Return the grid of a dataset."""
        counts = np.unique(dataset.node_run, return_counts=True)[1]
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        rows = np.arange(counts.max())[:, None]
        inside = rows < counts[None, :]
        index = np.where(inside, first[None, :] + rows, dataset.node_time.size).astype(np.intp)
        time = np.append(dataset.node_time, 0.0)[index]
        dt = np.zeros(index.shape)
        dt[1:] = np.where(inside[1:], time[1:] - time[:-1], 1.0)
        count = np.append(dataset.node_count, 0.0)[index]
        share = np.where(count > 0.0, share_of_mean(count), np.inf)
        force = dataset.joined('traction') + dataset.joined('brake')
        first_force = np.append(force[dataset.node_starts], 0.0)[index]
        change = np.zeros(index.shape)
        change[1:] = np.where(inside[1:], np.abs(first_force[1:] - first_force[:-1]) / dataset.inertia, 0.0)
        return cls(index, dt, share, change, dataset.inertia, dataset.node_time.size)

    def part(self, runs: slice) -> Grid:
        """Return the grid of some of the runs."""
        longest = int((self.index[:, runs] < self.nodes).sum(axis=0).max())
        dt, share, change = (array[:longest, runs] for array in (self.dt, self.share, self.change))
        return Grid(self.index[:longest, runs], dt, share, change, self.inertia, self.nodes)

    def spread(self, columns: Array) -> Array:
        """Return columns of all nodes, shape (m, C), on the grid, shape (N, R, C)."""
        padded = np.concatenate([columns, np.zeros((1, columns.shape[1]))])
        return np.asarray(padded[self.index])


@dataclass(frozen=True, slots=True)
class Whitener:
    """Gains of the whitening Kalman filter; see :meth:`apply`.

    Attributes:
        step: Matrix from [predicted state, measurement] to the predicted state at the next node, shape (N, R, 2, 3).
        scale: Inverse standard deviation of the innovation [s/m], 0 without a measurement, shape (N, R).
        log_det: Sum of the log of the innovation variance over all measurements of a run, shape (R,).

    """

    step: Array
    scale: Array
    log_det: Array

    @classmethod
    def of(cls, grid: Grid, noise: Noise) -> Whitener:
        """Compute all gains at once; padding after the last node of a run has no weight."""
        inside = grid.index < grid.nodes
        F, Q = _transitions(grid, noise)
        R = np.where(inside, noise.speed**2 * grid.share, np.inf)
        before = Q.copy()
        before[1:] += F[1:] @ _filtered(F, Q, R)[:-1] @ F[1:].transpose(0, 1, 3, 2)
        S = before[..., 0, 0] + R
        K = before[..., :, :1] / S[..., None, None]
        update = np.concatenate([np.eye(2) - K * np.array([1.0, 0.0]), K], axis=-1)
        step = np.zeros_like(update)
        step[:-1] = F[1:] @ update[:-1]
        return cls(step, 1.0 / np.sqrt(S), np.log(np.where(np.isfinite(S), S, 1.0)).sum(axis=0))

    def part(self, runs: slice) -> Whitener:
        """Return the filter of some of the runs."""
        return Whitener(self.step[:, runs], self.scale[:, runs], self.log_det[runs])

    def apply(self, columns: Array) -> Array:
        """Return whitened columns of the first N nodes, shape (N, R, C); zero without a measurement."""
        N, runs, C = columns.shape
        # The measurement is appended to the predicted state, so that a step is one matrix product. Two states take
        # turns: those of all nodes would not fit the cache.
        states, white = np.zeros((2, runs, 3, C)), np.empty_like(columns)
        for i in range(N):
            now, after = states[i % 2], states[1 - i % 2]
            now[:, 2] = columns[i]
            np.subtract(columns[i], now[:, 0], out=white[i])
            np.matmul(self.step[i], now, out=after[:, :2])
        white *= self.scale[:N, :, None]
        return white


def share_of_mean(count: Array) -> Array:
    """Return the variance of the mean of ``count`` neighbouring speeds relative to that of one [1], same shape."""
    return np.asarray(_SHARED + (1.0 - _SHARED) / np.maximum(count, 1.0))


def _transitions(grid: Grid, noise: Noise) -> tuple[Array, Array]:
    """Return transition and noise covariance of [speed error, gust] to each node, both of shape (N, R, 2, 2).

    At the first node Q is the prior covariance and F is zero.
    """
    dt, inertia = grid.dt, grid.inertia
    tau, variance = noise.gust_time, noise.gust**2
    e = np.exp(-dt / tau)
    F, Q = np.zeros((2, *dt.shape, 2, 2))
    F[1:, :, 0, 0] = 1.0
    F[1:, :, 0, 1] = (tau * (1.0 - e) / inertia)[1:]
    F[1:, :, 1, 1] = e[1:]
    # Exact discretisation of the gust and its integral, plus the impulse caused by a delayed change of the force.
    Q[..., 0, 0] = variance * (tau / inertia) ** 2 * np.maximum(2.0 * dt / tau - 3.0 + 4.0 * e - e * e, 0.0)
    Q[..., 0, 0] += np.square(noise.jitter * grid.change)
    Q[..., 0, 1] = Q[..., 1, 0] = variance * tau * (1.0 - e) ** 2 / inertia
    Q[..., 1, 1] = variance * (1.0 - e * e)
    Q[0] = np.diag([_DIFFUSE, variance])
    Q[..., (0, 1), (0, 1)] += _MIN_VARIANCE
    return F, Q


def _filtered(F: Array, Q: Array, R: Array) -> Array:
    """Return the covariance of the state after each measurement, shape (N, R, 2, 2).

    The information matrix of all states of a run is block-tridiagonal, and its Cholesky factorisation is equivalent to
    the forward recursion of a Kalman filter: the remaining diagonal block is the information of all measurements so
    far plus that of the transition to the next node.
    """
    N, runs = R.shape
    information = _inverse(Q)
    across = -information @ F
    onward = np.zeros_like(Q)
    onward[:-1] = -F[1:].transpose(0, 1, 3, 2) @ across[1:]
    diagonal = information + onward
    diagonal[..., 0, 0] += 1.0 / R
    # Lower band of one run after another; states of different runs are independent.
    band = np.zeros((runs, N, 2, 4))
    d, o = diagonal.transpose(1, 0, 2, 3), across.transpose(1, 0, 2, 3)
    band[..., 0, 0], band[..., 0, 1], band[..., 1, 0] = d[..., 0, 0], d[..., 1, 0], d[..., 1, 1]
    band[:, :-1, 0, 2], band[:, :-1, 0, 3] = o[:, 1:, 0, 0], o[:, 1:, 1, 0]
    band[:, :-1, 1, 1], band[:, :-1, 1, 2] = o[:, 1:, 0, 1], o[:, 1:, 1, 1]
    root = cholesky_banded(band.reshape(-1, 4).T, lower=True, check_finite=False).T.reshape(runs, N, 2, 4)
    L = np.zeros((N, runs, 2, 2))
    L[..., 0, 0], L[..., 1, 0], L[..., 1, 1] = root[..., 0, 0].T, root[..., 0, 1].T, root[..., 1, 0].T
    return _inverse(L @ L.transpose(0, 1, 3, 2) - onward)


def _inverse(A: Array) -> Array:
    """Return the inverses of symmetric matrices, shape (..., 2, 2)."""
    adjoint = np.stack([A[..., 1, 1], -A[..., 0, 1], -A[..., 1, 0], A[..., 0, 0]], axis=-1).reshape(A.shape)
    determinant = A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0]
    return np.asarray(adjoint / determinant[..., None, None])


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
