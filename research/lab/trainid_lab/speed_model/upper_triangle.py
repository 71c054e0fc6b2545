# SPDX-License-Identifier: Apache-2.0
"""Upper triangle of a covariance, as :mod:`trainid_ros.speed_model.am_vff_rls` stores it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from trainid_ros.speed_model.am_vff_rls import Symmetric

UPPER: Final = tuple((i, j) for i in range(4) for j in range(i, 4))


def upper(matrix: NDArray[np.float64]) -> Symmetric:
    """Return the upper triangle of a symmetric matrix, shape (4, 4)."""
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = (float(matrix[i, j]) for i, j in UPPER)
    return s11, s12, s13, s14, s22, s23, s24, s33, s34, s44
