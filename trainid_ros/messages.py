# SPDX-License-Identifier: Apache-2.0
"""How messages map to records and outputs, by field name; the same for the classes of ROS and of rosbags."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, Protocol

from trainid_ros.records import INPUT_TOPICS, NS_PER_S
from trainid_ros.results import (
    BrakeRateEstimate,
    Estimate,
    Rejection,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.records import InputTopic, Record

    Value = float | bool | int | str | list[float]

# Generated messages store values without checking their type, so every value is cast.
_CASTS: Final[dict[str, Callable[[Any], Any]]] = {
    'float': float,
    'int': int,
    'bool': bool,
    'tuple': lambda values: list(map(float, values)),
}
MAY_BE_UNKNOWN: Final = frozenset({'position', 'force_scale', 'force_scale_std', 'force_delay', 'force_delay_std'})
"""NaN where an algorithm does not estimate them; the position may be unknown."""


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
OUTPUT_TOPICS: Final = (RESISTANCE_TOPIC, SPEED_MODEL_TOPIC, BRAKE_RATE_TOPIC)
_TOPIC_OF: Final[dict[type[Any], OutputTopic]] = {topic.estimate: topic for topic in OUTPUT_TOPICS}
_STATUSES: Final = frozenset(map(int, Status))


def _casts(kind: type[Any]) -> tuple[tuple[str, Callable[[Any], Any]], ...]:
    """Return the fields of a record or an estimate, each with what makes its value a plain one."""
    # Types are text, but classes where the module is compiled.
    names = ((item.name, getattr(item.type, '__name__', str(item.type))) for item in fields(kind))
    return tuple((name, _CASTS[text.partition('[')[0]]) for name, text in names)


_FIELDS: Final[dict[type[Any], tuple[tuple[str, Callable[[Any], Any]], ...]]] = {
    kind: _casts(kind) for kind in (*(topic.record for topic in INPUT_TOPICS), *_TOPIC_OF)
}


class OutputLike(Protocol):
    """Output of an estimator after a sample: the estimate, its status, and counts of used and rejected samples."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the newest sample used [ns]."""

    @property
    def estimate(self) -> Estimate:
        """The estimate itself."""

    @property
    def status(self) -> Status:
        """Status of the estimate."""

    @property
    def used(self) -> int:
        """Samples used since the last reset."""

    @property
    def rejected(self) -> int:
        """Samples not used since the last reset."""

    @property
    def last_rejection(self) -> Rejection | None:
        """Last rejection, None before the first."""


def output_topic(estimate: Estimate) -> OutputTopic:
    """Return the topic of an estimate."""
    return _TOPIC_OF[type(estimate)]


def stamp_of(message: Any) -> int:
    """Return the stamp of a message with a header [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def status_of(message: Any) -> Status:
    """Return the status of a message of an estimate; one that is not known is a fault."""
    return Status(message.status) if message.status in _STATUSES else Status.FAULT


def record_from_message(topic: InputTopic, message: Any) -> Record:
    """Return the record of an input message; values are passed on unchecked, NaN included."""
    values = [cast(getattr(message, name)) for name, cast in _FIELDS[topic.record][1:]]
    return topic.record(stamp_of(message), *values)


def record_values(record: Record) -> dict[str, Value]:
    """Return the fields of the message of a record, but for its header."""
    return {name: cast(getattr(record, name)) for name, cast in _FIELDS[type(record)][1:]}


def output_values(output: OutputLike) -> dict[str, Value]:
    """Return the fields of the message of an output, but for its header; a number that is not finite makes it FAULT."""
    estimate, rejection = output.estimate, output.last_rejection
    values: dict[str, Value] = {name: cast(getattr(estimate, name)) for name, cast in _FIELDS[type(estimate)]}
    finite = all(_is_finite(value) or name in MAY_BE_UNKNOWN for name, value in values.items())
    values['status'] = int(output.status if finite else Status.FAULT)
    values['used'] = int(output.used)
    values['rejected'] = int(output.rejected)
    values['last_reject_reason'] = 0 if rejection is None else int(rejection.reason)
    values['last_reject_text'] = '' if rejection is None else str(rejection)
    return values


def _is_finite(value: Any) -> bool:
    return all(map(math.isfinite, value)) if isinstance(value, list) else math.isfinite(value)
