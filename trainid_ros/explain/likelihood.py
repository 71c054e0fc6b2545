# SPDX-License-Identifier: Apache-2.0
"""Noise and nuisances of the speed gap, and the marginal likelihood of effects with both integrated out.

Noise is gusts, a random resistance modelled as an Ornstein-Uhlenbeck process whose response is its integral; noise of
the measured speed; and the unknown initial speed. A Kalman filter on the state [speed error, gust] turns them into
independent unit noise. It is linear, so the columns of all candidates pass through it with the same gains.

Nuisances are estimated together with every candidate: base Davis, payload, brakes, clocks and map errors. If the base
model were fixed, its own errors would be named as effects. Each nuisance is a column with a Gaussian prior; standard
deviations that the data determine (payload, brake, map) are hyperparameters.

With unit noise, columns C, nuisances N with prior covariance K and measurements y,

    A = C'C - C'N (N'N + K^-1)^-1 N'C,      b = C'y - C'N (N'N + K^-1)^-1 N'y,

and an effect with column c and prior std s of its amplitude has the Bayes factor

    2 ln B = b^2 / (A + s^-2) - ln(1 + s^2 A).

Factors of single runs (payload, brake) are eliminated run by run before anything is summed.

The hyperparameters of noise and nuisances maximise the marginal likelihood times a prior. Wrong by a half, they lead to
false effects; so they are estimated from the data, and again whenever an effect is added to the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky_banded

from trainid_ros.explain.nuisances import Spread, prior_factor
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.stream.samples import SAMPLE_PERIOD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.dataset import Array, Dataset, Flags, Indices


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
    hidden: Array  # Variance of each by rounding, as independent noise [(m/s)^2], shape (N, R)
    change: Array  # Change of the force since the previous grid point, as acceleration [m/s^2], shape (N, R)
    inertia: float  # Specific force per acceleration [N/kN per m/s^2]
    hiding: Array  # The variances ``hidden`` at each point, in the order of the dataset, shape (m,)
    rounding: float  # Variance of one speed by rounding [(m/s)^2]

    @classmethod
    def of(cls, dataset: Dataset) -> Grid:
        """Return the grid of a dataset."""
        first, counts = np.unique(dataset.point_run, return_index=True, return_counts=True)[1:]
        longest = np.argsort(-counts, kind='stable')
        rows = np.arange(counts.max())[:, None]
        inside = rows < counts[longest]
        index = np.where(inside, first[longest] + rows, 0)
        time, count = dataset.point_time[index], dataset.point_count[index]
        dt = np.zeros(index.shape)
        dt[1:] = np.where(inside[1:], time[1:] - time[:-1], 1.0)
        share = np.where(inside & (count > 0.0), share_of_mean(count), np.inf)
        hiding, rounding = rounding_of(dataset)
        hidden, change = (np.where(inside, values[index], 0.0) for values in (hiding, dataset.point_change))
        edges = (*first.tolist(), dataset.point_time.size)
        return cls(edges, inside, index[inside], dt, share, hidden, change, dataset.inertia, hiding, rounding)

    @property
    def runs(self) -> list[slice]:
        """Grid points of each run."""
        return [slice(*edges) for edges in pairwise(self.edges)]


@dataclass(frozen=True, slots=True)
class Whitener:
    """Gains of the whitening Kalman filter; see :meth:`apply`."""

    grid: Grid
    # Matrix from [predicted state, measurement] to the predicted state at the next point, shape (N, R, 2, 3)
    step: Array
    scale: Array  # Inverse standard deviation of the innovation [s/m], 0 without a measurement, shape (N, R)
    log_det: float  # Sum of the log of the innovation variance over all measurements

    @classmethod
    def of(cls, grid: Grid, noise: Noise) -> Whitener:
        """Compute all gains at once; padding after the last grid point of a run has no weight."""
        f, e, Q = _transitions(grid, noise)
        R = noise.speed**2 * grid.share + grid.hidden
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

    whitener: Whitener
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


_DITHER: Final = 0.03  # Noise of a speed [m/s], as the prior median below, which changes how it is rounded


def rounding_of(dataset: Dataset) -> tuple[Array, float]:
    """Return the variance of independent noise that hides as much as the rounding of speeds, and that of rounding.

    [(m/s)^2], the first at each point, shape (m,).
    """
    speeds = dataset.joined('speed')
    values = np.unique(speeds)
    # Rounded speeds repeat; some of the values in between may not occur.
    resolution = float(np.quantile(np.diff(values), 0.1)) if 1 < values.size < 0.5 * speeds.size else 0.0
    mean = dataset.average(dataset.speed)
    change = np.abs(np.diff(mean, prepend=mean[:1]))
    # A steady speed has one error at all points until it has changed by the resolution.
    repeats = resolution / np.maximum(change, _DITHER)
    variance = resolution**2 / 12.0
    return variance * np.maximum(repeats, 1.0 / np.maximum(dataset.point_count, 1.0)), variance


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


def integrated_covariance(t: Array, tau: float) -> Array:
    """Return the covariance at times t [s] of the integral of an Ornstein-Uhlenbeck process over std^2 tau^2, (n, n).

    The integral is 0 at t = 0; tau is the correlation time of the process [s].
    """
    lesser, decay = np.minimum(t[:, None], t[None, :]), np.exp(-t / tau)
    apart = np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    return np.asarray(2.0 * lesser / tau - 1.0 + decay[:, None] + decay[None, :] - apart)


@dataclass(frozen=True, slots=True)
class Gram:
    """Products of whitened columns, summed over runs; those with the factors of single runs are separate."""

    total: Array  # Products of columns, shape (C, C)
    cross: Array  # Products of columns with the factors of the run, shape (R, C, F)
    own: Array  # Products of those factors, shape (R, F, F)

    @classmethod
    def of(cls, columns: Array, factors: int, whitener: Whitener) -> Gram:
        """Whiten columns at the grid points (m, C + F), the last of which are the factors of single runs."""
        C = columns.shape[1] - factors
        white = whitener.apply(columns)
        by_run = np.stack([white[run].T @ white[run, C:] for run in whitener.grid.runs])
        return cls((white.T @ white)[:C, :C], by_run[:, :C], by_run[:, C:])

    def reduced(self, std: Array) -> tuple[Array, float]:
        """Return products (C, C) without the factors of runs, of prior std (F,), and the log determinant of it."""
        weighted = self.own + np.diag(1.0 / np.square(std))
        _, log_det = np.linalg.slogdet(weighted)
        scaled = self.cross @ np.linalg.inv(weighted)
        left = self.total - np.concatenate([*scaled], axis=1) @ np.concatenate([*self.cross], axis=1).T
        return left, float(log_det.sum() + len(self.own) * 2.0 * np.log(std).sum())


class Nuisances:
    """Nuisances to integrate out, by N'N and L with L L' = K, (n, n); ``log_det`` is that of the marginalisation."""

    def __init__(self, products: Array, root: Array) -> None:
        self._root, self._factor = root, cho_factor(np.eye(len(root)) + root.T @ products @ root, lower=True)
        self.log_det = 2.0 * float(np.log(np.diag(self._factor[0])).sum())

    def explained(self, left: Array, right: Array) -> Array:
        """Return C'N (N'N + K^-1)^-1 N'D from the products N'C and N'D, shapes (n, k) and (n, l) to (k, l)."""
        return np.asarray((self._root.T @ left).T @ cho_solve(self._factor, self._root.T @ right))


