# SPDX-License-Identifier: Apache-2.0
"""Robust variances from medians of increments."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.resistance.trajectory.pieces import Trajectory

# Ratio of the standard deviation to the median absolute deviation of a Gaussian.
_MAD: Final = 1.4826
# Median absolute difference of two rounding errors, in quanta.
_ROUNDED: Final = 1.0 - math.sqrt(0.5)
# Share of steps of a rounded speed that are not whole multiples of its quantum, due to errors of single messages.
_STRAY_STEPS: Final = 0.05


def half_variance(y: NDArray[np.float64], piece: NDArray[np.intp], lag: int) -> float:
    """Return half the variance of increments over a lag within pieces; for white noise this is its variance.

    Args:
        y: A signal, shape (n,).
        piece: Index of the piece of each value, shape (n,).
        lag: Lag in values; at least one piece must be longer.

    """
    change = np.abs(y[lag:] - y[:-lag])[piece[lag:] == piece[:-lag]]
    middle = change.size // 2
    return 0.5 * (_MAD * float(np.partition(change, middle)[middle])) ** 2


def rounding_variance(given: Trajectory) -> float:
    """Return the :func:`half_variance` of rounding alone, for lags over which speed changes many quanta [(m/s)^2].

    The quantum is the smallest step of the measured speed, except for a few percent of the steps. With fine rounding
    the result is less than the noise.
    """
    steps = np.abs(np.diff(given.speed))[given.dt[1:] > 0.0]
    steps = steps[steps > 0.0]
    quantum = float(np.quantile(steps, _STRAY_STEPS)) if steps.size else 0.0
    return 0.5 * (_MAD * _ROUNDED * quantum) ** 2
