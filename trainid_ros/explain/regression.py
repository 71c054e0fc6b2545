# SPDX-License-Identifier: Apache-2.0
"""Bayesian linear regression on whitened columns, with the nuisances integrated out.

With unit noise, columns C, nuisances N with prior covariance K and measurements y,

    A = C'C - C'N (N'N + K^-1)^-1 N'C,      b = C'y - C'N (N'N + K^-1)^-1 N'y,

and an effect with column c and prior std s of its amplitude has the Bayes factor

    2 ln B = b^2 / (A + s^-2) - ln(1 + s^2 A).

Factors of single runs (payload, brake) are eliminated run by run before anything is summed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cho_factor, cho_solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.noise import Whitener

    Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Gram:
    """Products of whitened columns, summed over runs or by run; those with the factors of single runs are separate.

    Attributes:
        total: Products of columns, sum over runs, shape (C, C), or by run, shape (R, C, C).
        cross: Products of columns with the factors of the run, shape (R, C, F).
        own: Products of those factors, shape (R, F, F).

    """

    total: Array
    cross: Array
    own: Array

    @classmethod
    def of(cls, spread: Array, factors: int, whitener: Whitener, *, by_run: bool = False) -> Gram:
        """Whiten columns on the grid, the last of which are factors of single runs, shape (N, R, C + F)."""
        C = spread.shape[2] - factors
        white = whitener.apply(spread)
        runs = white.transpose(1, 0, 2)
        own = runs[:, :, C:]
        flat = white[:, :, :C].reshape(-1, C)
        total = runs[:, :, :C].transpose(0, 2, 1) @ runs[:, :, :C] if by_run else flat.T @ flat
        return cls(total, runs[:, :, :C].transpose(0, 2, 1) @ own, own.transpose(0, 2, 1) @ own)

    def reduced(self, std: Array) -> tuple[Array, float]:
        """Integrate out the factors of runs.

        Args:
            std: Prior standard deviation of each factor, shape (F,).

        Returns:
            Products of columns, shaped like ``total``, and the log determinant of the marginalisation.

        """
        weighted = self.own + np.diag(1.0 / np.square(std))
        _, log_det = np.linalg.slogdet(weighted)
        scaled = self.cross @ np.linalg.inv(weighted)
        if self.total.ndim == 3:
            left = self.total - scaled @ self.cross.transpose(0, 2, 1)
        else:
            left = self.total - np.concatenate([*scaled], axis=1) @ np.concatenate([*self.cross], axis=1).T
        return left, float(log_det.sum() + len(self.own) * 2.0 * np.log(std).sum())


@dataclass(frozen=True, slots=True)
class Information:
    """Information on k columns after elimination of all nuisances; see the module.

    Attributes:
        A: Products of the columns, shape (k, k).
        b: Products of the columns with y, shape (k,).
        yy: Product of y with itself.
        log_det: Log determinant of the marginalisation of the nuisances.

    """

    A: Array
    b: Array
    yy: float
    log_det: float

    def given(self, terms: Sequence[int], std: Array) -> Information:
        """Return the information after elimination of some of the columns too.

        Args:
            terms: Indices of these columns.
            std: Prior std of all columns, shape (k,).

        """
        if not len(terms):
            return self
        index = list(terms)
        scale = std[index]
        inner = np.eye(len(index)) + scale[:, None] * self.A[np.ix_(index, index)] * scale[None, :]
        factor = cho_factor(inner, lower=True)
        left, right = scale[:, None] * self.A[index], scale * self.b[index]
        solved, at = cho_solve(factor, left), cho_solve(factor, right)
        return Information(
            self.A - left.T @ solved,
            self.b - left.T @ at,
            self.yy - float(right @ at),
            self.log_det + _log_det(factor),
        )


def eliminate(products: Array, nuisances: int, prior_factor: Array) -> Information:
    """Integrate out the nuisances, which follow y in column 0.

    Args:
        products: Products of y, nuisances and candidates, shape (C, C).
        nuisances: Number of nuisances, columns 1 to ``nuisances``.
        prior_factor: L with L L' the prior covariance of the nuisances, shape (nuisances, nuisances).

    """
    n = nuisances
    own = products[1 : 1 + n, 1 : 1 + n]
    rest = np.concatenate([products[1 : 1 + n, :1], products[1 : 1 + n, 1 + n :]], axis=1)
    # A and b of the module docstring, with K = L L'.
    inner = np.eye(n) + prior_factor.T @ own @ prior_factor
    factor = cho_factor(inner, lower=True)
    scaled = prior_factor.T @ rest
    left = scaled.T @ cho_solve(factor, scaled)
    keep = np.concatenate([[0], np.arange(1 + n, products.shape[0])])
    after = products[np.ix_(keep, keep)] - left
    return Information(after[1:, 1:], after[1:, 0], float(after[0, 0]), _log_det(factor))


def posterior(products: Array, prior_factor: Array) -> tuple[Array, Array]:
    """Return the posterior mean and covariance of the coefficients of all columns after y, shapes (n,) and (n, n).

    Args:
        products: Products of y and the columns, shape (1 + n, 1 + n).
        prior_factor: L with L L' the prior covariance of the columns, shape (n, n).

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


def _log_det(factor: tuple[Array, bool]) -> float:
    """Return the log determinant of a matrix from its Cholesky factor."""
    return 2.0 * float(np.log(np.diag(factor[0])).sum())