@dataclass(frozen=True, slots=True)
class Information:
    """Information on k columns after elimination of all nuisances."""

    A: Array  # Products of the columns, shape (k, k)
    b: Array  # Products of the columns with y, shape (k,)
    yy: float  # Product of y with itself
    log_det: float  # Log determinant of the marginalisation of the nuisances


def eliminate(products: Array, root: Array) -> Information:
    """Integrate out n nuisances, of prior covariance L L', from products of y, nuisances and candidates (C, C)."""
    own = slice(1, 1 + len(root))
    found = Nuisances(products[own, own], root)
    keep = np.concatenate([[0], np.arange(own.stop, products.shape[0])])
    rest = products[own][:, keep]
    after = products[np.ix_(keep, keep)] - found.explained(rest, rest)
    return Information(after[1:, 1:], after[1:, 0], float(after[0, 0]), found.log_det)


def informations(columns: Array, candidates: Sequence[Array], root: Array) -> list[Information]:
    """Return the information on groups of candidates (m, k), each alone, from y and nuisances (m, 1 + n), whitened."""
    y, N = columns[:, :1], columns[:, 1:]
    nuisances, Ny = Nuisances(N.T @ N, root), N.T @ y
    yy = float((y.T @ y - nuisances.explained(Ny, Ny))[0, 0])
    found = []
    for C in candidates:
        NC = N.T @ C
        # A and b of the module docstring.
        A, b = C.T @ C - nuisances.explained(NC, NC), C.T @ y - nuisances.explained(NC, Ny)
        found.append(Information(A, b[:, 0], yy, nuisances.log_det))
    return found


