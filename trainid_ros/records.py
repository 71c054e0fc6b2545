# SPDX-License-Identifier: Apache-2.0
"""Input messages as plain values: one record per message, times in integer nanoseconds.

Signs and units follow the interface: SI, gradient in per mille and positive uphill in the
direction of travel, force at the wheel rim positive in traction, NaN for unknown values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

NS_PER_S: Final = 1_000_000_000
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
_TOPIC_OF: Final[dict[type[Record], InputTopic]] = {topic.record: topic for topic in INPUT_TOPICS}
REQUIRED_TOPICS: Final = (SPEED_TOPIC, FORCE_TOPIC, GRADIENT_TOPIC, BRAKE_TOPIC)


def input_topic(record: Record) -> InputTopic:
    """Return the topic of a record."""
    return _TOPIC_OF[type(record)]


def record_of(topic: int, stamp_ns: int, x: float, y: float, flag: bool) -> Record:
    """Return the record of a row of numbers."""
    if topic == SPEED:
        return SpeedRecord(stamp_ns, x, y)
    if topic == FORCE:
        return ForceRecord(stamp_ns, x)
    if topic == GRADIENT:
        return GradientRecord(stamp_ns, x, y, flag)
    return BrakeRecord(stamp_ns, x, flag) if topic == BRAKE else MassRecord(stamp_ns, x)
