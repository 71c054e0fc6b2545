# SPDX-License-Identifier: Apache-2.0
"""When a resistance is fit to use: known well enough over the speeds seen, and for as long as it nearly is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

# An estimate that is fit stays so up to this multiple of the limit: it must not flicker.
_HYSTERESIS: Final = 1.5
_SECONDS_PER_HOUR: Final = 3600.0


def is_fit(variance: Callable[[float], float], speeds: tuple[float, float], valid_std: float, *, was_fit: bool) -> bool:
    """Return whether the resistance is known well enough over the speeds seen, in root mean square.

    Args:
        variance: Variance of the resistance at a speed [(N/kN)^2].
        speeds: Slowest and fastest speed seen [m/s].
        valid_std: Largest standard deviation of a resistance that is fit to use [N/kN].
        was_fit: Whether it was fit so far.

    """
    slowest, fastest = speeds
    at = (slowest, 0.5 * (slowest + fastest), fastest)
    rms = math.sqrt(sum(map(variance, at)) / len(at))
    return rms < valid_std * (_HYSTERESIS if was_fit else 1.0)


def drift_rates(share: float, prior: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the growth of three variances per second.

    Args:
        share: Drift in one hour, standard deviation as a share of the prior one.
        prior: Variances of the prior.

    """
    growth = share**2 / _SECONDS_PER_HOUR
    a, b, c = prior
    return growth * a, growth * b, growth * c
