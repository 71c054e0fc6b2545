# SPDX-License-Identifier: Apache-2.0
"""Results of an estimator: an estimate, or a rejection with its reason and numbers.

Field names of the estimates are those of the messages in ``trainid_msgs``; drivers copy
them by name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, TypeVar

from trainid_ros.interface.state import stored


class Status(IntEnum):
    """Status of an estimate; the same numbers as in the messages."""

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
    CONTRADICTION = 20

    # Reasons are counted; that of an enumeration hashes the name.
    __hash__ = int.__hash__


# The constructor that a dataclass writes for itself is interpreted, and takes 2 us where these classes are compiled.
# They are made for every sample, so they have constructors of their own; none is changed after that.


@dataclass(slots=True)
class Rejection:
    """A record or sample that was not used: the reason, the offending value and the limit it violated."""

    stamp_ns: int
    reason: Reason
    value: float = stored(may_be_nan=True)
    limit: float = stored(may_be_nan=True)

    def __init__(self, stamp_ns: int, reason: Reason, value: float, limit: float) -> None:
        self.stamp_ns = stamp_ns
        self.reason = reason
        self.value = value
        self.limit = limit

    def __str__(self) -> str:
        """Return the reason with its numbers as text."""
        if math.isnan(self.value):
            return self.reason.name
        return f'{self.reason.name} (value {self.value:.6g}, limit {self.limit:.6g})'


@dataclass(slots=True)
class ResistanceEstimate:
    """Running resistance w(v) = a + b v + c v^2 [N/kN, v in m/s]."""

    a: float  # Davis parameter a [N/kN]
    b: float  # Davis parameter b [N/kN per m/s]
    c: float  # Davis parameter c [N/kN per (m/s)^2]
    covariance: tuple[float, ...]  # Of (a, b, c), 3x3, row-major
    resistance: float  # w at ``speed`` [N/kN]
    resistance_std: float  # Standard deviation of ``resistance`` [N/kN]
    speed: float  # Current speed [m/s]
    innovation: float  # Innovation of the last update [N/kN]
    innovation_variance: float  # Its variance [(N/kN)^2]; 0 before the first update
    test_ratio: float  # Squared innovation over gate^2 times its variance [1]; above 1 the sample is rejected
    speed_min: float  # Slowest speed learned from [m/s]
    speed_max: float  # Fastest speed learned from [m/s]; 0 before the first
    resistance_std_max: float  # Largest standard deviation of w at the speeds learned from and at ``speed`` [N/kN]
    force_scale: float = math.nan  # Actual over reported specific force (force over weight) [1]; NaN if not estimated
    force_scale_std: float = math.nan  # Standard deviation of ``force_scale`` [1]; NaN if not estimated
    force_delay: float = math.nan  # Delay of the stamps of the force [s], > 0 if stamped too late; NaN if not estimated
    force_delay_std: float = math.nan  # Standard deviation of ``force_delay`` [s]; NaN if not estimated

    def __init__(
        self,
        a: float,
        b: float,
        c: float,
        covariance: tuple[float, ...],
        resistance: float,
        resistance_std: float,
        speed: float,
        innovation: float,
        innovation_variance: float,
        test_ratio: float,
        speed_min: float,
        speed_max: float,
        resistance_std_max: float,
        force_scale: float = math.nan,
        force_scale_std: float = math.nan,
        force_delay: float = math.nan,
        force_delay_std: float = math.nan,
    ) -> None:
        self.a = a
        self.b = b
        self.c = c
        self.covariance = covariance
        self.resistance = resistance
        self.resistance_std = resistance_std
        self.speed = speed
        self.innovation = innovation
        self.innovation_variance = innovation_variance
        self.test_ratio = test_ratio
        self.speed_min = speed_min
        self.speed_max = speed_max
        self.resistance_std_max = resistance_std_max
        self.force_scale = force_scale
        self.force_scale_std = force_scale_std
        self.force_delay = force_delay
        self.force_delay_std = force_delay_std


@dataclass(slots=True)
class SpeedModelEstimate:
    """Speed model x(n) = a1 x^2 + a2 x + b1 u + d0 of Yuan et al., eq. (2), and the physical values derived from it."""

    a1: float  # Coefficient of the squared speed [1/(m/s)]
    a2: float  # Coefficient of the speed [1]
    b1: float  # Coefficient of the specific force [m/s per N/kN]
    d0: float  # Constant [m/s]
    covariance: tuple[float, ...]  # Of (a1, a2, b1, d0), 4x4, row-major
    forgetting_factor: float  # In (0, 1] [1]
    predicted_speed: float  # Prediction one step ahead of the previous sample [m/s]
    prediction_error: float  # Measured minus predicted speed [m/s]
    a: float  # Davis parameter a derived from the model [N/kN]
    b: float  # Davis parameter b derived from the model [N/kN per m/s]
    c: float  # Davis parameter c derived from the model [N/kN per (m/s)^2]
    mass_factor: float  # (M / M_nominal)(1 + gamma) derived from the model [1]
    # Variance of ``prediction_error`` as stated before the measurement [(m/s)^2]; 0 if the algorithm states none
    prediction_variance: float = 0.0

    def __init__(
        self,
        a1: float,
        a2: float,
        b1: float,
        d0: float,
        covariance: tuple[float, ...],
        forgetting_factor: float,
        predicted_speed: float,
        prediction_error: float,
        a: float,
        b: float,
        c: float,
        mass_factor: float,
        prediction_variance: float = 0.0,
    ) -> None:
        self.a1 = a1
        self.a2 = a2
        self.b1 = b1
        self.d0 = d0
        self.covariance = covariance
        self.forgetting_factor = forgetting_factor
        self.predicted_speed = predicted_speed
        self.prediction_error = prediction_error
        self.a = a
        self.b = b
        self.c = c
        self.mass_factor = mass_factor
        self.prediction_variance = prediction_variance


@dataclass(slots=True)
class BrakeRateEstimate:
    """Brake rate (actual over expected braking, 1 = nominal) and the filtered train state."""

    brake_rate: float  # Brake rate [1]
    brake_rate_std: float  # Its standard deviation [1]
    position: float  # Filtered position along the line [m], NaN if unknown
    speed: float  # Filtered speed [m/s]
    control_acceleration: float  # Present acceleration by the brake [m/s^2, <= 0]
    filtered_target: float  # Command after delay and lag of a nominal brake [m/s^2, <= 0]
    effective_particles: float  # Inverse of the sum of squared weights [1]
    observable: bool  # True while braking provides information on the brake rate
    innovation: float  # Speed innovation of the last update [m/s]
    innovation_variance: float  # Its variance [(m/s)^2]; 0 before the first update
    test_ratio: float  # Squared innovation over gate^2 times its variance [1]; above 1 the sample is rejected

    def __init__(
        self,
        brake_rate: float,
        brake_rate_std: float,
        position: float,
        speed: float,
        control_acceleration: float,
        filtered_target: float,
        effective_particles: float,
        observable: bool,
        innovation: float,
        innovation_variance: float,
        test_ratio: float,
    ) -> None:
        self.brake_rate = brake_rate
        self.brake_rate_std = brake_rate_std
        self.position = position
        self.speed = speed
        self.control_acceleration = control_acceleration
        self.filtered_target = filtered_target
        self.effective_particles = effective_particles
        self.observable = observable
        self.innovation = innovation
        self.innovation_variance = innovation_variance
        self.test_ratio = test_ratio


Estimate = ResistanceEstimate | SpeedModelEstimate | BrakeRateEstimate

EstimateT = TypeVar('EstimateT', bound=Estimate)


class Output(Generic[EstimateT]):
    """What a driver publishes for one sample.

    Attributes:
        stamp_ns: Stamp of the newest sample used [ns].
        estimate: The estimate after that sample.
        status: Its status.
        used: Samples taken in by the estimator since the last reset.
        rejected: Records and samples not used since the last reset.
        last_rejection: The newest rejection, None if there was none.

    """

    def __init__(
        self,
        stamp_ns: int,
        estimate: EstimateT,
        status: Status,
        used: int,
        rejected: int,
        last_rejection: Rejection | None,
    ) -> None:
        self.stamp_ns = stamp_ns
        self.estimate = estimate
        self.status = status
        self.used = used
        self.rejected = rejected
        self.last_rejection = last_rejection

    def __repr__(self) -> str:
        """Return all fields."""
        return (
            f'Output(stamp_ns={self.stamp_ns}, estimate={self.estimate!r}, status={self.status!r}, used={self.used}, '
            f'rejected={self.rejected}, last_rejection={self.last_rejection!r})'
        )
