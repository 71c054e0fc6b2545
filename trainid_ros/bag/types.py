# SPDX-License-Identifier: Apache-2.0
"""Messages of ``trainid_msgs`` for rosbags, and their conversion from and to the records of the core.

The definitions are the packaged ``.msg`` files, the same ones that ROS compiles, so a RIHS01 digest
computed here equals the type hash that ROS uses.
"""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from trainid_ros.core.errors import InputError
from trainid_ros.core.records import (
    INPUT_TOPICS,
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from rosbags.typesys.store import Typestore

    from trainid_ros.core.results import Estimate, Rejection, Status

PACKAGE: Final = 'trainid_msgs'
ESTIMATE_TOPICS: Final = {
    'ResistanceEstimate': 'trainid/resistance',
    'SpeedModelEstimate': 'trainid/speed_model',
    'BrakeRateEstimate': 'trainid/brake_rate',
}
LAST_VALID_TOPICS: Final = {
    'ResistanceEstimate': 'trainid/last_valid/resistance',
    'BrakeRateEstimate': 'trainid/last_valid/brake_rate',
}
_INT32_MAX: Final = 2**31 - 1


class OutputLike(Protocol):
    """Output of an estimator after a sample: the estimate, its status and the rejections."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the newest sample used [ns]."""

    @property
    def estimate(self) -> Estimate:
        """The estimate."""

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


def message_stamp_ns(message: Any) -> int:
    """Return the stamp of a message with a header [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


_TO_RECORD: Final[dict[str, Callable[[int, Any], Record]]] = {
    'AtoSpeed': lambda stamp, m: SpeedRecord(stamp, m.speed, m.position),
    'AtoForce': lambda stamp, m: ForceRecord(stamp, m.force),
    'TrackGradient': lambda stamp, m: GradientRecord(stamp, m.gradient, m.curve_radius, m.tunnel),
    'BrakeCommand': lambda stamp, m: BrakeRecord(stamp, m.target_acceleration, m.emergency),
    'TrainMass': lambda stamp, m: MassRecord(stamp, m.mass),
}
_MESSAGE_OF: Final = {topic.record: topic.message for topic in INPUT_TOPICS}
_VALUES_OF: Final = {
    topic.record: tuple(item.name for item in fields(topic.record) if item.name != 'stamp_ns') for topic in INPUT_TOPICS
}


def record_from_message(name: str, message: Any) -> Record:
    """Return the record of an input message; values are passed on unchecked, NaN included.

    Args:
        name: Short name of the message type, such as ``AtoSpeed``.
        message: The deserialised message.

    """
    return _TO_RECORD[name](message_stamp_ns(message), message)


def message_from_record(record: Record) -> Any:
    """Return the message of a record, as the rosbags class of its type."""
    name = _MESSAGE_OF[type(record)]
    values = {key: getattr(record, key) for key in _VALUES_OF[type(record)]}
    return _build(name, record.stamp_ns, values)


def estimate_message(output: OutputLike) -> Any:
    """Return the message of an estimator output; estimate fields are copied by name."""
    estimate, rejection = output.estimate, output.last_rejection
    values = {item.name: getattr(estimate, item.name) for item in fields(estimate)}
    values |= {
        'status': int(output.status),
        'used': output.used,
        'rejected': output.rejected,
        'last_reject_reason': 0 if rejection is None else int(rejection.reason),
        'last_reject_text': '' if rejection is None else str(rejection),
    }
    return _build(type(estimate).__name__, output.stamp_ns, values)


def _build(name: str, stamp_ns: int, values: dict[str, Any]) -> Any:
    """Return a message; NumPy scalars become plain ones, tuples become float64 arrays."""
    plain = {key: _plain(value) for key, value in values.items()}
    return typestore().types[full_type(name)](header=header(stamp_ns), **plain)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return np.array(value, dtype=np.float64)
    return value.item() if isinstance(value, np.generic) else value
