# SPDX-License-Identifier: Apache-2.0
"""Write bags as other makers do: other topics, types and units, with ``rosbags``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from trainid_ros.bag.reader import BagReader
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from types import TracebackType

TWIST: Final = 'geometry_msgs/msg/TwistStamped'
WRENCH: Final = 'geometry_msgs/msg/WrenchStamped'
ODOMETRY: Final = 'nav_msgs/msg/Odometry'
FLOAT: Final = 'std_msgs/msg/Float64'
VECTOR: Final = 'geometry_msgs/msg/Vector3Stamped'
INT: Final = 'std_msgs/msg/Int8'
_ZERO: Final[dict[str, Any]] = {'string': '', 'bool': False, 'float32': 0.0, 'float64': 0.0}


class ForeignBag:
    """Writer of messages of any type; fields that are not given are zero. Use as a context manager."""

    def __init__(self, path: Path, types: Mapping[str, str] = {}) -> None:
        """Create the bag; ``types`` are definitions by name of types that are nobody's."""
        self._store = get_typestore(Stores.ROS2_JAZZY)
        for name, text in types.items():
            self._store.register(get_types_from_msg(text, name))
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Open it."""
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self._writer.close()

    def write(self, topic: str, kind: str, log_ns: int, **values: Any) -> None:
        """Write a message; names of fields have ``__`` for a dot, and a header has the log time [ns] as stamp."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        message = self._zero(kind)
        if hasattr(message, 'header'):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(log_ns, NS_PER_S)
        for name, value in values.items():
            *path, last = name.split('__')
            part = message
            for step in path:
                part = getattr(part, step)
            setattr(part, last, value)
        self._writer.write(self._connections[topic], log_ns, self._store.serialize_cdr(message, kind))

    def _zero(self, kind: str) -> Any:
        fields = {name: self._zero_field(item) for name, item in self._store.fielddefs[kind][1]}
        return self._store.types[kind](**fields)

    def _zero_field(self, item: Any) -> Any:
        node, detail = item
        if node == Nodetype.NAME:
            return self._zero(detail)
        if node == Nodetype.BASE:
            return _ZERO.get(detail[0], 0)
        (part, kind), count = detail
        return [] if part == Nodetype.NAME else np.zeros(count if node == Nodetype.ARRAY else 0, dtype=kind[0])


MAPPING: Final = """\
speed: {topic: /odo/twist, field: twist.linear.x, unit: km/h}
position: {topic: /odo/distance, field: data, unit: km, stamp: receive}
force:
  sum:
    - {topic: /car1/force, field: wrench.force.x, unit: kN}
    - {topic: /car2/force, field: wrench.force.x, unit: kN}
gradient: {topic: /track/slope, field: vector.y, unit: percent}
brake_command: {topic: /brake, field: vector.z, unit: percent_of 2 m/s^2, sign: -1}
mass: {topic: /load, field: vector.x, unit: t}
"""
"""The mapping of :func:`write_foreign`."""


def write_foreign(path: Path, records: Iterable[Record]) -> None:
    """Write records as a bag of another maker, without curves and tunnels."""
    with ForeignBag(path) as bag:
        for record in records:
            now = record.stamp_ns
            match record:
                case SpeedRecord(_, speed, position):
                    bag.write('/odo/distance', FLOAT, now, data=position / 1e3)
                    bag.write('/odo/twist', TWIST, now, twist__linear__x=3.6 * speed)
                case ForceRecord(_, force):
                    for topic, share in (('/car1/force', 0.6e-3), ('/car2/force', 0.4e-3)):
                        bag.write(topic, WRENCH, now, wrench__force__x=share * force)
                case GradientRecord(_, gradient):
                    bag.write('/track/slope', VECTOR, now, vector__y=0.1 * gradient)
                case BrakeRecord(_, target):
                    bag.write('/brake', VECTOR, now, vector__z=-50.0 * target)
                case MassRecord(_, mass):
                    bag.write('/load', VECTOR, now, vector__x=mass / 1e3)


if __name__ == '__main__':
    with BagReader(sys.argv[1]) as reader:
        write_foreign(Path(sys.argv[2]), reader.records())
