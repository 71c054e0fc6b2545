# SPDX-License-Identifier: Apache-2.0
"""Records and messages of a bag in the order of their log times."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from heapq import heappop, heappush
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np

from trainid_ros.bag.bag_files import locate
from trainid_ros.bag.chunk import MAX_CHUNK
from trainid_ros.bag.mcap_file import McapFile
from trainid_ros.bag.record_table import EMPTY, decode, in_order_of, joined
from trainid_ros.bag.types import digest, full_type, is_packaged, typestore
from trainid_ros.errors import InputError
from trainid_ros.messages import OUTPUT_TOPICS
from trainid_ros.plural import pluralise
from trainid_ros.records import INPUT_TOPICS, REQUIRED_TOPICS, InputTopic, record_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator
    from types import TracebackType

    from trainid_ros.bag.mcap_file import Segment
    from trainid_ros.bag.record_table import RecordTable
    from trainid_ros.records import Record, Row
    from trainid_ros.stream.sample_stream import SampleStream, StreamEvent

_OURS: Final = {topic.name: topic.message for topic in INPUT_TOPICS} | {
    name: topic.message for topic in OUTPUT_TOPICS for name in (topic.name, topic.last_valid) if name
}
_INPUT_NAMES: Final = frozenset(topic.name for topic in INPUT_TOPICS)
_TOPIC_NUMBERS: Final = {topic.name: number for number, topic in enumerate(INPUT_TOPICS)}
_NO_ROWS: Final = np.empty(0, dtype=np.intp)
_MAX_LOG_NS: Final = 2**64 - 1
PROGRESS_EVERY: Final = 500
"""Records from one report of progress to the next."""
_IDL_LINE: Final = '=' * 80 + '\n'


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a bag: name relative to the namespace where it lies in it, full type, messages."""

    name: str
    type: str
    count: int


class LoggedRecord(NamedTuple):
    """A record with the time at which it was logged."""

    log_ns: int
    topic: str
    record: Record


class LoggedMessage(NamedTuple):
    """A message with its topic and the time at which it was logged."""

    log_ns: int
    topic: str
    message: Any


class _Source(NamedTuple):
    """One channel of one file: topic by our name, short type name."""

    topic: str
    name: str


