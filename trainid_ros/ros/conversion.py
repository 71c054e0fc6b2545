# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS from records and outputs; see :mod:`trainid_ros.messages` for how fields map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from builtin_interfaces.msg import Time
from trainid_msgs import msg as trainid_msgs

from trainid_ros.messages import output_values, record_values
from trainid_ros.records import INPUT_TOPICS, NS_PER_S, InputTopic, Record

if TYPE_CHECKING:
    from collections.abc import Mapping

    from trainid_ros.messages import OutputLike

_MESSAGES: Final = {topic.record: getattr(trainid_msgs, topic.message) for topic in INPUT_TOPICS}


def message_class(topic: InputTopic) -> Any:
    """Return the message class of an input topic."""
    return _MESSAGES[topic.record]


def time_message(time_ns: int) -> Time:
    """Return a time [ns] as a ``builtin_interfaces/Time``."""
    sec, nanosec = divmod(time_ns, NS_PER_S)
    return Time(sec=sec, nanosec=nanosec)


def message_from_record(record: Record) -> Any:
    """Return the input message of a record."""
    return _fill(_MESSAGES[type(record)](), record.stamp_ns, record_values(record))


def fill_estimate(message: Any, output: OutputLike) -> Any:
    """Copy an output into its message and return it; a non-finite estimate gets status FAULT."""
    return _fill(message, output.stamp_ns, output_values(output))


def _fill(message: Any, stamp_ns: int, values: Mapping[str, Any]) -> Any:
    message.header.stamp = time_message(stamp_ns)
    for name, value in values.items():
        setattr(message, name, value)
    return message
