# SPDX-License-Identifier: Apache-2.0
"""One file of the sqlite3 storage of rosbag2, read by rosbags."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

import apsw  # comes with rosbags
import numpy as np
from mcap.records import Channel, Schema
from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from trainid_ros.bag.message_block import MessageBlock
from trainid_ros.bag.types import full_definition, full_type
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rosbags.interfaces import Connection

_MESSAGES_AT_ONCE: Final = 5000
_ENCODINGS: Final = {MessageDefinitionFormat.MSG: 'ros2msg', MessageDefinitionFormat.IDL: 'ros2idl'}
_OURS: Final = {full_type(topic.message): topic.message for topic in (*INPUT_TOPICS, *OUTPUT_TOPICS)}
_TIMES: Final = 'SELECT timestamp FROM messages ORDER BY timestamp'


class Span(NamedTuple):
    """The messages from a first to a last log time [ns]."""

    first_ns: int
    last_ns: int


class Db3File:
    """The messages of one ``.db3`` file; attributes as those of :class:`McapFile`."""

    def __init__(self, path: Path, is_needed: Callable[[str], bool]) -> None:
        """Open a file.

        Args:
            path: The file.
            is_needed: Whether the messages of a topic are needed; others are left out.

        Raises:
            InputError: It cannot be read.
        """
        self.path = path
        self.promised: int | None = None
        self.warnings: list[str] = []
        self._reader = Sqlite3Reader(path)
        try:
            self._reader.open()
            connections = tuple(self._reader.connections)
            self.segments = self._spans()
        except (ReaderError, apsw.Error, ValueError, TypeError) as error:
            self._fail(error)
        self.first_ns = self.segments[0].first_ns if self.segments else 0
        self.last_ns = self.segments[-1].last_ns if self.segments else 0
        self.counts = {item.id: item.msgcount for item in connections if item.msgcount}
        self.channels = {item.id: _channel(item) for item in connections}
        self.schemas = {item.id: _schema(item) for item in connections}
        self._needed = [item for item in connections if is_needed(item.topic)]
        journal = path.with_name(f'{path.name}-wal')
        if journal.is_file() and journal.stat().st_size:
            self.warnings.append(f'{journal}: messages of an interrupted recording, which are not read')

    def close(self) -> None:
        """Close the file."""
        if self._reader.dbconn is not None:
            self._reader.close()

    def messages(self, segment: Span) -> MessageBlock:
        """Return the needed messages within a span, by log time.

        Raises:
            InputError: The file is damaged.
        """
        try:
            found = list(self._reader.messages(self._needed, segment.first_ns, segment.last_ns + 1))
        except apsw.Error as error:
            self._fail(error)
        ends = np.cumsum([len(data) for _, _, data in found], dtype=np.intp)
        return MessageBlock(
            data=np.frombuffer(bytearray().join(data for _, _, data in found), dtype=np.uint8),
            start=ends - np.array([len(data) for _, _, data in found], dtype=np.intp),
            end=ends,
            channel=np.array([item.id for item, _, _ in found], dtype=np.uint16),
            log_ns=np.array([log_ns for _, log_ns, _ in found], dtype=np.uint64),
        )

    def _spans(self) -> list[Span]:
        """Return spans of some thousand messages each; they do not overlap."""
        if self._reader.dbconn is None:
            return []
        times = (int(row[0]) for row in self._reader.dbconn.execute(_TIMES))
        spans: list[Span] = []
        while some := list(islice(times, _MESSAGES_AT_ONCE)):
            # Messages of equal log times belong to one span.
            first_ns = max(some[0], spans[-1].last_ns + 1) if spans else some[0]
            if some[-1] >= first_ns:
                spans.append(Span(first_ns, some[-1]))
        if spans and spans[0].first_ns < 0:
            raise ValueError(f'log time {spans[0].first_ns} ns is negative')
        return spans

    def _fail(self, error: Exception) -> NoReturn:
        self.close()
        raise InputError(f'{self.path}: unreadable sqlite3 storage ({" ".join(str(error).split())})') from None


def _channel(item: Connection) -> Channel:
    encoding = item.ext.serialization_format if isinstance(item.ext, ConnectionExtRosbag2) else ''
    metadata = {'topic_type_hash': item.digest} if item.digest else {}
    return Channel(item.id, item.topic, encoding, metadata, schema_id=item.id)


def _schema(item: Connection) -> Schema:
    """Return the definition of a type; older files hold none, so the packaged one is taken for our types."""
    if item.msgdef.format is not MessageDefinitionFormat.NONE:
        text, encoding = item.msgdef.data, _ENCODINGS[item.msgdef.format]
    elif item.msgtype in _OURS and not item.digest:
        text, encoding = full_definition(_OURS[item.msgtype]), 'ros2msg'
    else:
        text, encoding = '', ''
    return Schema(item.id, text.encode(), encoding, item.msgtype)