class BagReader:
    """Reads a rosbag2 directory or a bare ``.mcap`` file, also a damaged one as far as it goes.

    Use as a context manager; a bag can be iterated any number of times. Memory use does not grow with
    the bag: only chunks whose log times overlap are held together.

    Attributes:
        path: The bag.

    """

    def __init__(self, path: str | Path, namespace: str = '/', max_chunk: int = MAX_CHUNK) -> None:
        """Name the bag; it is opened on entering the context.

        Args:
            path: Rosbag2 directory or ``.mcap`` file.
            namespace: Namespace of the topics; those outside keep their full name without the slash.
            max_chunk: Largest chunk to unpack [bytes]; larger ones are left out with a warning.

        """
        self.path = Path(path)
        self._max_chunk = max_chunk
        self._damage: list[str] = []
        # Messages by topic that could not be read the last time.
        self._unreadable: Counter[str] = Counter()
        self._prefix = f'/{namespace.strip("/")}/'.replace('//', '/')
        self._files: list[McapFile] = []
        self._sources: list[dict[int, _Source]] = []

    def __enter__(self) -> Self:
        """Open and check the bag.

        Raises:
            InputError: If the bag cannot be read, or one of our topics has another type.

        """
        located = locate(self.path)
        self._damage = list(located.warnings)
        try:
            for path in located.files:
                self._files.append(McapFile(path, self._max_chunk))
            hashes = dict(located.hashes)
            self._sources = [self._check_types(file, hashes) for file in self._files]
        except BaseException:
            self.close()
            raise
        self._damage += [warning for file in self._files for warning in file.warnings]
        promised = max(located.message_count or 0, sum(file.promised or 0 for file in self._files))
        if promised > self.message_count:
            self._damage.append(f'{self.path}: {self.message_count} of {promised} messages found')
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag."""
        self.close()

    def close(self) -> None:
        """Close all files."""
        for file in self._files:
            file.close()
        self._files, self._sources = [], []

    @property
    def warnings(self) -> list[str]:
        """What is wrong with the bag although it can be read; messages that cannot be read are known after reading."""
        skipped = [
            f'{self.path}: topic {topic}: {pluralise(count, "message")} skipped that cannot be read'
            for topic, count in sorted(self._unreadable.items())
        ]
        return self._damage + skipped

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(sum(file.counts.values()) for file in self._files)

    @property
    def input_count(self) -> int:
        """Number of messages on the input topics: what :meth:`records` will yield, and those it skips as unreadable."""
        return sum(topic.count for topic in self.topics() if topic.name in _INPUT_NAMES)

    def time_range(self) -> tuple[int, int] | None:
        """Return the first and the last log time [ns], None for a bag without messages."""
        segments = [segment for file in self._files for segment in file.segments]
        if not segments:
            return None
        return min(segment.first_ns for segment in segments), max(segment.last_ns for segment in segments)

    def topics(self) -> tuple[TopicSummary, ...]:
        """Return all topics by name; a topic written in several types is listed once for each."""
        counts: dict[tuple[str, str], int] = {}
        for file in self._files:
            for number, channel in file.channels.items():
                key = (self._topic(channel.topic), _schema_name(file, number))
                counts[key] = counts.get(key, 0) + file.counts.get(number, 0)
        return tuple(TopicSummary(name, kind, count) for (name, kind), count in sorted(counts.items()))

    def records(self) -> Iterator[Record]:
        """Yield the records of the input topics by log time, on equal times in the order of the file within a chunk.

        Raises:
            InputError: A file has changed since it was opened.

        """
        return (entry.record for entry in self.logged_records())

    def logged_records(self) -> Iterator[LoggedRecord]:
        """Yield what :meth:`records` yields, with log time and topic."""
        return (LoggedRecord(log_ns, INPUT_TOPICS[row[0]].name, record_of(*row)) for log_ns, row in self.rows())

    def rows(self, last_ns: float = math.inf) -> Iterator[tuple[int, Row]]:
        """Yield what :meth:`records` yields as log time [ns] and row of numbers, up to a log time [ns].

        Raises:
            InputError: A file has changed since it was opened.

        """
        for table in self.tables(last_ns):
            yield from zip(table.log_ns.tolist(), table.rows(), strict=True)

    def events(
        self, stream: SampleStream, advance: Callable[[float], None], last_ns: float = math.inf
    ) -> Iterator[tuple[int, StreamEvent]]:
        """Yield what a stream makes of the records, with the log time [ns] of the record that completed it.

        Args:
            stream: The stream.
            advance: Called with the number of records read since its last call.
            last_ns: Log time to end at [ns].

        Raises:
            InputError: A file has changed since it was opened.

        """
        for count, (log_ns, row) in enumerate(self.rows(last_ns), 1):
            for event in stream.push_row(*row):
                yield log_ns, event
            if count % PROGRESS_EVERY == 0:
                advance(PROGRESS_EVERY)

    def tables(self, last_ns: float = math.inf) -> Iterator[RecordTable]:
        """Yield what :meth:`records` yields, up to a log time [ns], as tables of many records each.

        Raises:
            InputError: A file has changed since it was opened.

        """
        self._unreadable.clear()
        pending, end_ns = EMPTY, np.uint64(min(last_ns, _MAX_LOG_NS))
        for first_ns, index, segment in self._segments():
            ready = int(np.searchsorted(pending.log_ns, np.uint64(first_ns)))
            if ready:
                yield pending[: min(ready, int(np.searchsorted(pending.log_ns, end_ns, side='right')))]
            if first_ns > last_ns:
                return
            pending = joined((pending[ready:], self._table(index, segment)))
        if count := int(np.searchsorted(pending.log_ns, end_ns, side='right')):
            yield pending[:count]

    def _segments(self) -> list[tuple[int, int, Segment]]:
        """Return first log time, number of the file and segment, by first log time."""
        segments = [(item.first_ns, index, item) for index, file in enumerate(self._files) for item in file.segments]
        return sorted(segments, key=itemgetter(0))

    def _table(self, index: int, segment: Segment) -> RecordTable:
        """Return the records of one segment, by log time."""
        block = self._files[index].messages(segment)
        tables, places = [], []
        for number, source in self._sources[index].items():
            rows = np.flatnonzero(block.channel == number) if source.topic in _INPUT_NAMES else _NO_ROWS
            if rows.size:
                topic = _TOPIC_NUMBERS[source.topic]
                table, decoded = decode(block.data, block.start[rows], block.end[rows], block.log_ns[rows], topic)
                if skipped := rows.size - len(table):
                    self._unreadable[source.topic] += skipped
                tables.append(table)
                places.append(rows[decoded])
        if not tables:
            return EMPTY
        # Back into the order of the file, then by log time.
        return joined((in_order_of(np.concatenate(places), tables),))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield our messages, inputs and estimates, by log time.

        Args:
            topics: Names of the topics wanted, all of ours if None; topics of others are left out.

        Raises:
            InputError: A file has changed since it was opened.

        """
        self._unreadable.clear()
        heap: list[tuple[int, int, int, _Source, bytes]] = []
        for rank, (first_ns, index, segment) in enumerate(self._segments()):
            while heap and heap[0][0] < first_ns:
                yield from self._logged(*heappop(heap))
            block, wanted = self._files[index].messages(segment), self._wanted(index, topics)
            columns = (block.channel, block.log_ns, block.start, block.end)
            for place, (channel, log_ns, start, end) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
                if (source := wanted.get(channel)) is not None:
                    heappush(heap, (log_ns, rank, place, source, block.data[start:end].tobytes()))
        while heap:
            yield from self._logged(*heappop(heap))

    def _logged(self, log_ns: int, _rank: int, _place: int, source: _Source, payload: bytes) -> Iterator[LoggedMessage]:
        """Yield a message, nothing if it cannot be read."""
        from rosbags.serde import SerdeError  # noqa: PLC0415 - rarely needed

        try:
            message = typestore().deserialize_cdr(payload, full_type(source.name))
        except SerdeError:
            self._unreadable[source.topic] += 1
        else:
            yield LoggedMessage(log_ns, source.topic, message)

    def _wanted(self, index: int, topics: Collection[str] | None) -> dict[int, _Source]:
        sources = self._sources[index].items()
        return {number: source for number, source in sources if topics is None or source.topic in topics}

    def _topic(self, name: str) -> str:
        full = name if name.startswith('/') else f'/{name}'
        # A name outside the namespace keeps its slash, so that it is nobody's input: two trains may share a bag.
        return full.removeprefix(self._prefix)

    def _check_types(self, file: McapFile, hashes: dict[str, str]) -> dict[int, _Source]:
        """Return the channels of our topics; raise InputError for a type that is not the one of the interface."""
        sources = {}
        for number, channel in file.channels.items():
            topic = self._topic(channel.topic)
            if (name := _OURS.get(topic)) is None:
                continue
            where = f'{file.path}: topic {topic}'
            if (found := _schema_name(file, number)) != full_type(name):
                msg = f'{where}: type {full_type(name)} expected, {found or "none"} found'
                raise InputError(msg)
            if channel.message_encoding != 'cdr':
                msg = f'{where}: encoding cdr expected, {channel.message_encoding!r} found'
                raise InputError(msg)
            text = _stored_text(file, number)
            if not is_packaged(text, name):
                recorded = channel.metadata.get('topic_type_hash') or hashes.get(channel.topic, '')
                stored = _digest_of(text, file, number) if text.strip() else recorded
                if stored != digest(name):
                    msg = f'{where}: definition of {full_type(name)} differs: {digest(name)} expected, '
                    raise InputError(msg + f'{stored or "no definition"} found')
            sources[number] = _Source(topic, name)
        return sources


