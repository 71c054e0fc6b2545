# SPDX-License-Identifier: Apache-2.0
"""Prior uncertainty of the Davis parameters of the train file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class PriorSettings(Protocol):
    """Settings of an estimator's prior standard deviations: a share of the train file's values, and floors."""

    @property
    def prior_share(self) -> float:
        """Prior standard deviation of a, b, c as a share of the train file's values [1]."""

    @property
    def prior_std_a(self) -> float:
        """Floor of the standard deviation of a [N/kN]."""

    @property
    def prior_std_b(self) -> float:
        """Floor of the standard deviation of b [N/kN per m/s]."""

    @property
    def prior_std_c(self) -> float:
        """Floor of the standard deviation of c [N/kN per (m/s)^2]."""


def prior_variances(davis: tuple[float, float, float], settings: PriorSettings) -> tuple[float, float, float]:
    """Return the prior variances of (a, b, c) by an estimator's settings, in the squared units of the parameters."""
    floors = (settings.prior_std_a, settings.prior_std_b, settings.prior_std_c)
    a, b, c = np.diag(davis_prior(davis, settings.prior_share, floors)).tolist()
    return a, b, c


def davis_prior(
    davis: tuple[float, float, float], share: float, floors: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return the prior covariance of (a, b, c), shape (3, 3), diagonal, in the units of N/kN and m/s.

    Trains differ by decades in c and in a, so the standard deviation is a share of the train file's value; the floors
    keep a parameter free whose value there is zero.
    """
    P0: NDArray[np.float64] = np.diag(np.square(share * np.array(davis)) + np.square(floors))
    return P0
