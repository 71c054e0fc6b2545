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
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.linalg import cholesky_banded

if TYPE_CHECKING:
    from trainid_ros.explain.dataset import Array, Dataset, Flags, Indices
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of the noise along a run."""

    speed: float  # Noise of one measured speed [m/s]
    gust: float  # Standard deviation of gusts [N/kN]
    gust_time: float  # Correlation time of gusts [s]
    jitter: float  # Random delay of each change of traction or brake [s], since forces are sampled a few times a second


@dataclass(frozen=True, slots=True)
class Grid:
    """Grid points of all runs side by side, longest run first, padded to its length; N grid points by R runs."""

    edges: tuple[int, ...]  # First grid point of each run in the dataset, and the number of grid points, shape (R + 1,)
    inside: Flags  # True for grid points, False for padding, shape (N, R)
    order: Indices  # Index in the dataset of each point of the grid, row by row, shape (m,)
    dt: Array  # Time since the previous grid point [s], shape (N, R)
    # Noise variance of each relative to that of one speed [1]; infinite without a measurement, shape (N, R)
    share: Array
    change: Array  # Change of the force since the previous grid point, as acceleration [m/s^2], shape (N, R)
    inertia: float  # Specific force per acceleration [N/kN per m/s^2]

    @classmethod
    def of(cls, dataset: Dataset) -> Grid:
        """Return the grid of a dataset."""
        first, counts = np.unique(dataset.point_run, return_index=True, return_counts=True)[1:]
        longest = np.argsort(-counts, kind='stable')
        rows = np.arange(counts.max())[:, None]
        inside = rows < counts[longest]
        index = np.where(inside, first[longest] + rows, 0)
        time, count = dataset.point_time[index], dataset.point_count[index]
        dt, change = np.zeros((2, *index.shape))
        dt[1:] = np.where(inside[1:], time[1:] - time[:-1], 1.0)
        share = np.where(inside & (count > 0.0), share_of_mean(count), np.inf)
        force = (dataset.joined('traction') + dataset.joined('brake'))[dataset.point_starts][index]
        change[1:] = np.where(inside[1:], np.abs(force[1:] - force[:-1]) / dataset.inertia, 0.0)
        edges = (*first.tolist(), dataset.point_time.size)
        return cls(edges, inside, index[inside], dt, share, change, dataset.inertia)

    @property
    def runs(self) -> list[slice]:
        """Grid points of each run."""
        return [slice(*edges) for edges in pairwise(self.edges)]


@dataclass(frozen=True, slots=True)
class Whitener:
    """Gains of the whitening Kalman filter; see :meth:`apply`."""

    grid: Grid  # Grid of these points
    # Matrix from [predicted state, measurement] to the predicted state at the next point, shape (N, R, 2, 3)
    step: Array
    scale: Array  # Inverse standard deviation of the innovation [s/m], 0 without a measurement, shape (N, R)
    log_det: float  # Sum of the log of the innovation variance over all measurements

    @classmethod
    def of(cls, grid: Grid, noise: Noise) -> Whitener:
        """Compute all gains at once; padding after the last grid point of a run has no weight."""
        f, e, Q = _transitions(grid, noise)
        R = noise.speed**2 * grid.share
        # Elements 00 and 01 of the prediction F P F' + Q, F = [1 f; 0 e]; S and K of the Kalman filter.
        P00, P01 = Q[0].copy(), Q[1].copy()
        p00, p01, p11 = _filtered(f, e, Q, R)[:, :-1]
        P00[1:] += p00 + f[1:] * (2.0 * p01 + f[1:] * p11)
        P01[1:] += e[1:] * (p01 + f[1:] * p11)
        S = P00 + R
        K0, K1 = P00 / S, P01 / S
        # F [I - K H, K] with the transition to the next grid point.
        step = np.zeros((*S.shape, 2, 3))
        f, e, K0, K1 = f[1:], e[1:], K0[:-1], K1[:-1]
        for i, row in enumerate(((1.0 - K0 - f * K1, f, K0 + f * K1), (-e * K1, e, e * K1))):
            step[:-1, :, i] = np.stack(row, axis=-1)
        return cls(grid, step, 1.0 / np.sqrt(S), float(np.log(S[np.isfinite(S)]).sum()))

    def apply(self, columns: Array) -> Array:
        """Return whitened columns at the grid points, shape (m, C); zero without a measurement."""
        order, inside = self.grid.order, self.grid.inside
        values = columns.take(order, axis=0)
        # The measurement is appended to the predicted state, so that a step is one matrix product. Two states take
        # turns: those of all grid points would not fit the cache.
        states = np.zeros((2, inside.shape[1], 3, columns.shape[1]))
        edges = np.cumsum([0, *inside.sum(axis=1)]).tolist()
        for i, (low, high) in enumerate(pairwise(edges)):
            now, after = states[i % 2, : high - low], states[1 - i % 2, : high - low]
            now[:, 2] = values[low:high]
            values[low:high] -= now[:, 0]
            np.matmul(self.step[i, : high - low], now, out=after[:, :2])
        white = np.empty_like(values)
        white[order] = values * self.scale[inside][:, None]
        return white


@dataclass(frozen=True, slots=True)
class Whitening:
    """Whitening of noise and of the factors of single runs; see :meth:`apply`.

    With whitened factors O of standard deviations s, a run has the covariance I + A A', A = O s. A = U D V' gives its
    inverse root I - A V diag(w) V' A', w = 1 / (r (r + 1)), r^2 = 1 + D^2.
    """

    whitener: Whitener  # The filter
    along: Array  # A V, shape (m, F)
    weight: Array  # w, shape (R, F)

    @classmethod
    def of(cls, whitener: Whitener, factors: Array, std: Array) -> Whitening:
        """Prepare the whitening for factors at the grid points (m, F) with their prior standard deviations (F,)."""
        scaled = whitener.apply(factors) * std
        squares, V = np.linalg.eigh(np.stack([scaled[run].T @ scaled[run] for run in whitener.grid.runs]))
        along = np.concatenate([scaled[run] @ v for run, v in zip(whitener.grid.runs, V, strict=True)])
        root = np.sqrt(1.0 + np.maximum(squares, 0.0))
        return cls(whitener, along, 1.0 / (root * (root + 1.0)))

    def apply(self, columns: Array) -> Array:
        """Return whitened columns at the grid points, shape (m, C); zero without a measurement."""
        white = self.whitener.apply(columns)
        for run, weight in zip(self.whitener.grid.runs, self.weight, strict=True):
            along = self.along[run]
            white[run] -= (along * weight) @ (along.T @ white[run])
        return white


def share_of_mean(count: Array) -> Array:
    """Return the variance of the mean of ``count`` neighbouring speeds relative to that of one [1], same shape.

    They share 10 % of it, since quantised speeds repeat.
    """
    return np.asarray(0.1 + 0.9 / np.maximum(count, 1.0))


def _transitions(grid: Grid, noise: Noise) -> tuple[Array, Array, Array]:
    """Return f and e of the transition [1 f; 0 e] of [speed error, gust] to each point, shape (N, R), and its noise.

    The covariance of the noise has the elements 00, 01 and 11, shape (3, N, R); at the first point it is the prior one.
    """
    dt, inertia = grid.dt, grid.inertia
    tau, variance = noise.gust_time, noise.gust**2
    e = np.exp(-dt / tau)
    Q = np.empty((3, *dt.shape))
    # Exact discretisation of the gust and its integral, plus the impulse caused by a delayed change of the force.
    Q[0] = variance * (tau / inertia) ** 2 * np.maximum(2.0 * dt / tau - 3.0 + 4.0 * e - e * e, 0.0)
    Q[0] += np.square(noise.jitter * grid.change)
    Q[1] = variance * tau * (1.0 - e) ** 2 / inertia
    Q[2] = variance * (1.0 - e * e)
    Q[:, 0] = np.array([1e2, 0.0, variance])[:, None]  # the initial speed error [(m/s)^2] is not known
    Q[::2] += 1e-12  # keeps the information matrix finite
    return tau * (1.0 - e) / inertia, e, Q


def _filtered(f: Array, e: Array, Q: Array, R: Array) -> Array:
    """Return the elements 00, 01, 11 of the covariance of the state after each measurement, shape (3, N, R).

    The information matrix of all states of a run is block-tridiagonal, and its Cholesky factorisation is equivalent to
    the forward recursion of a Kalman filter: the remaining diagonal block is the information of all measurements so
    far plus that of the transition to the next grid point.
    """
    N, runs = R.shape
    J = _inverse(Q)
    # -Q^-1 F and F' Q^-1 F.
    across = np.stack((-J[0], -J[1], -(J[0] * f + J[1] * e), -(J[1] * f + J[2] * e)))
    onward = np.zeros_like(Q)
    onward[:, :-1] = np.stack((J[0], -across[2], -(f * across[2] + e * across[3])))[:, 1:]
    diagonal = J + onward
    diagonal[0] += 1.0 / R
    # Lower band of one run after another; states of different runs are independent.
    band = np.zeros((4, runs, N, 2))
    band[0, ..., 0], band[1, ..., 0], band[0, ..., 1] = diagonal.transpose(0, 2, 1)
    band[2, :, :-1, 0], band[3, :, :-1, 0], band[1, :, :-1, 1], band[2, :, :-1, 1] = across[:, 1:].transpose(0, 2, 1)
    root = cholesky_banded(band.reshape(4, -1), lower=True, check_finite=False).reshape(band.shape)
    l00, l10, l11 = root[0, ..., 0].T, root[1, ..., 0].T, root[0, ..., 1].T
    return _inverse(np.stack((l00 * l00, l00 * l10, l10 * l10 + l11 * l11)) - onward)


def _inverse(A: Array) -> Array:
    """Return the inverses of symmetric matrices with the elements 00, 01 and 11, shape (3, ...)."""
    return np.asarray(np.stack((A[2], -A[1], A[0])) / (A[0] * A[2] - A[1] * A[1]))


_MAX_BINS: Final = 100  # Maximum number of bins of the line for map errors, to bound time and memory
_MIN_BIN_M: Final = 100.0  # Minimum length of a bin for map errors [m]
DAVIS: Final = slice(0, 3)
"""Indices of a, b, c among the nuisances."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard deviations of nuisances that differ from run to run and from place to place."""

    payload: float  # Relative error of the mass of a run [1]
    brake: float  # Relative change of the brake force from run to run [1]
    map: float  # Error of the map's gradient [per mille]

    @property
    def of_run(self) -> Array:
        """Prior std of the factors of single runs, payload and brake [1]; see :func:`run_columns`."""
        return np.array([self.payload, self.brake])


