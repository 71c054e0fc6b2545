# SPDX-License-Identifier: Apache-2.0
"""Trajectory fit over a window of a few dozen rows, in one linear step.

In time the balance of Xia et al. 2023 (3) is linear in a, b, c for given speeds. The speed that the known force alone
would give is subtracted; the *residual speed* is then ``r_i = r_0 - (a S0 + b S1 + c S2)``, with S_n the sums of
v^n dt / inertia. A row is the mean of r and of the sums over a few samples. Rows of one piece share a free r_0, and
their errors are white noise plus a random walk (gusts, map), so each piece is whitened by one triangular matrix.
A Gaussian prior replaces the box constraints of the paper: with 20 rows alone the error of w(v) is 3 N/kN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, groupby
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

# Typical sizes of a, b, c, force delay and force gain.
SCALE: Final = np.array([1.0, 0.02, 0.001, 0.05, 0.005])
# Typical sizes of all columns of a row, the residual speed last, and of a, b, c alone.
_COLUMNS: Final = np.append(SCALE, 1.0)
_SCALE_ABC: Final = SCALE[:3, None]
_UPPER: Final = np.triu(np.ones((5, 5)))
# Prior std of the free initial speed, in standard deviations of a row: large relative to any residual speed.
_FREE: Final = 1e4
# Noise ratios are quantised to this many steps per factor e; each has its own whitening matrix.
_STEPS_PER_E: Final = 8.0
# Minimum number of rows after a change.
_MIN_ROWS: Final = 5


@dataclass(frozen=True, slots=True)
class Row:
    """One row: mean of a few samples of one piece."""

    piece: int  # Index of the piece
    rest: float  # Residual speed [m/s]
    sums: tuple[float, ...]  # Regressors of a, b, c, force delay and force gain [m/s per unit of the parameter]
    speed_min: float  # Slowest speed of its samples [m/s]
    speed_max: float  # Fastest speed of its samples [m/s]


@dataclass(frozen=True, slots=True)
class RowNoise:
    """Standard deviation of one row, and of the random walk from row to row [m/s]."""

    std: float
    walk: float


@dataclass(frozen=True, slots=True)
class WindowPosterior:
    """a, b, c [N/kN, v in m/s] and their covariance, row-major."""

    theta: tuple[float, ...]
    P: tuple[float, ...]

    def resistance(self, speed: float) -> tuple[float, float]:
        """Return w [N/kN] and its variance [(N/kN)^2] at a speed [m/s]."""
        (a, b, c), P, v = self.theta, self.P, speed
        variance = P[0] + v * (2.0 * P[1] + v * (2.0 * P[2] + P[4] + v * (2.0 * P[5] + v * P[8])))
        return a + v * (b + v * c), max(0.0, variance)


@dataclass(frozen=True, slots=True)
class WindowPrior:
    """Prior means of a, b, c [N/kN, v in m/s]; prior stds of them, of the force delay [s] and of its gain [1]."""

    theta: tuple[float, float, float]
    std: tuple[float, float, float, float, float]


def fit_rows(rows: Sequence[Row], noise: RowNoise, prior: WindowPrior) -> WindowPosterior:
    """Return the posterior of a, b, c after a window of rows, oldest first."""
    return _posterior(_whitened(rows, noise), prior)[0]


def newest_regime(
    rows: Sequence[Row], noise: RowNoise, prior: WindowPrior, known: WindowPosterior
) -> tuple[int, WindowPosterior]:
    """Locate the change of a, b, c by the least sum of squares over all splits of a window.

    Args:
        rows: Window that contains the change.
        noise: Noise of the rows.
        prior: Prior after the change.
        known: Posterior before the change.

    Returns:
        The number of rows after the change, and their posterior.

    """
    splits = range(_MIN_ROWS, len(rows) + 1)
    theta = np.array((*known.theta, 0.0, 0.0))
    costs, posteriors = [], []
    for count in splits:
        posterior, after = _posterior(_whitened(rows[-count:], noise), prior)
        before = _whitened(rows[:-count], noise)
        left = before[:, 5] - before[:, :5] @ theta
        costs.append(after + float(left @ left))
        posteriors.append(posterior)
    best = int(np.argmin(costs))
    return splits[best], posteriors[best]


def _posterior(white: NDArray[np.float64], prior: WindowPrior) -> tuple[WindowPosterior, float]:
    """Return the posterior and the remaining sum of squares."""
    count = len(white)
    # The raw mode returns R with the reflectors below its diagonal; masking them here is faster than mode='r'.
    R = np.linalg.qr(np.concatenate((white * _COLUMNS, _prior_rows(prior))), mode='raw')[0].T
    inverse = _SCALE_ABC * np.linalg.inv(_UPPER * R[:5, :5])[:3]
    theta, P = inverse @ R[:5, 5], inverse @ inverse.T
    posterior = WindowPosterior(tuple(theta.tolist()), tuple(P.ravel().tolist()))
    return posterior, float(R[5, 5]) ** 2 if count else 0.0


@lru_cache(maxsize=16)
def _prior_rows(prior: WindowPrior) -> NDArray[np.float64]:
    """Return the prior as additional rows in the units of SCALE, shape (5, 6)."""
    weights = SCALE / np.array(prior.std)
    rows = np.column_stack((np.diag(weights), weights * np.array((*prior.theta, 0.0, 0.0)) / SCALE))
    rows.flags.writeable = False
    return rows


def _whitened(rows: Sequence[Row], noise: RowNoise) -> NDArray[np.float64]:
    """Return regressors and residual speeds with independent errors of unit variance, shape (n, 6)."""
    numbers = chain.from_iterable((*row.sums, row.rest) for row in rows)
    raw = np.fromiter(numbers, float, 6 * len(rows)).reshape(-1, 6)
    step = round(2.0 * _STEPS_PER_E * math.log(max(noise.walk, 1e-12) / noise.std))
    begin = 0
    for _, piece in groupby([row.piece for row in rows]):
        end = begin + sum(1 for _ in piece)
        part = raw[begin:end]
        raw[begin:end] = whitener(end - begin, step) @ (part - part[0])
        begin = end
    raw /= noise.std
    return raw


@lru_cache(maxsize=256)
def whitener(count: int, step: int) -> NDArray[np.float64]:
    """Return L^-1 for the covariance ``L L' = I + q min(i, j) + free level`` of a piece, shape (n, n).

    Args:
        count: Number of rows n.
        step: Logarithm of q, in steps.

    """
    index = np.arange(count)
    q = float(np.exp(step / _STEPS_PER_E))
    R = np.eye(count) + q * np.minimum.outer(index, index) + _FREE**2
    inverse: NDArray[np.float64] = np.linalg.inv(np.linalg.cholesky(R))
    inverse.flags.writeable = False
    return inverse
