# SPDX-License-Identifier: Apache-2.0
"""How far the believed Davis parameters may be off."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class PriorSettings(Protocol):
    """The settings by which every estimator states its doubt: a share of the belief, and floors."""

    @property
    def prior_share(self) -> float:
        """Prior standard deviation of a, b, c as a share of their believed values."""

    @property
    def prior_std_a(self) -> float:
        """Floor for a [N/kN]."""

    @property
    def prior_std_b(self) -> float:
        """Floor for b [N/kN per m/s]."""

    @property
    def prior_std_c(self) -> float:
        """Floor for c [N/kN per (m/s)^2]."""


def prior_variances(davis: tuple[float, float, float], settings: PriorSettings) -> tuple[float, float, float]:
    """Return the prior variances of (a, b, c) that an estimator's settings ask for."""
    floors = (settings.prior_std_a, settings.prior_std_b, settings.prior_std_c)
    a, b, c = np.diag(davis_prior(davis, settings.prior_share, floors)).tolist()
    return a, b, c


def davis_prior(
    davis: tuple[float, float, float], share: float, floors: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return the prior covariance of (a, b, c), shape (3, 3), diagonal.

    Trains differ by decades in c and in a, so the doubt is a share of the believed value; the floors keep
    a parameter free whose believed value is zero.
    """
    P0: NDArray[np.float64] = np.diag(np.square(share * np.array(davis)) + np.square(floors))
    return P0
