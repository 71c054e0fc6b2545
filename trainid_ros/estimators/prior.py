# SPDX-License-Identifier: Apache-2.0
"""How far the believed Davis parameters may be off."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def davis_prior(
    davis: tuple[float, float, float], share: float, floors: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return the prior covariance of (a, b, c), shape (3, 3), diagonal.

    Trains differ by decades in c and in a, so the doubt is a share of the believed value; the floors keep
    a parameter free whose believed value is zero.
    """
    P0: NDArray[np.float64] = np.diag(np.square(share * np.array(davis)) + np.square(floors))
    return P0
