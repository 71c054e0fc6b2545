# SPDX-License-Identifier: Apache-2.0
"""Input messages as plain values: one record per message, times in integer nanoseconds.

Signs and units follow the interface: SI, gradient in per mille and positive uphill in the
direction of travel, force at the wheel rim positive in traction, NaN for unknown values.

How messages map to records and outputs, by field name; the same for the classes of ROS and of rosbags.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Final, TypeAlias

from trainid_ros.interface.results import (
    AdhesionEstimate,
    BrakeRateEstimate,
    Estimate,
    Output,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
    counters,
    quantities,
)

Value = float | bool | int | str | list[float]

NS_PER_S: Final = 1_000_000_000
DAY_NS: Final = 86_400 * NS_PER_S
KM_H: Final = 3.6
"""A speed of 1 m/s [km/h]."""


# Places of the topics in INPUT_TOPICS.
SPEED: Final = 0
FORCE: Final = 1
GRADIENT: Final = 2
BRAKE: Final = 3
MASS: Final = 4

Row: TypeAlias = tuple[int, int, float, float, bool]
"""A record as numbers: topic (its place in INPUT_TOPICS), stamp, first number, second number (0 without) and flag."""


@dataclass(frozen=True, slots=True)
class SpeedRecord:
    """Measured speed [m/s, >= 0] and position along the line [m, NaN if unknown]."""

    stamp_ns: int
    speed: float
    position: float

    def row(self) -> Row:
        """Return the record as a row of numbers."""
        return SPEED, self.stamp_ns, self.speed, self.position, False


@dataclass(frozen=True, slots=True)
class ForceRecord:
    """Wheel-rim force reported by drive and brake control [N]."""

    stamp_ns: int
    force: float

    def row(self) -> Row:
        """Return the record as a row of numbers."""
        return FORCE, self.stamp_ns, self.force, 0.0, False


@dataclass(frozen=True, slots=True)
class GradientRecord:
    """Gradient under the train [per mille], curve radius [m, 0 = straight], tunnel flag."""

    stamp_ns: int
    gradient: float
    curve_radius: float
    tunnel: bool

    def row(self) -> Row:
        """Return the record as a row of numbers."""
        return GRADIENT, self.stamp_ns, self.gradient, self.curve_radius, self.tunnel


@dataclass(frozen=True, slots=True)
class BrakeRecord:
    """Brake command: target acceleration [m/s^2, <= 0, 0 = no brake] and emergency flag."""

    stamp_ns: int
    target_acceleration: float
    emergency: bool

    def row(self) -> Row:
        """Return the record as a row of numbers."""
        return BRAKE, self.stamp_ns, self.target_acceleration, 0.0, self.emergency


@dataclass(frozen=True, slots=True)
class MassRecord:
    """Train mass from load weighing [kg]."""

    stamp_ns: int
    mass: float

    def row(self) -> Row:
        """Return the record as a row of numbers."""
        return MASS, self.stamp_ns, self.mass, 0.0, False


Record: TypeAlias = SpeedRecord | ForceRecord | GradientRecord | BrakeRecord | MassRecord


@dataclass(frozen=True, slots=True)
class InputTopic:
    """Name, message type and record class of one input topic."""

    name: str
    message: str
    record: type[Record]


SPEED_TOPIC: Final = InputTopic('ato/speed', 'AtoSpeed', SpeedRecord)
FORCE_TOPIC: Final = InputTopic('ato/force', 'AtoForce', ForceRecord)
GRADIENT_TOPIC: Final = InputTopic('ato/gradient', 'TrackGradient', GradientRecord)
BRAKE_TOPIC: Final = InputTopic('ato/brake_command', 'BrakeCommand', BrakeRecord)
MASS_TOPIC: Final = InputTopic('ato/mass', 'TrainMass', MassRecord)

INPUT_TOPICS: Final = (SPEED_TOPIC, FORCE_TOPIC, GRADIENT_TOPIC, BRAKE_TOPIC, MASS_TOPIC)
_INPUT_OF: Final[dict[type[Record], InputTopic]] = {topic.record: topic for topic in INPUT_TOPICS}
REQUIRED_TOPICS: Final = (SPEED_TOPIC, FORCE_TOPIC, GRADIENT_TOPIC, BRAKE_TOPIC)


def input_topic(record: Record) -> InputTopic:
    """Return the topic of a record."""
    return _INPUT_OF[type(record)]


def record_of(topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> Record:
    """Return the record of a row of numbers."""
    if topic == SPEED:
        return SpeedRecord(stamp_ns, x, y)
    if topic == FORCE:
        return ForceRecord(stamp_ns, x)
    if topic == GRADIENT:
        return GradientRecord(stamp_ns, x, y, flag)
    return BrakeRecord(stamp_ns, x, flag) if topic == BRAKE else MassRecord(stamp_ns, x)


# Generated messages store values without checking their type, so every value is cast.
_CASTS: Final[dict[str, Callable[[Any], Any]]] = {
    'float': float,
    'int': int,
    'bool': bool,
    'tuple': lambda values: list(map(float, values)),
}


@dataclass(frozen=True, slots=True)
class OutputTopic:
    """Topic of an estimate, its message type, its class, and the topic of the latched copy, '' if there is none."""

    name: str
    message: str
    estimate: type[Estimate]
    last_valid: str


RESISTANCE_TOPIC: Final = OutputTopic(
    'trainid/resistance', 'ResistanceEstimate', ResistanceEstimate, 'trainid/last_valid/resistance'
)
SPEED_MODEL_TOPIC: Final = OutputTopic('trainid/speed_model', 'SpeedModelEstimate', SpeedModelEstimate, '')
BRAKE_RATE_TOPIC: Final = OutputTopic(
    'trainid/brake_rate', 'BrakeRateEstimate', BrakeRateEstimate, 'trainid/last_valid/brake_rate'
)
ADHESION_TOPIC: Final = OutputTopic('trainid/adhesion', 'AdhesionEstimate', AdhesionEstimate, '')
OUTPUT_TOPICS: Final = (RESISTANCE_TOPIC, SPEED_MODEL_TOPIC, BRAKE_RATE_TOPIC, ADHESION_TOPIC)
MAY_BE_UNKNOWN: Final = frozenset(
    name for topic in OUTPUT_TOPICS for name, item in quantities(topic.estimate).items() if item.may_be_unknown
)
"""NaN where an algorithm does not estimate them; the position may be unknown."""
_OUTPUT_OF: Final[dict[type[Any], OutputTopic]] = {topic.estimate: topic for topic in OUTPUT_TOPICS}


def _casts(kind: type[Any]) -> tuple[tuple[str, Callable[[Any], Any]], ...]:
    """Return the fields of a record or an estimate, each with what makes its value a plain one."""
    # Types are text, but classes where the module is compiled.
    names = ((item.name, getattr(item.type, '__name__', str(item.type))) for item in fields(kind))
    return tuple((name, _CASTS[text.partition('[')[0]]) for name, text in names)


_FIELDS: Final[dict[type[Any], tuple[tuple[str, Callable[[Any], Any]], ...]]] = {
    kind: _casts(kind) for kind in (*(topic.record for topic in INPUT_TOPICS), *_OUTPUT_OF)
}


def output_topic(estimate: Estimate) -> OutputTopic:
    """Return the topic of an estimate."""
    return _OUTPUT_OF[type(estimate)]


def stamp_of(message: Any) -> int:
    """Return the stamp of a message with a header [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def status_of(message: Any) -> Status:
    """Return the status of a message of an estimate; one that is not known is a fault."""
    try:
        return Status(message.status)
    except ValueError:
        return Status.FAULT


def record_from_message(topic: InputTopic, message: Any) -> Record:
    """Return the record of an input message; values are passed on unchecked, NaN included."""
    values = [cast(getattr(message, name)) for name, cast in _FIELDS[topic.record][1:]]
    return topic.record(stamp_of(message), *values)


def record_values(record: Record) -> dict[str, Value]:
    """Return the fields of the message of a record, but for its header."""
    return {name: cast(getattr(record, name)) for name, cast in _FIELDS[type(record)][1:]}


def output_values(output: Output[Any]) -> dict[str, Value]:
    """Return the fields of the message of an output, but for its header; a number that is not finite makes it FAULT."""
    estimate, rejection = output.estimate, output.last_rejection
    values: dict[str, Value] = {}
    finite = True
    for name, cast in _FIELDS[type(estimate)]:
        values[name] = value = cast(getattr(estimate, name))
        finite = finite and (name in MAY_BE_UNKNOWN or _is_finite(value))
    values['status'] = int(output.status if finite else Status.FAULT)
    used, rejected = counters(type(estimate))
    values[used], values[rejected] = int(output.used), int(output.rejected)
    values['last_reject_reason'] = 0 if rejection is None else int(rejection.reason)
    values['last_reject_text'] = '' if rejection is None else str(rejection)
    return values


def _is_finite(value: Any) -> bool:
    return all(map(math.isfinite, value)) if isinstance(value, list) else math.isfinite(value)
