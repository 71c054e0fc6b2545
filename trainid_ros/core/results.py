# SPDX-License-Identifier: Apache-2.0
"""What an estimator answers: an estimate, or a refusal with its reason and numbers.

Field names of the estimates are those of the messages in ``trainid_msgs``; drivers copy
them by name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum


class Status(IntEnum):
    """Health of an estimate; the same numbers as in the messages."""

    UNINITIALIZED = 0
    CONVERGING = 1
    VALID = 2
    HOLDING = 3
    STALE = 4
    FAULT = 5


class Reason(IntEnum):
    """Why a record or a sample was not used; the same numbers as in the messages."""

    NONE = 0
    NOT_FINITE = 1
    OUT_OF_RANGE = 2
    ZERO_STAMP = 3
    LATE = 4
    DUPLICATE = 5
    STAMP_JUMP = 6
    GAP = 7
    FORCE_MISSING = 8
    GRADIENT_MISSING = 9
    BRAKE_COMMAND_MISSING = 10
    STANDSTILL = 11
    BRAKING = 12
    NOT_BRAKING = 13
    SPEED_INCONSISTENT = 14
    OUTLIER = 15
    NUMERICAL = 16
    THINNED = 17
    BRAKE_UNCERTAIN = 18
    SPEED_STUCK = 19


@dataclass(frozen=True, slots=True)
class Rejection:
    """A sample that was not used: the reason, the value that offended and the limit it broke."""

    stamp_ns: int
    reason: Reason
    value: float
    limit: float

    def __str__(self) -> str:
        """Return the reason with its numbers, for people."""
        if math.isnan(self.value):
            return self.reason.name
        return f'{self.reason.name} (value {self.value:.6g}, limit {self.limit:.6g})'


@dataclass(frozen=True, slots=True)
class ResistanceEstimate:
    """Davis parameters w(v) = a + b v + c v^2 [N/kN, v in m/s] with their covariance (3x3, row-major).

    ``force_scale`` is actual over reported specific force (force over weight), ``force_delay`` how much later than
    the force its stamps are [s]; both NaN where the algorithm does not estimate them.
    """

    a: float
    b: float
    c: float
    covariance: tuple[float, ...]
    resistance: float
    resistance_std: float
    speed: float
    innovation: float
    innovation_variance: float
    test_ratio: float
    speed_min: float
    speed_max: float
    force_scale: float = math.nan
    force_scale_std: float = math.nan
    force_delay: float = math.nan
    force_delay_std: float = math.nan


@dataclass(frozen=True, slots=True)
class SpeedModelEstimate:
    """Speed model x(n) = a1 x^2 + a2 x + b1 u + d0 of Yuan et al., eq. (2), and what it means.

    ``covariance`` is 4x4 row-major in the order a1, a2, b1, d0. ``a b c`` are the Davis parameters
    [N/kN] and ``mass_factor`` is (M / M_nominal)(1 + gamma). ``prediction_variance`` is that of
    ``prediction_error`` as stated before the measurement, 0 if the algorithm states none.
    """

    a1: float
    a2: float
    b1: float
    d0: float
    covariance: tuple[float, ...]
    forgetting_factor: float
    predicted_speed: float
    prediction_error: float
    a: float
    b: float
    c: float
    mass_factor: float
    prediction_variance: float = 0.0


@dataclass(frozen=True, slots=True)
class BrakeRateEstimate:
    """Brake rate (actual over expected braking, 1 = nominal) and the filtered train state."""

    brake_rate: float
    brake_rate_std: float
    position: float
    speed: float
    control_acceleration: float
    filtered_target: float
    effective_particles: float
    observable: bool
    innovation: float
    innovation_variance: float
    test_ratio: float


Estimate = ResistanceEstimate | SpeedModelEstimate | BrakeRateEstimate


def stated_innovation(estimate: Estimate) -> tuple[float, float]:
    """Return the innovation of the last update and its variance as the estimator states it, 0 if it states none."""
    if isinstance(estimate, SpeedModelEstimate):
        return estimate.prediction_error, estimate.prediction_variance
    return estimate.innovation, estimate.innovation_variance
