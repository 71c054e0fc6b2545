# SPDX-License-Identifier: Apache-2.0
"""One file of the sqlite3 storage of rosbag2, of any version."""

from __future__ import annotations

import sqlite3
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Final, NoReturn

import numpy as np
from mcap.records import Channel, Schema

from trainid_ros.bag.record_table import MessageBlock, Segment
from trainid_ros.bag.types import full_definition, full_type
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS
from trainid_ros.interface.text import pluralise

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_MESSAGES_AT_ONCE: Final = 5000
_OURS: Final = {full_type(topic.message): topic.message for topic in (*INPUT_TOPICS, *OUTPUT_TOPICS)}
# SQLite stores any type in any column: what is no time is larger than every number, and a text may be the bytes.
_TIMES: Final = 'SELECT timestamp FROM messages WHERE timestamp >= 0 AND typeof(timestamp) = "integer" ORDER BY 1'
_COUNTS: Final = 'SELECT topic_id, count(*) FROM messages WHERE timestamp BETWEEN 0 AND ? GROUP BY 1'
_MESSAGES: Final = (
    'SELECT topic_id, timestamp, CAST(data AS BLOB) FROM messages '
    'WHERE topic_id IN ({}) AND timestamp BETWEEN ? AND ? ORDER BY timestamp, id'
)


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
        # The path must be quoted in a URI: a part after # names no file.
        uri = f'{path.absolute().as_uri()}?immutable=1'
        self._file = sqlite3.connect(uri, uri=True, check_same_thread=False)
        self._file.text_factory = partial(str, encoding='utf-8', errors='replace')
        try:
            self.channels, self.schemas = self._topics()
            self.segments = self._spans()
            self.last_ns = self.segments[-1].last_ns if self.segments else 0
            found = dict(self._file.execute(_COUNTS, (self.last_ns,))) if self.segments else {}
            total = self._file.execute('SELECT count(*) FROM messages').fetchone()[0]
        except sqlite3.Error as error:
            self._fail(error)
        self.first_ns = self.segments[0].first_ns if self.segments else 0
        self.counts = {number: found[number] for number in self.channels if number in found}
        self._needed = [number for number, channel in self.channels.items() if is_needed(channel.topic)]
        if left_out := total - sum(found.values()):
            self.warnings.append(f'{path}: {pluralise(left_out, "message")} without a valid log time left out')
        journal = path.with_name(f'{path.name}-wal')
        if journal.is_file() and journal.stat().st_size:
            self.warnings.append(f'{journal}: messages of an interrupted recording, which are not read')

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, first_ns: int, last_ns: int) -> MessageBlock:
        """Return the needed messages between two log times [ns], in their order; InputError if the file is damaged."""
        try:
            query = _MESSAGES.format(','.join('?' * len(self._needed)))
            found = self._file.execute(query, (*self._needed, first_ns, last_ns)).fetchall()
        except sqlite3.Error as error:
            self._fail(error)
        payloads = [data or b'' for _, _, data in found]
        sizes = np.array([len(data) for data in payloads], dtype=np.intp)
        ends = np.cumsum(sizes, dtype=np.intp)
        return MessageBlock(
            data=np.frombuffer(bytearray().join(payloads), dtype=np.uint8),
            start=ends - sizes,
            end=ends,
            channel=np.array([number for number, _, _ in found], dtype=np.int64),
            log_ns=np.array([log_ns for _, log_ns, _ in found], dtype=np.uint64),
        )

    def _spans(self) -> list[Segment]:
        """Return spans of some thousand messages each; they do not overlap."""
        times = (row[0] for row in self._file.execute(_TIMES))
        spans: list[Segment] = []
        while some := list(islice(times, _MESSAGES_AT_ONCE)):
            # Messages of equal log times belong to one span.
            first_ns = max(some[0], spans[-1].last_ns + 1) if spans else some[0]
            if some[-1] >= first_ns:
                spans.append(Segment(first_ns, some[-1], partial(self._read, first_ns, some[-1])))
        return spans

    def _topics(self) -> tuple[dict[int, Channel], dict[int, Schema]]:
        """Return channels and definitions, both by the number of the topic."""
        hashes = 'type_description_hash' if self._has('topics', 'type_description_hash') else "''"
        rows = self._file.execute(f'SELECT id, name, type, serialization_format, {hashes} FROM topics ORDER BY id')
        texts: dict[str, tuple[str, str]] = {}
        if self._has('message_definitions', 'encoded_message_definition'):
            query = 'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
            texts = {kind: (encoding, text) for kind, encoding, text in self._file.execute(query)}
        channels, schemas = {}, {}
        for number, topic, kind, encoding, digest in rows.fetchall():
            form, text = texts.get(kind, ('', ''))
            # Older files hold no definitions, so the packaged one is taken for our types.
            if kind in _OURS and not (digest or text):
                form, text = 'ros2msg', full_definition(_OURS[kind])
            metadata = {'topic_type_hash': digest} if digest else {}
            channels[number] = Channel(number, topic, encoding, metadata, schema_id=number)
            schemas[number] = Schema(number, str(text or '').encode(), form, kind)
        return channels, schemas

    def _has(self, table: str, column: str) -> bool:
        return any(row[1] == column for row in self._file.execute(f'PRAGMA table_info({table})'))

    def _fail(self, error: Exception) -> NoReturn:
        self.close()
        raise InputError(f'{self.path}: unreadable sqlite3 storage ({" ".join(str(error).split())})') from None
