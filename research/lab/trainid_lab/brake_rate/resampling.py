# SPDX-License-Identifier: Apache-2.0
"""Particle weights and systematic resampling."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def normalise(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log-weights whose exponentials sum to one; equal weights if all are -inf."""
    peak = float(np.max(log_weights))
    if not np.isfinite(peak):
        return np.full(len(log_weights), -np.log(len(log_weights)))
    shifted = log_weights - peak
    normal: NDArray[np.float64] = shifted - np.log(np.sum(np.exp(shifted)))
    return normal


def systematic(weights: NDArray[np.float64], count: int, uniform: float) -> NDArray[np.intp]:
    """Return ``count`` ancestor indices, shape (count,), from one uniform draw in [0, 1).

    Unbiased, unlike keeping the largest weights. The index is clamped because the cumulated weights can
    end below one by rounding.
    """
    positions = (np.arange(count) + uniform) / count
    ancestors = np.searchsorted(np.cumsum(weights), positions, side='right')
    return np.minimum(ancestors, len(weights) - 1)


def normal_weights(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights that sum to one; equal weights if all log-weights are -inf."""
    peak = float(log_weights.max())
    if not math.isfinite(peak):
        return np.full(log_weights.shape, 1.0 / log_weights.size)
    weights: NDArray[np.float64] = np.exp(log_weights - peak)
    weights /= weights.sum()
    return weights


def effective_number(weights: NDArray[np.float64]) -> float:
    """Return 1 / sum of squared normalised weights [1]; Zheng et al. print it with unnormalised weights."""
    return 1.0 / float(weights.dot(weights))
