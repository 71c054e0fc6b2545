# SPDX-License-Identifier: Apache-2.0
"""Bayesian linear regression on whitened columns with the nuisances integrated out, and the marginal likelihood.

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
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from trainid_ros.explain.noise import Grid, Noise, Spread, Whitener, prior_factor
from trainid_ros.interface.errors import NoAnswerError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.dataset import Array


@dataclass(frozen=True, slots=True)
class Gram:
    """Products of whitened columns, summed over runs; those with the factors of single runs are separate."""

    total: Array  # Products of columns, shape (C, C)
    cross: Array  # Products of columns with the factors of the run, shape (R, C, F)
    own: Array  # Products of those factors, shape (R, F, F)

    @classmethod
    def of(cls, columns: Array, factors: int, whitener: Whitener) -> Gram:
        """Whiten columns at the grid points, the last of which are factors of single runs, shape (m, C + F)."""
        C = columns.shape[1] - factors
        white = whitener.apply(columns)
        by_run = np.stack([white[run].T @ white[run, C:] for run in whitener.grid.runs])
        return cls((white.T @ white)[:C, :C], by_run[:, :C], by_run[:, C:])

    def reduced(self, std: Array) -> tuple[Array, float]:
        """Integrate out the factors of runs, with prior standard deviations of shape (F,).

        Returns:
            Products of columns, shape (C, C), and the log determinant of the marginalisation.
        """
        weighted = self.own + np.diag(1.0 / np.square(std))
        _, log_det = np.linalg.slogdet(weighted)
        scaled = self.cross @ np.linalg.inv(weighted)
        left = self.total - np.concatenate([*scaled], axis=1) @ np.concatenate([*self.cross], axis=1).T
        return left, float(log_det.sum() + len(self.own) * 2.0 * np.log(std).sum())


class Nuisances:
    """Nuisances to integrate out, by the products N'N and L with L L' = K, both of shape (n, n); see the module.

    Attributes:
        log_det: Log determinant of the marginalisation.
    """

    def __init__(self, products: Array, root: Array) -> None:
        self._root, self._factor = root, cho_factor(np.eye(len(root)) + root.T @ products @ root, lower=True)
        self.log_det = 2.0 * float(np.log(np.diag(self._factor[0])).sum())

    def explained(self, left: Array, right: Array) -> Array:
        """Return C'N (N'N + K^-1)^-1 N'D from the products N'C and N'D, shapes (n, k) and (n, l) to (k, l)."""
        return np.asarray((self._root.T @ left).T @ cho_solve(self._factor, self._root.T @ right))


@dataclass(frozen=True, slots=True)
class Information:
    """Information on k columns after elimination of all nuisances; see the module."""

    A: Array  # Products of the columns, shape (k, k)
    b: Array  # Products of the columns with y, shape (k,)
    yy: float  # Product of y with itself
    log_det: float  # Log determinant of the marginalisation of the nuisances


def eliminate(products: Array, prior_factor: Array) -> Information:
    """Integrate out the nuisances.

    Args:
        products: Products of y, nuisances and candidates, shape (C, C).
        prior_factor: L with L L' the prior covariance of the n nuisances, shape (n, n).
    """
    nuisances = len(prior_factor)
    own = slice(1, 1 + nuisances)
    found = Nuisances(products[own, own], prior_factor)
    keep = np.concatenate([[0], np.arange(1 + nuisances, products.shape[0])])
    rest = products[own][:, keep]
    # A and b of the module docstring.
    after = products[np.ix_(keep, keep)] - found.explained(rest, rest)
    return Information(after[1:, 1:], after[1:, 0], float(after[0, 0]), found.log_det)


def informations(columns: Array, candidates: Sequence[Array], prior_factor: Array) -> list[Information]:
    """Return the information on groups of candidates (m, k), each alone, from y and nuisances (m, 1 + n).

    All are whitened; ``prior_factor`` is as in :func:`eliminate`.
    """
    y, N = columns[:, :1], columns[:, 1:]
    nuisances, Ny = Nuisances(N.T @ N, prior_factor), N.T @ y
    yy = float((y.T @ y - nuisances.explained(Ny, Ny))[0, 0])
    found = []
    for C in candidates:
        NC = N.T @ C
        # A and b of the module docstring.
        A, b = C.T @ C - nuisances.explained(NC, NC), C.T @ y - nuisances.explained(NC, Ny)
        found.append(Information(A, b[:, 0], yy, nuisances.log_det))
    return found


def posterior(products: Array, prior_factor: Array) -> tuple[Array, Array]:
    """Return the posterior mean (n,) and covariance (n, n) of the coefficients of all columns after y.

    ``products`` are those of y and the columns, shape (1 + n, 1 + n); ``prior_factor`` is as in :func:`eliminate`.
    """
    inner = np.eye(len(prior_factor)) + prior_factor.T @ products[1:, 1:] @ prior_factor
    covariance = prior_factor @ np.linalg.solve(inner, prior_factor.T)
    return covariance @ products[1:, 0], covariance


