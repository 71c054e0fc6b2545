# SPDX-License-Identifier: Apache-2.0
"""Results of an estimator: an estimate, or a rejection with its reason and numbers.

Field names of the estimates are those of the messages in ``trainid_msgs``; drivers copy them by name. Each field states
its unit and meaning in :class:`Quantity`: tables, replay and fleet loop over these, in the order of the fields.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, Final, Generic, NamedTuple, TypeVar

from trainid_ros.interface.state import stored


class Status(IntEnum):
    """Status of an estimate; the same numbers as in the messages."""

    UNINITIALIZED = 0
    CONVERGING = 1
    VALID = 2
    HOLDING = 3
    STALE = 4
    FAULT = 5

    @property
    def is_usable(self) -> bool:
        """True if a controller may use the estimate: VALID, or HOLDING while there is nothing to learn."""
        return self in {Status.VALID, Status.HOLDING}


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

    @property
    def text(self) -> str:
        """Return it as words, such as ``not braking``."""
        return self.name.lower().replace('_', ' ')


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


class Quantity(NamedTuple):
    """What a field of an estimate is."""

    unit: str  # Its unit, '1' for a ratio, '' for none
    text: str  # Its meaning
    is_parameter: bool = False  # Whether ``covariance`` holds its variance, in the order of such fields
    may_be_unknown: bool = False  # Whether it is NaN where an algorithm does not estimate it


_QUANTITY: Final = 'quantity'


def _is(unit: str, text: str, *, is_parameter: bool = False, may_be_unknown: bool = False) -> dict[str, Quantity]:
    return {_QUANTITY: Quantity(unit, text, is_parameter, may_be_unknown)}


def quantities(kind: type[Any]) -> dict[str, Quantity]:
    """Return what the fields of an estimate are, by name."""
    return {item.name: item.metadata[_QUANTITY] for item in fields(kind)}


def parameters(kind: type[Any]) -> tuple[str, ...]:
    """Return the names of the fields whose covariance an estimate states."""
    return tuple(name for name, quantity in quantities(kind).items() if quantity.is_parameter)


def deviations(covariance: Sequence[float]) -> list[float]:
    """Return the standard deviations of a covariance, row-major."""
    size = math.isqrt(len(covariance))
    return [math.sqrt(max(covariance[i * (size + 1)], 0.0)) for i in range(size)]


def deviation_of(estimate: Any, name: str) -> float:
    """Return the standard deviation of a field in its unit, NaN if the estimate states none."""
    names = parameters(type(estimate))
    if name in names:
        return deviations(estimate.covariance)[names.index(name)]
    return float(getattr(estimate, f'{name}_std', math.nan))


_W: Final = 'N/kN'
_WV: Final = 'N/kN per m/s'
_WV2: Final = 'N/kN per (m/s)^2'
_V: Final = 'm/s'
_TEST_RATIO: Final = 'squared innovation over gate^2 times its variance; above 1 the sample is rejected'
_INNOVATION_VARIANCE: Final = 'variance of innovation; 0 before the first update'


@dataclass(slots=True)
class ResistanceEstimate:
    """Running resistance w(v) = a + b v + c v^2 [N/kN, v in m/s]."""

    a: float = field(metadata=_is(_W, 'Davis parameter a', is_parameter=True))
    b: float = field(metadata=_is(_WV, 'Davis parameter b', is_parameter=True))
    c: float = field(metadata=_is(_WV2, 'Davis parameter c', is_parameter=True))
    covariance: tuple[float, ...] = field(metadata=_is('', 'covariance of (a, b, c), 3x3, row-major'))
    resistance: float = field(metadata=_is(_W, 'w at speed'))
    resistance_std: float = field(metadata=_is(_W, 'standard deviation of resistance'))
    speed: float = field(metadata=_is(_V, 'current speed'))
    innovation: float = field(metadata=_is(_W, 'innovation of the last update'))
    innovation_variance: float = field(metadata=_is('(N/kN)^2', _INNOVATION_VARIANCE))
    test_ratio: float = field(metadata=_is('1', _TEST_RATIO))
    speed_min: float = field(metadata=_is(_V, 'slowest speed learned from'))
    speed_max: float = field(metadata=_is(_V, 'fastest speed learned from'))  # 0 before the first
    resistance_std_max: float = field(
        metadata=_is(_W, 'largest standard deviation of w at the speeds learned from and at speed')
    )
    force_scale: float = field(metadata=_is('1', 'actual over reported specific force', may_be_unknown=True))
    force_scale_std: float = field(metadata=_is('1', 'standard deviation of force_scale', may_be_unknown=True))
    # > 0 if stamped too late
    force_delay: float = field(metadata=_is('s', 'delay of the stamps of the force', may_be_unknown=True))
    force_delay_std: float = field(metadata=_is('s', 'standard deviation of force_delay', may_be_unknown=True))

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
        self.a, self.b, self.c, self.covariance = a, b, c, covariance
        self.resistance, self.resistance_std, self.speed = resistance, resistance_std, speed
        self.innovation, self.innovation_variance, self.test_ratio = innovation, innovation_variance, test_ratio
        self.speed_min, self.speed_max, self.resistance_std_max = speed_min, speed_max, resistance_std_max
        self.force_scale, self.force_scale_std = force_scale, force_scale_std
        self.force_delay, self.force_delay_std = force_delay, force_delay_std


@dataclass(slots=True)
class SpeedModelEstimate:
    """Speed model x(n) = a1 x^2 + a2 x + b1 u + d0 of Yuan et al., eq. (2), and the physical values derived from it."""

    a1: float = field(metadata=_is('1/(m/s)', 'coefficient of the squared speed', is_parameter=True))
    a2: float = field(metadata=_is('1', 'coefficient of the speed', is_parameter=True))
    b1: float = field(metadata=_is('m/s per N/kN', 'coefficient of the specific force', is_parameter=True))
    d0: float = field(metadata=_is(_V, 'constant', is_parameter=True))
    covariance: tuple[float, ...] = field(metadata=_is('', 'covariance of (a1, a2, b1, d0), 4x4, row-major'))
    forgetting_factor: float = field(metadata=_is('1', 'forgetting factor, in (0, 1]'))
    predicted_speed: float = field(metadata=_is(_V, 'prediction one step ahead of the previous sample'))
    prediction_error: float = field(metadata=_is(_V, 'measured minus predicted speed'))
    # As stated before the measurement; 0 if the algorithm states none
    prediction_variance: float = field(metadata=_is('(m/s)^2', 'variance of prediction_error'))
    a: float = field(metadata=_is(_W, 'Davis parameter a derived from the model'))
    b: float = field(metadata=_is(_WV, 'Davis parameter b derived from the model'))
    c: float = field(metadata=_is(_WV2, 'Davis parameter c derived from the model'))
    # (M / M_nominal)(1 + gamma)
    mass_factor: float = field(metadata=_is('1', 'true over stated mass, with rotating masses, from the speed model'))

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
        self.a1, self.a2, self.b1, self.d0, self.covariance = a1, a2, b1, d0, covariance
        self.forgetting_factor, self.predicted_speed = forgetting_factor, predicted_speed
        self.prediction_error, self.prediction_variance = prediction_error, prediction_variance
        self.a, self.b, self.c, self.mass_factor = a, b, c, mass_factor


@dataclass(slots=True)
class BrakeRateEstimate:
    """Brake rate (actual over expected braking, 1 = nominal) and the filtered train state."""

    # Actual over expected braking
    brake_rate: float = field(metadata=_is('1', 'brake rate, 1 = nominal'))
    brake_rate_std: float = field(metadata=_is('1', 'standard deviation of brake_rate'))
    position: float = field(metadata=_is('m', 'filtered position along the line', may_be_unknown=True))
    speed: float = field(metadata=_is(_V, 'filtered speed'))
    control_acceleration: float = field(metadata=_is('m/s^2', 'present acceleration by the brake, <= 0'))
    filtered_target: float = field(metadata=_is('m/s^2', 'command after delay and lag of a nominal brake, <= 0'))
    effective_particles: float = field(metadata=_is('1', 'inverse of the sum of squared weights'))
    observable: bool = field(metadata=_is('', 'true while braking provides information on the brake rate'))
    innovation: float = field(metadata=_is(_V, 'speed innovation of the last update'))
    innovation_variance: float = field(metadata=_is('(m/s)^2', _INNOVATION_VARIANCE))
    test_ratio: float = field(metadata=_is('1', _TEST_RATIO))

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
        self.brake_rate, self.brake_rate_std = brake_rate, brake_rate_std
        self.position, self.speed = position, speed
        self.control_acceleration, self.filtered_target = control_acceleration, filtered_target
        self.effective_particles, self.observable = effective_particles, observable
        self.innovation, self.innovation_variance, self.test_ratio = innovation, innovation_variance, test_ratio


@dataclass(slots=True)
class AdhesionEstimate:
    """Adhesion between wheel and rail, over the weight of the whole train, and slip of the measured axle."""

    used: float = field(metadata=_is('1', 'force between wheel and rail over the weight of the train, now'))
    at_least: float = field(metadata=_is('1', 'most used without slip over the last km, and since the last slip'))
    adhesion: float = field(metadata=_is('1', 'adhesion; without slip over the last km that of dry to wet rail'))
    adhesion_std: float = field(metadata=_is('1', 'standard deviation of adhesion'))
    slip: float = field(metadata=_is('1', 'axle speed over train speed, less 1; > 0 under traction'))
    slipping: bool = field(metadata=_is('', 'true while the measured axle slips or slides'))
    slip_share: float = field(metadata=_is('1', 'share of the last km in which the axle slipped'))

    def __init__(
        self,
        used: float,
        at_least: float,
        adhesion: float,
        adhesion_std: float,
        slip: float,
        slipping: bool,
        slip_share: float,
    ) -> None:
        self.used, self.at_least, self.adhesion, self.adhesion_std = used, at_least, adhesion, adhesion_std
        self.slip, self.slipping, self.slip_share = slip, slipping, slip_share


def counters(kind: type[Any]) -> tuple[str, str]:
    """Return the names of the counters of used and rejected samples in the message of an estimate."""
    # The used adhesion is called so, too.
    return ('samples_used', 'samples_rejected') if kind is AdhesionEstimate else ('used', 'rejected')


Estimate = ResistanceEstimate | SpeedModelEstimate | BrakeRateEstimate | AdhesionEstimate

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
        self.stamp_ns, self.estimate, self.status = stamp_ns, estimate, status
        self.used, self.rejected, self.last_rejection = used, rejected, last_rejection

    def __repr__(self) -> str:
        """Return all fields."""
        return (
            f'Output(stamp_ns={self.stamp_ns}, estimate={self.estimate!r}, status={self.status!r}, used={self.used}, '
            f'rejected={self.rejected}, last_rejection={self.last_rejection!r})'
        )
