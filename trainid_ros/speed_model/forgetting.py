# SPDX-License-Identifier: Apache-2.0
"""Variable forgetting: eq. (6) of Yuan et al. 2017 on the running mean of the errors instead of on each error.

A single squared error shows noise, not a change: under white noise (6) forgets all the time (lambda = 1 - 1/sigma on
average) and does not detect a change that moves the speed by half a standard deviation. The errors of a correct
model are uncorrelated, so their running mean stays small; after a change they have the same sign.
"""

from __future__ import annotations

import math
from typing import Final

# Limit of one error, in standard deviations.
MOST: Final = 3.0


def running_mean(mean: float, z: float, share: float) -> float:
    """Return the running mean of errors in standard deviations [1] after one more error z of weight ``share``."""
    bounded = z if -MOST < z < MOST else math.copysign(MOST, z)
    return mean + share * (bounded - mean)


def forgetting_factor(chi2: float, threshold: float, scale: float, low: float) -> float:
    """Return lambda = 1 - (chi2 - threshold) / scale in [low, 1]; chi2 has mean 1 while the model is correct."""
    if chi2 <= threshold:
        return 1.0
    # Eq. (6) with chi2 - threshold instead of the squared error.
    lam = 1.0 - (chi2 - threshold) / scale
    return max(lam, low)
