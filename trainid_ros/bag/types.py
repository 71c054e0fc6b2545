# SPDX-License-Identifier: Apache-2.0
"""Messages of ``trainid_msgs`` for rosbags, and their conversion from and to the records of the core.

The definitions are the packaged ``.msg`` files, the same ones that ROS compiles, so a RIHS01 digest
computed here equals the type hash that ROS uses.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from trainid_ros.errors import InputError
from trainid_ros.messages import output_topic, output_values, record_values
from trainid_ros.records import (
    NS_PER_S,
    Record,
    input_topic,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from trainid_ros.messages import OutputLike


PACKAGE: Final = 'trainid_msgs'
_INT32_MAX: Final = 2**31 - 1


def full_type(name: str) -> str:
    """Return the full name of one of our messages, such as ``trainid_msgs/msg/AtoSpeed``."""
    return f'{PACKAGE}/msg/{name}'


@cache
def typestore() -> Typestore:
    """Return a Jazzy typestore with the packaged messages registered."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = resources.files('trainid_ros.bag') / 'msg'
    for item in sorted(folder.iterdir(), key=lambda entry: entry.name):
        stem, _, suffix = item.name.rpartition('.')
        if suffix == 'msg':
            store.register(get_types_from_msg(item.read_text(encoding='utf-8'), full_type(stem)))
    return store


@cache
def digest(message: str) -> str:
    """Return the RIHS01 digest of one of our messages, given its short name."""
    return str(typestore().hash_rihs01(full_type(message)))


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Return the seconds and nanoseconds of a stamp [ns].

    Raises:
        InputError: ``builtin_interfaces/Time`` cannot hold the stamp.

    """
    sec, nanosec = divmod(int(stamp_ns), NS_PER_S)
    if not 0 <= sec <= _INT32_MAX:
        msg = f'stamp {stamp_ns} ns does not fit a ROS time'
        raise InputError(msg)
    return sec, nanosec


def header(stamp_ns: int) -> Any:
    """Return a ``std_msgs/Header`` with a stamp [ns] and an empty frame."""
    types = typestore().types
    sec, nanosec = split_stamp(stamp_ns)
    stamp = types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
    return types['std_msgs/msg/Header'](stamp=stamp, frame_id='')


def message_from_record(record: Record) -> Any:
    """Return the message of a record, as the rosbags class of its type."""
    return _build(input_topic(record).message, record.stamp_ns, record_values(record))


def estimate_message(output: OutputLike) -> Any:
    """Return the message of an estimator output, as the rosbags class of its type."""
    return _build(output_topic(output.estimate).message, output.stamp_ns, output_values(output))


def _build(name: str, stamp_ns: int, values: dict[str, Any]) -> Any:
    arrays = {key: np.array(value, dtype=np.float64) for key, value in values.items() if isinstance(value, list)}
    return typestore().types[full_type(name)](header=header(stamp_ns), **(values | arrays))