@dataclass(frozen=True, slots=True)
class Bins:
    """Sections of the line of equal length."""

    low: float  # Start of the first section [m]
    width: float  # Their length [m]
    count: int  # Their number

    @classmethod
    def of(cls, dataset: Dataset, length: float, *, fine: bool = False) -> Bins:
        """Return bins over the line that a train of the given length [m] has passed.

        Map errors are smooth; bins for effects on sections are half as long (``fine``).
        """
        position = dataset.joined('position')
        low, high = float(position.min()) - length, float(position.max()) + length
        width = max(_MIN_BIN_M, (high - low) / _MAX_BINS) / (2.0 if fine else 1.0)
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
    std = 0.4 * np.abs(np.array([davis.a, davis.b, davis.c])) + np.array([0.15, 0.02, 0.0004])
    return np.concatenate([std, (0.1, 0.04, 15.0, 0.003, 0.004), [0.003 if weighed else 0.015]])


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


def integrated_covariance(t: Array, tau: float) -> Array:
    """Return the covariance at times t [s] of the integral of an Ornstein-Uhlenbeck process over std^2 tau^2, (n, n).

    The integral is 0 at t = 0; tau is the correlation time of the process [s].
    """
    lesser, decay = np.minimum(t[:, None], t[None, :]), np.exp(-t / tau)
    apart = np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    return np.asarray(2.0 * lesser / tau - 1.0 + decay[:, None] + decay[None, :] - apart)