def log_bayes(A: Array, b: Array, std: Array | float, sign: int = 0) -> Array:
    """Return 2 ln B of single columns (see the module), same shape; ``sign`` restricts amplitudes to one side of 0."""
    from scipy.special import log_ndtr  # noqa: PLC0415 (slow to load)

    precision = A + 1.0 / np.square(std)
    # 2 ln B of the module docstring.
    value = b * b / precision - np.log1p(A * np.square(std))
    if sign:
        # Half-normal prior: twice the posterior probability of the permitted side.
        value = value + 2.0 * (log_ndtr(sign * b / np.sqrt(precision)) + np.log(2.0))
    return np.asarray(value)


def group_log_bayes(A: Array, b: Array, std: float) -> float:
    """Return 2 ln B of a group of columns whose coefficients are independent with a common prior std."""
    inner = np.eye(len(b)) + std * std * A
    _, log_det = np.linalg.slogdet(inner)
    return float(std * std * b @ np.linalg.solve(inner, b) - log_det)


# Prior median of the log of each hyperparameter: speed noise [m/s], gust [N/kN], gust time [s], jitter [s],
# payload [1], brake [1], map [per mille]; the payload is that of weighed trains.
_MEDIAN: Final = np.log([0.03, 0.12, 8.0, 0.02, 0.005, 0.01, 0.25])
_WIDTH: Final = np.array([1.0, 0.5, 0.4, 0.7, 0.5, 0.5, 0.4])  # Prior std of these logs [1]
_GUST, _GUST_TIME, _PAYLOAD = 1, 2, 4  # Indices among the hyperparameters
_OF_RUN: Final = 4  # Number of hyperparameters of the noise along a run, which come first: others need no new whitening
_STEP: Final = 0.05  # Step of the logs for curvature by central differences [1]
_SMALL: Final = 1e-3  # Step of the logs for the gradient by forward differences [1]
# The search ends when a step gains less than this in 2 ln of the likelihood [1]: verdicts need whole units.
_SETTLED: Final = 0.05


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """Standard deviations of noise and nuisances."""

    noise: Noise  # Those of noise along a run
    spread: Spread  # Those of nuisances by run and by place
    evidence: float  # 2 ln of marginal likelihood times prior at these values, up to a constant


class MarginalLikelihood:
    """Marginal likelihood of the data as a function of the logs of all hyperparameters."""

    def __init__(
        self, grid: Grid, columns: Array, factors: Array, common_std: Array, map_root: Array, *, weighed: bool
    ) -> None:
        """Prepare the evaluation.

        Args:
            grid: Grid of these points.
            columns: y [m/s], common nuisances, bins of the map, shape (m, 1 + q + k).
            factors: Columns of payload and brake, shape (m, 2).
            common_std: Prior std of the common nuisances, shape (q,).
            map_root: Cholesky factor of the correlation of map errors, shape (k, k).
            weighed: True if the mass is measured.
        """
        self._grid, self._factors = grid, factors.shape[1]
        self._columns = np.concatenate([columns, factors], axis=1)
        self._common, self._root = common_std, map_root
        self._median = _MEDIAN.copy()
        if not weighed:
            self._median[_PAYLOAD] = math.log(0.03)  # relative error of the mass if it is not measured [1]
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
        distances = np.maximum([drift, *(above / _WIDTH)[_OF_RUN:]], 0.0)
        return float(distances @ distances)

    def maximise(self, start: Array | None = None) -> tuple[Hyperparameters, Array]:
        """Return the best hyperparameters and their logs, starting from the prior's median or a better given start.

        Raises:
            NoAnswerError: The likelihood cannot be computed at the start.
        """
        x, value = self._median.copy(), self._value(self._median)
        # Hyperparameters estimated without an effect can be far off with it.
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
        """Return -2 ln of likelihood times prior; infinite where a covariance is not positive definite numerically."""
        try:
            return self._computed(x)
        except np.linalg.LinAlgError:
            return math.inf

    def _computed(self, x: Array) -> float:
        noise, spread = _hyperparameters(x)
        key = tuple(x[:_OF_RUN].tolist())
        if self._gram is None or self._gram[0] != key:
            whitener = Whitener.of(self._grid, noise)
            self._gram = (key, Gram.of(self._columns, self._factors, whitener), whitener.log_det)
        _, gram, log_det = self._gram
        products, cost = gram.reduced(spread.of_run)
        factor = prior_factor(self._common, self._root, spread)
        information = eliminate(products, factor)
        prior = float(np.sum(np.square((x - self._median) / _WIDTH)))
        return information.yy + log_det + cost + information.log_det + prior


def _updated(curvature: Array, move: Array, change: Array) -> Array:
    """Return the BFGS update of the curvature (7, 7) for a step ``move`` that changed the gradient by ``change``.

    It is left as it is where the change is not finite, or against the step.
    """
    along = float(move @ change)
    seen = curvature @ move
    if not 1e-3 * float(move @ seen) < along < math.inf:
        return curvature
    return np.asarray(curvature + np.outer(change, change) / along - np.outer(seen, seen) / float(move @ seen))


def _hyperparameters(x: Array) -> tuple[Noise, Spread]:
    speed, gust, gust_time, jitter, payload, brake, line = np.exp(x).tolist()
    return Noise(speed, gust, gust_time, jitter), Spread(payload, brake, line)