def posterior(products: Array, root: Array) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of the n coefficients after y, from products of y and their columns."""
    inner = np.eye(len(root)) + root.T @ products[1:, 1:] @ root
    covariance = root @ np.linalg.solve(inner, root.T)
    return covariance @ products[1:, 0], covariance


def log_bayes(A: Array, b: Array, std: Array | float, sign: int = 0) -> Array:
    """Return 2 ln B of single columns (see the module), same shape; ``sign`` restricts amplitudes to one side of 0."""
    from scipy.special import log_ndtr  # noqa: PLC0415 (slow to load)

    precision = A + 1.0 / np.square(std)
    value = b * b / precision - np.log1p(A * np.square(std))
    if sign:
        # Half-normal prior: twice the posterior probability of the permitted side.
        value = value + 2.0 * (log_ndtr(sign * b / np.sqrt(precision)) + np.log(2.0))
    return np.asarray(value)


def group_log_bayes(A: Array, b: Array, std: float) -> Array:
    """Return 2 ln B of groups of columns, shapes (..., k, k) and (..., k), whose coefficients are independent.

    They have a common prior std. The shape of the result is (...).
    """
    inner = np.eye(b.shape[-1]) + std * std * A
    gain = std * std * np.sum(b * np.linalg.solve(inner, b[..., None])[..., 0], axis=-1)
    return np.asarray(gain - np.linalg.slogdet(inner)[1])


# Prior median of the log of each hyperparameter: speed noise [m/s], gust [N/kN], gust time [s], jitter [s],
# payload [1], brake [1], map [per mille]; payload is that of weighed trains, gusts and map go with usual gradients.
# Assumed; on cases of two generators where nothing is hidden, the medians found are 0.5 to 1.5 times as large, and the
# logs differ by 0.2 to 0.5, of jitter by up to 1.3 (benchmarks/explain_sizes.py).
_MEDIAN: Final = np.log([0.03, 0.12, 8.0, 0.02, 0.005, 0.01, 0.25])
_WIDTH: Final = np.array([1.0, 0.5, 0.4, 0.7, 0.5, 0.5, 0.4])  # Prior std of these logs [1]
_USUAL_GRADIENT_STD: Final = 0.2  # The default of the train file [per mille]
_GUST, _GUST_TIME, _JITTER, _PAYLOAD, _MAP = 1, 2, 3, 4, 6  # Indices among the hyperparameters
_OF_RUN: Final = 4  # Number of hyperparameters of the noise along a run, which come first: others need no new whitening
_STEP: Final = 0.05  # Step of the logs for curvature by central differences [1]
_SMALL: Final = 1e-3  # Step of the logs for the gradient by forward differences [1]
# The search ends when a step gains less than this in 2 ln of the likelihood [1]: verdicts need whole units.
_SETTLED: Final = 0.05


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """Standard deviations of noise and nuisances."""

    noise: Noise
    spread: Spread
    evidence: float  # 2 ln of marginal likelihood times prior at these values, up to a constant


class MarginalLikelihood:
    """Marginal likelihood of the data as a function of the logs of all hyperparameters.

    Args:
        grid: Grid of the points.
        columns: y [m/s], common nuisances, bins of the map, shape (m, 1 + q + k).
        factors: Columns of payload, brake and wind, shape (m, 3).
        common_std: Prior std of the common nuisances, shape (q,).
        map_root: Cholesky factor of the correlation of map errors, shape (k, k).
        weighed: True if the mass is measured.
        gradient_std: Stated noise of gradients [per mille].
        period: Time between samples [s].
    """

    def __init__(
        self, grid: Grid, columns: Array, factors: Array, common_std: Array, map_root: Array, *, weighed: bool,
        gradient_std: float = _USUAL_GRADIENT_STD, period: float = SAMPLE_PERIOD,
    ) -> None:  # fmt: skip
        self._grid, self._factors = grid, factors.shape[1]
        self._columns = np.concatenate([columns, factors], axis=1)
        self._common, self._root = common_std, map_root
        self._median = _MEDIAN.copy()
        if not weighed:
            self._median[_PAYLOAD] = math.log(0.03)  # relative error of the mass if it is not measured [1]
        # Errors of gradients are errors of the map where they repeat, and gusts where they do not.
        self._median[[_GUST, _MAP]] += math.log(max(gradient_std / _USUAL_GRADIENT_STD, 1.0))
        self._median[_JITTER] += math.log(max(period / SAMPLE_PERIOD, 1.0))
        self._products = lru_cache(1)(self._whitened)  # the same for other nuisances

    def at(self, logs: Array) -> float:
        """Return 2 ln of likelihood times prior at the logs of all hyperparameters, shape (7,)."""
        return -self._value(logs)

    def usual(self, hyper: Hyperparameters) -> Hyperparameters:
        """Return hyperparameters with payload, brake and map at the median of their priors."""
        return replace(hyper, spread=_hyperparameters(self._median)[1])

    def of_usual_gusts(self, hyper: Hyperparameters) -> Hyperparameters:
        """Return :meth:`usual` hyperparameters with gusts at the median of their priors too."""
        noise = _hyperparameters(self._median)[0]
        return replace(self.usual(hyper), noise=replace(hyper.noise, gust=noise.gust, gust_time=noise.gust_time))

    def excess(self, logs: Array) -> float:
        """Return the sum of squares of the prior std by which gusts, payload, brake and map exceed their medians [1].

        Of gusts the speed error counts: their std times the root of their correlation time.
        """
        above = logs - self._median
        drift = (above[_GUST] + 0.5 * above[_GUST_TIME]) / math.hypot(_WIDTH[_GUST], 0.5 * _WIDTH[_GUST_TIME])
        distances = np.maximum([drift, *(above / _WIDTH)[_OF_RUN:]], 0.0)
        return float(distances @ distances)

    def maximise(self, start: Array | None = None) -> tuple[Hyperparameters, Array]:
        """Return the best hyperparameters and their logs, starting from the prior's median or a better given start.

        Raises:
            NoAnswerError: The likelihood cannot be computed at the start.
        """
        x, value = self._median.copy(), self._value(self._median)
        if start is not None and (there := self._value(start)) < value:
            x, value = start.copy(), there
        if not math.isfinite(value):
            raise NoAnswerError('the motion differs too much from that of the train file to be compared')
        gradient, curvature = self._slopes(x, value)
        for _ in range(30):
            # Beside hyperparameters whose likelihood cannot be computed there is no slope to follow.
            if not np.isfinite(gradient).all():
                break
            move = -np.linalg.solve(curvature, gradient)
            move *= min(1.0, 2.0 / float(np.abs(move).max()))  # at most 2 in any of the logs
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
        """Return gradient and diagonal, positive curvature by central differences."""
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
        """Return -2 ln of likelihood times prior; infinite where a covariance is not positive definite numerically."""
        try:
            return self._computed(x)
        except np.linalg.LinAlgError:
            return math.inf

    def _computed(self, x: Array) -> float:
        noise, spread = _hyperparameters(x)
        gram, log_det = self._products(noise)
        products, cost = gram.reduced(spread.of_run)
        information = eliminate(products, prior_factor(self._common, self._root, spread))
        prior = float(np.sum(np.square((x - self._median) / _WIDTH)))
        return information.yy + log_det + cost + information.log_det + prior

    def _whitened(self, noise: Noise) -> tuple[Gram, float]:
        whitener = Whitener.of(self._grid, noise)
        return Gram.of(self._columns, self._factors, whitener), whitener.log_det


def _updated(curvature: Array, move: Array, change: Array) -> Array:
    """Return the BFGS update of the curvature (7, 7); unchanged if ``change`` is not finite or against the step."""
    along = float(move @ change)
    seen = curvature @ move
    if not 1e-3 * float(move @ seen) < along < math.inf:
        return curvature
    return np.asarray(curvature + np.outer(change, change) / along - np.outer(seen, seen) / float(move @ seen))


def _hyperparameters(x: Array) -> tuple[Noise, Spread]:
    speed, gust, gust_time, jitter, payload, brake, line = np.exp(x).tolist()
    return Noise(speed, gust, gust_time, jitter), Spread(payload, brake, line)
