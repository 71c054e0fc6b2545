# SPDX-License-Identifier: Apache-2.0
"""Parameters in the fields of an estimate, which may be a message."""

from __future__ import annotations

import math
from typing import Any

from trainid_ros.client.file_values import BRAKE_RATE, DAVIS, FORCE_SCALE
from trainid_ros.client.gradual import Normal


def resistance_values(estimate: Any) -> dict[str, Normal]:
    """Return (a, b, c), and the force scale where it is estimated."""
    values = {DAVIS: Normal((estimate.a, estimate.b, estimate.c), tuple(map(float, estimate.covariance)))}
    if not math.isnan(estimate.force_scale):
        values[FORCE_SCALE] = _factor(estimate.force_scale, estimate.force_scale_std)
    return values


def brake_rate_values(estimate: Any) -> dict[str, Normal]:
    """Return the brake rate."""
    return {BRAKE_RATE: _factor(estimate.brake_rate, estimate.brake_rate_std)}


def _factor(value: float, std: float) -> Normal:
    """Return a factor; a negative standard deviation gives a negative variance, which is not possible."""
    return Normal((value,), (math.copysign(std * std, std),))
