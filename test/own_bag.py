# SPDX-License-Identifier: Apache-2.0
"""Write and read small bags with our own topics."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

import pytest
from rosbags.highlevel import AnyReader

from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import message_from_record
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    Record,
    SpeedRecord,
    input_topic,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

START_NS: Final = 1_700_000_000 * NS_PER_S


def at(k: int) -> int:
    """Return the stamp of the k-th sample at 5 Hz [ns]."""
    return START_NS + k * NS_PER_S // 5


def short_drive() -> list[Record]:
    """Return the four required topics at 5 Hz over 10 s, each with its own stamps, in stamp order."""
    found: list[Record] = []
    for i in range(50):
        stamp_ns = at(i)
        found += [
            SpeedRecord(stamp_ns, 0.1 * i, 100.0 + i),
            ForceRecord(stamp_ns + 1, 1e5 - i),
            GradientRecord(stamp_ns + 2, -3.0 + 0.1 * i, 400.0, tunnel=i % 2 == 0),
            BrakeRecord(stamp_ns + 3, -0.5 if i >= 25 else 0.0, emergency=i == 49),
        ]
    return found


def write_bag(
    path: Path, records: Iterable[Record], log_ns: Iterable[int] | None = None, namespaces: Sequence[str] = ('',)
) -> Path:
    """Write records in each namespace, logged at their stamps or at given times [ns]; return the bag."""
    inputs = list(records)
    times = [record.stamp_ns for record in inputs] if log_ns is None else log_ns
    with BagWriter(path) as writer:
        for record, logged_ns in zip(inputs, times, strict=True):
            topic = input_topic(record)
            for namespace in namespaces:
                name = f'{namespace}/{topic.name}'
                writer.write_message(name, topic.message, logged_ns, message_from_record(record))
    return path


def read_bag(path: Path) -> tuple[list[Record], list[str]]:
    """Return the records of a bag, which a second pass repeats, and its warnings."""
    with BagReader(path) as reader:
        found = list(reader.records())
        assert list(reader.records()) == found
        return found, reader.warnings


@contextmanager
def changed(path: Path) -> Iterator[bytearray]:
    """Change the bytes of a file."""
    content = bytearray(path.read_bytes())
    yield content
    path.write_bytes(content)


def error_of(path: Path) -> str:
    """Return the error, of one line, of a bag that cannot be read."""
    with pytest.raises(InputError) as caught, BagReader(path) as reader:
        list(reader.records())
    assert '\n' not in str(caught.value)
    return str(caught.value)


def messages_of(path: Path, topic: str) -> list[Any]:
    """Return the messages of a topic, as another reader reads them."""
    with AnyReader([path]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == f'/{topic}']
        return [reader.deserialize(raw, item.msgtype) for item, _, raw in reader.messages(connections=wanted)]
