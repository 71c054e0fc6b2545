# SPDX-License-Identifier: Apache-2.0
"""Particle weights from the log domain, and the state of the random generator."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

import numpy as np

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray


def normal_weights(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights that sum to one; equal weights if all log-weights are -inf."""
    peak = float(log_weights.max())
    if not math.isfinite(peak):
        return np.full(log_weights.shape, 1.0 / log_weights.size)
    weights = log_weights - peak
    np.exp(weights, out=weights)
    weights /= weights.sum()
    return weights


def effective_number(weights: NDArray[np.float64]) -> float:
    """Return 1 / sum of squared normalised weights [1]; Zheng et al. print it with unnormalised weights."""
    flat = weights.ravel()
    return 1.0 / float(flat.dot(flat))


def restore_generator(rng: np.random.Generator, text: str, kind: str) -> None:
    """Restore a generator from JSON text; raise InputError, naming the ``kind`` of state, if it is invalid."""
    try:
        rng.bit_generator.state = json.loads(text)
    except (ValueError, TypeError, KeyError) as error:
        msg = f'saved {kind}: random cannot be read: {error}'
        raise InputError(msg) from None
