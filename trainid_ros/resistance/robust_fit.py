# SPDX-License-Identifier: Apache-2.0
"""Robust batch fit of y = phi' theta, insensitive to up to 45 % outliers.

Used to start an estimate from bad data and to restart one that has diverged. Least trimmed squares finds the 55 % of
the observations that agree best, by concentration steps from many small subsets (Rousseeuw and Van Driessen 2006);
least squares over all observations near that fit gives the estimate.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.resistance.normal import Normal, information_of, normal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

MIN_ROWS: Final = 12
"""Smallest number of rows to fit."""
_AGREEING: Final = 0.55
_STARTS, _SUBSET = 60, 4
_CONCENTRATIONS: Final = 12
# Inlier threshold in standard deviations, and the standard deviation of unit normal noise truncated there.
_NEAR, _CUT_STD = 2.5, 0.9497
# |z| that contains the agreeing share of normal noise.
_AGREEING_Z: Final = 0.7554
_ROUNDS: Final = 10


def robust_fit(rows: tuple[tuple[float, ...], ...], prior: Normal) -> Normal | None:
    """Return the posterior of the parameters from the rows that agree, or None if fewer than half of them do.

    Args:
        rows: Rows of the n entries of the regressor phi, the observation y, its noise variance R, and the factor on
            R in the mean of many observations.
        prior: Prior distribution of the n parameters.
    """
    table = np.array(rows)
    root = np.sqrt(table[:, -2])
    Phi, y = table[:, :-3] / root[:, None], table[:, -3] / root
    before = np.array(list(information_of(prior))).reshape(-1, len(prior.mean) + 1)
    information, vector = before[:, :-1], before[:, -1]
    theta, scale = _trimmed(Phi, y, information, vector)
    for _ in range(_ROUNDS):
        near = np.abs(y - Phi @ theta) < _NEAR * scale
        if np.mean(near) < 0.5:
            return None
        theta = _ridge(Phi[near], y[near], information * scale**2, vector * scale**2)
        scale = max(1.0, float(np.std(y[near] - Phi[near] @ theta)) / _CUT_STD)
    weights = near / (table[:, -1] * scale**2)
    P = np.linalg.inv(information + Phi.T @ (weights[:, None] * Phi))
    if not (np.isfinite(theta).all() and np.isfinite(P).all()):
        return None
    return normal(theta, P)


def _trimmed(Phi: Array, y: Array, information: Array, vector: Array) -> tuple[Array, float]:
    """Return the parameters of least trimmed squares and the scale of the agreeing residuals, at least 1."""
    generator = np.random.default_rng(0)
    count = round(_AGREEING * len(y))
    best, least = np.zeros(Phi.shape[1]), np.inf
    for _ in range(_STARTS):
        kept = generator.choice(len(y), _SUBSET, replace=False)
        for _ in range(_CONCENTRATIONS):
            theta = _ridge(Phi[kept], y[kept], information, vector)
            residuals = np.abs(y - Phi @ theta)
            kept = np.argpartition(residuals, count - 1)[:count]
        cost = float(np.sum(residuals[kept] ** 2))
        if cost < least:
            best, least = theta, cost
    residuals = np.sort(np.abs(y - Phi @ best))
    return best, max(1.0, float(residuals[count - 1]) / _AGREEING_Z)


def _ridge(Phi: Array, y: Array, information: Array, vector: Array) -> Array:
    return np.asarray(np.linalg.solve(information + Phi.T @ Phi, vector + Phi.T @ y), dtype=np.float64)
