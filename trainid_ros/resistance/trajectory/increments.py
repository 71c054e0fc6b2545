# SPDX-License-Identifier: Apache-2.0
"""Variances from medians of increments, which gross errors hardly move."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.resistance.trajectory.pieces import Trajectory

_MAD: Final = 1.4826
# Median of the difference of two roundings, in quanta.
_ROUNDED: Final = 1.0 - math.sqrt(0.5)
# Steps of a rounded speed that are no whole numbers of its quantum: errors of single messages.
_STRAY_STEPS: Final = 0.05


def half_variance(y: NDArray[np.float64], piece: NDArray[np.intp], lag: int) -> float:
    """Return half the variance of increments over a lag within pieces; of white noise its variance.

    Args:
        y: A signal, shape (n,).
        piece: Number of the piece of each value, shape (n,).
        lag: Distance of the values; some piece must be longer.

    """
    change = np.abs(y[lag:] - y[:-lag])[piece[lag:] == piece[:-lag]]
    middle = change.size // 2
    return 0.5 * (_MAD * float(np.partition(change, middle)[middle])) ** 2


def rounding_variance(given: Trajectory) -> float:
    """Return what :func:`half_variance` makes of rounding alone, over lags of many quanta [(m/s)^2].

    The quantum is the smallest step of the measured speed, but for a few. Where rounding is fine, that is less than
    the noise.
    """
    steps = np.abs(np.diff(given.speed))[given.dt[1:] > 0.0]
    steps = steps[steps > 0.0]
    quantum = float(np.quantile(steps, _STRAY_STEPS)) if steps.size else 0.0
    return 0.5 * (_MAD * _ROUNDED * quantum) ** 2