def require_topics(reader: BagReader, topics: Iterable[InputTopic] = REQUIRED_TOPICS) -> None:
    """Raise InputError, naming them, if input topics have no messages in the bag."""
    if not (missing := missing_topics(reader, topics)):
        return
    found = [topic.name for topic in reader.topics() if topic.count]
    msg = f'{reader.path}: no messages on {", ".join(missing)} (found: {", ".join(found) or "nothing"})'
    raise InputError(msg)


def missing_topics(reader: BagReader, topics: Iterable[InputTopic] = REQUIRED_TOPICS) -> tuple[str, ...]:
    """Return the names of those topics that have no messages in the bag."""
    present = {topic.name for topic in reader.topics() if topic.count}
    return tuple(topic.name for topic in topics if topic.name not in present)


def _schema_name(file: McapFile, channel: int) -> str:
    schema = file.schemas.get(file.channels[channel].schema_id)
    return '' if schema is None else schema.name


def _stored_text(file: McapFile, channel: int) -> str:
    """Return the text of the definition stored with a channel."""
    return file.schemas[file.channels[channel].schema_id].data.decode('utf-8', errors='replace')


def _digest_of(text: str, file: McapFile, channel: int) -> str:
    """Return the RIHS01 digest of the definition stored with a channel."""
    # Imported here because most bags hold the packaged definitions.
    from rosbags.typesys import (  # noqa: PLC0415
        Stores,
        TypesysError,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    schema = file.schemas[file.channels[channel].schema_id]
    store = get_typestore(Stores.EMPTY)
    try:
        if schema.encoding == 'ros2msg':
            store.register(get_types_from_msg(text, schema.name))
        else:
            for part in text.split(_IDL_LINE):
                idl = part.partition('\n')[2] if part.startswith('IDL: ') else part
                if idl.strip():
                    store.register(get_types_from_idl(idl))
        return str(store.hash_rihs01(schema.name))
    except (TypesysError, KeyError) as error:
        msg = f'{file.path}: unreadable definition of {schema.name} ({" ".join(str(error).split())})'
        raise InputError(msg) from None
