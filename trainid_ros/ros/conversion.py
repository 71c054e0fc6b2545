# SPDX-License-Identifier: Apache-2.0
"""Convert input messages to records and outputs to messages, by field name.

Generated messages store assigned values without checking their type, so every value is cast.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

from builtin_interfaces.msg import Time
from trainid_msgs import msg as trainid_msgs

from trainid_ros.core.records import INPUT_TOPICS, NS_PER_S, InputTopic, Record
from trainid_ros.core.results import Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.estimators.pipeline import Output

_CASTS: Final[dict[str, Callable[[Any], Any]]] = {'float': float, 'int': int, 'bool': bool}
_MAY_BE_UNKNOWN: Final = frozenset({'position', 'force_scale', 'force_scale_std', 'force_delay', 'force_delay_std'})
_MESSAGES: Final = {topic.record: getattr(trainid_msgs, topic.message) for topic in INPUT_TOPICS}


def message_class(topic: InputTopic) -> Any:
    """Return the message class of an input topic."""
    return _MESSAGES[topic.record]


def stamp_ns(stamp: Any) -> int:
    """Return a ``builtin_interfaces/Time`` as a number [ns]."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def time_message(time_ns: int) -> Time:
    """Return a time [ns] as a ``builtin_interfaces/Time``."""
    sec, nanosec = divmod(time_ns, NS_PER_S)
    return Time(sec=sec, nanosec=nanosec)


def record_from_message(topic: InputTopic, message: Any) -> Record:
    """Return the record of an input message; values, NaN included, are not checked."""
    values = [
        _CASTS[str(item.type)](getattr(message, item.name)) for item in fields(topic.record) if item.name != 'stamp_ns'
    ]
    return topic.record(stamp_ns(message.header.stamp), *values)


def message_from_record(record: Record) -> Any:
    """Return the input message of a record."""
    message = _MESSAGES[type(record)]()
    message.header.stamp = time_message(record.stamp_ns)
    for item in fields(record):
        if item.name != 'stamp_ns':
            setattr(message, item.name, _CASTS[str(item.type)](getattr(record, item.name)))
    return message


def fill_estimate(message: Any, output: Output[Any]) -> Any:
    """Copy an output into its message and return it; a non-finite estimate gets status FAULT."""
    estimate, rejection = output.estimate, output.last_rejection
    message.header.stamp = time_message(output.stamp_ns)
    finite = True
    for item in fields(estimate):
        value = _plain(getattr(estimate, item.name))
        setattr(message, item.name, value)
        finite = finite and (item.name in _MAY_BE_UNKNOWN or _is_finite(value))
    message.status = int(output.status) if finite else int(Status.FAULT)
    message.used = int(output.used)
    message.rejected = int(output.rejected)
    message.last_reject_reason = 0 if rejection is None else int(rejection.reason)
    message.last_reject_text = '' if rejection is None else str(rejection)
    return message


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [float(item) for item in value]
    return bool(value) if isinstance(value, bool) else float(value)


def _is_finite(value: Any) -> bool:
    return all(map(math.isfinite, value)) if isinstance(value, list) else math.isfinite(value)
