# SPDX-License-Identifier: Apache-2.0
"""Recursions over stages as banded systems: one LAPACK call instead of a loop over stages."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dptsv, dtbtrs

from trainid_ros.errors import NoAnswerError

if TYPE_CHECKING:
    from numpy.typing import NDArray


def recur(k: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve ``x_i = k_i x_{i-1} + r_i``, x_0 = 0, for several right-hand sides.

    Args:
        k: Coefficients of stages 1 to I, shape (I,); the first is not used.
        rows: Right-hand sides, shape (m, I).

    Returns:
        x_1 to x_I for each right-hand side, shape (m, I).

    """
    band = np.ones((2, k.size))
    band[1, :-1] = -k[1:]
    # Rows in C order are columns in Fortran order, so only the result is copied.
    x, _ = dtbtrs(band, rows.T, uplo='L', diag='U')
    result: NDArray[np.float64] = x.T
    return result


def solve_tridiagonal(
    diagonal: NDArray[np.float64], below: NDArray[np.float64], rows: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve a symmetric positive definite tridiagonal system for several right-hand sides, shape (m, n).

    Raises:
        NoAnswerError: The system is not positive definite.

    """
    _, _, x, info = dptsv(diagonal, below, rows.T)
    if info != 0:
        msg = 'speeds and forces do not determine a trajectory'
        raise NoAnswerError(msg)
    result: NDArray[np.float64] = x.T
    return result
