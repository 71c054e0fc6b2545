# SPDX-License-Identifier: Apache-2.0
"""How much to forget: eq. (6) of Yuan et al. 2017 on errors that agree, instead of on each error alone.

One squared error tells noise, not change: under white noise (6) forgets all the time (lambda = 1 - 1/sigma on the
mean), and a change that moves the speed by half a standard deviation goes unseen in it. Errors of a right model
are uncorrelated, so their running mean stays small; a change makes them agree in sign.
"""

from __future__ import annotations

import math
from typing import Final

# One error counts for no more standard deviations than this.
MOST: Final = 3.0


def agreement(mean: float, z: float, share: float) -> float:
    """Return the running mean of errors in standard deviations with one more, which counts by ``share``."""
    bounded = z if -MOST < z < MOST else math.copysign(MOST, z)
    return mean + share * (bounded - mean)


def forgetting_factor(chi2: float, threshold: float, scale: float, low: float) -> float:
    """Return lambda = 1 - (chi2 - threshold) / scale in [low, 1]; chi2 has the mean 1 while the model is right."""
    if chi2 <= threshold:
        return 1.0
    lam = 1.0 - (chi2 - threshold) / scale
    return max(lam, low)
