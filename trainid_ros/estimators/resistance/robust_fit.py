# SPDX-License-Identifier: Apache-2.0
"""Batch fit of w = a + b v + c v^2 that up to almost half of the observations cannot lead astray.

For the start of an estimate from bad data, and for a new beginning when a belief has lost touch. Iteratively
reweighted least squares, first with Huber's weights from the median absolute residual, which finds the way from
anywhere, then with Tukey's, which leave outliers out for good (Maronna, Martin and Yohai 2006, chapter 5).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.estimators.resistance.robust import Belief

    Array = NDArray[np.float64]

LEAST_ROWS: Final = 12
_HUBER, _TUKEY = 1.345, 4.685
_ROUNDS: Final = 20
# Normal noise has its median absolute value here.
_MEDIAN_TO_STD: Final = 1.4826
_LEAST_GOOD: Final = 0.5


def robust_fit(rows: tuple[tuple[float, ...], ...], prior: Belief) -> Belief | None:
    """Return the belief that most rows agree on, or None if they do not.

    Args:
        rows: v, mean of v^2, y, variance of the noise of one, and how many times that it counts in the mean of many.
        prior: What is believed without them.

    """
    table = np.array(rows)
    Phi = np.column_stack([np.ones(len(table)), table[:, :2]])
    y, R, slow = table[:, 2], table[:, 3], table[:, 4]
    information, vector = _prior_information(prior)
    weights = np.ones(len(y))
    scale = 1.0
    for k in range(2 * _ROUNDS):
        share = weights / (R * slow * scale**2)
        theta = np.linalg.solve(information + Phi.T @ (share[:, None] * Phi), vector + Phi.T @ (share * y))
        z = np.abs(y - Phi @ theta) / np.sqrt(R)
        scale = max(1.0, _MEDIAN_TO_STD * float(np.median(z)))
        z = z / scale
        weights = np.minimum(1.0, _HUBER / np.maximum(z, 1e-9)) if k < _ROUNDS else _tukey(z)
    if np.mean(weights > 0.0) < _LEAST_GOOD or not np.isfinite(theta).all():
        return None
    share = weights / (R * slow * scale**2)
    P = np.linalg.inv(information + Phi.T @ (share[:, None] * Phi))
    a, b, c = map(float, theta)
    A, B, C, D, E, F = (float(P[i, j]) for i in range(3) for j in range(i, 3))
    return a, b, c, A, B, C, D, E, F


def _tukey(z: Array) -> Array:
    weights: Array = np.where(z < _TUKEY, (1.0 - (z / _TUKEY) ** 2) ** 2, 0.0)
    return weights


def _prior_information(prior: Belief) -> tuple[Array, Array]:
    a, b, c, A, B, C, D, E, F = prior
    information = np.linalg.inv(np.array([[A, B, C], [B, D, E], [C, E, F]]))
    return information, information @ np.array([a, b, c])
