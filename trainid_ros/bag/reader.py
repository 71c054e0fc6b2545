# SPDX-License-Identifier: Apache-2.0
"""Records and messages of a bag in the order of their log times."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np

from trainid_ros.bag.bag_files import BagFile, locate, open_file
from trainid_ros.bag.mcap_file import MAX_CHUNK
from trainid_ros.bag.types import (
    EMPTY,
    RecordTable,
    Segment,
    StoredType,
    concatenated,
    decode,
    digest,
    full_type,
    is_packaged,
    joined,
    plain_text,
    table_of,
    type_name,
    typestore,
)
from trainid_ros.inputs.mapping import OWN, Mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    OUTPUT_TOPICS,
    REQUIRED_TOPICS,
    InputTopic,
    Record,
    Row,
    record_from_message,
    record_of,
)
from trainid_ros.interface.text import pluralise

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator
    from collections.abc import Mapping as ReadOnly

    from mcap.records import Channel

    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.stream.sample_stream import SampleStream, StreamEvent

NAMESPACE: Final = 'use --namespace'  # advice where topics lie in other namespaces
_OURS: Final = {topic.name: topic.message for topic in INPUT_TOPICS} | {
    name: topic.message for topic in OUTPUT_TOPICS for name in (topic.name, topic.last_valid) if name
}
_INPUTS: Final = {topic.name: number for number, topic in enumerate(INPUT_TOPICS)}
PROGRESS_EVERY: Final = 500  # records from one report of progress to the next


class LoggedRecord(NamedTuple):
    """A record with the time at which it was logged."""

    log_ns: int  # log time [ns]
    topic: str  # name of the topic
    record: Record  # the record


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a bag."""

    name: str  # relative to the namespace where it lies in it
    type: str  # full message type
    count: int  # number of messages


class _Source(NamedTuple):
    topic: str  # by our name, or that of the mapping
    mapped: StoredType | None = None  # type as stored, if it is mapped


class _TopicNames:
    """Names of topics in a namespace, and which of them are read."""

    def __init__(self, namespace: str, mapping: Mapping) -> None:
        self._prefix = f'/{namespace.strip("/")}/'.replace('//', '/')
        self._replaced = mapping.replaced
        # Names in the mapping by full name.
        self._mapped = {self._full(source.topic): source.topic for source in mapping.sources}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Topics of the mapping outside the namespace: another train's numbers under the name of this one."""
        outside = sorted(name for name in self._mapped if not name.startswith(self._prefix))
        if not outside:
            return ()
        space = self._prefix.rstrip('/')
        return (
            f'mapping: {", ".join(outside)} outside --namespace {space}, so they may be of another train; without a '
            f'leading slash a topic lies in {space}',
        )

    def relative(self, name: str) -> str:
        """Return a name as it is in the namespace."""
        # A name outside the namespace keeps its slash, and is no input: two trains may share a bag.
        return self._full(name, '/').removeprefix(self._prefix)

    def is_needed(self, name: str) -> bool:
        return self.relative(name) in _OURS or self._full(name, '/') in self._mapped

    def sources(self, file: BagFile, hashes: ReadOnly[str, str]) -> dict[int, _Source]:
        """Return the channels of a file that are read, by number; ``hashes`` of types by full name of the topic.

        InputError if a type is not the one of the interface, or messages cannot be decoded.
        """
        sources = {}
        for number, channel in file.channels.items():
            if (foreign := self._mapped.get(self._full(channel.topic, '/'))) is not None:
                where = f'{file.path}: topic {channel.topic}'
                _check_encoding(channel, where)
                if (schema := file.schemas.get(channel.schema_id)) is None:
                    raise InputError(f'{where}: the file states no type')
                sources[number] = _Source(foreign, StoredType(file.path, schema))
                continue
            topic = self.relative(channel.topic)
            if topic in _OURS and topic not in self._replaced:
                _check_type(file, number, f'{file.path}: topic {topic}', _OURS[topic], hashes.get(channel.topic, ''))
                sources[number] = _Source(topic)
        return sources

    def _full(self, name: str, prefix: str = '') -> str:
        """Return the full name of a topic; relative ones lie in the namespace."""
        return name if name.startswith('/') else f'{prefix or self._prefix}{name}'


class BagReader:
    """Reads a rosbag2 directory or a bare ``.mcap`` or ``.db3`` file; damaged MCAP as far as it goes.

    Use as a context manager; a bag can be iterated any number of times. Memory use does not grow with the bag: only
    chunks whose log times overlap are held together. Reading raises InputError if a file has changed since.
    """

    def __init__(
        self,
        path: str | Path,
        namespace: str = '/',
        max_chunk: int = MAX_CHUNK,
        inputs: Callable[[], MappedInputs] | None = None,
        *,
        mapping: Mapping = OWN,
        opening: Callable[[float], None] = lambda _: None,
    ) -> None:
        """Name the bag; it is opened on entering the context.

        Topics outside the namespace keep their full name without the slash, and chunks above ``max_chunk`` [bytes] are
        left out with a warning. Without a factory of the mapped ``inputs`` only our own topics are read; a ``mapping``
        alone serves :meth:`stored`. ``opening`` is called with the share of the bytes scanned since its last call [1].
        """
        self.path = Path(path)
        self._max_chunk, self._inputs, self._opening = max_chunk, inputs, opening
        self._made = None if inputs is None else inputs()
        self.mapping = mapping if self._made is None else self._made.mapping  # where each input comes from
        self._damage: list[str] = []
        self._unreadable: Counter[str] = Counter()  # messages by topic, the last time
        self._names = _TopicNames(namespace, self.mapping)
        self._files: list[BagFile] = []
        self._sources: list[dict[int, _Source]] = []

    def __enter__(self) -> Self:
        """Open and check the bag; InputError if it cannot be read, or one of our topics has another type."""
        located = locate(self.path)
        self._damage = [*located.warnings, *self._names.warnings]
        failures: list[str] = []
        total = max(math.fsum(path.stat().st_size for path in located.files if path.is_file()), 1.0)
        try:
            for path in located.files:
                try:
                    file = open_file(path, self._max_chunk, self._names.is_needed, lambda n: self._opening(n / total))
                except InputError as error:
                    if len(failures := [*failures, str(error)]) == len(located.files):
                        raise InputError(failures[0]) from None
                else:
                    self._files.append(file)
            self._damage += [f'{failure}; the other files of the bag were read' for failure in failures]
            hashes = dict(located.hashes)
            self._sources = [self._names.sources(file, hashes) for file in self._files]
        except BaseException:
            self.close()
            raise
        self._damage += [warning for file in self._files for warning in file.warnings]
        promised = max(located.message_count or 0, sum(file.promised or 0 for file in self._files))
        if promised > self.message_count:
            self._damage.append(f'{self.path}: {self.message_count} of {promised} messages found')
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        for file in self._files:
            file.close()
        self._files, self._sources = [], []

    @property
    def warnings(self) -> list[str]:
        """Faults of a readable bag; unreadable messages are counted while it is read."""
        skipped = [
            f'{self.path}: topic {topic}: {pluralise(count, "message")} skipped that cannot be read'
            for topic, count in sorted(self._unreadable.items())
        ]
        return self._damage + skipped + ([] if self._made is None else self._made.warnings)

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(sum(file.counts.values()) for file in self._files)

    @property
    def input_count(self) -> int:
        """Number of messages on the input topics: what :meth:`records` will yield, and those it skips as unreadable."""
        return sum(count for source, count in self._counts() if source.mapped is not None or source.topic in _INPUTS)

    def _counts(self) -> Iterator[tuple[_Source, int]]:
        """Yield the channels that are read, with their numbers of messages."""
        for file, sources in zip(self._files, self._sources, strict=True):
            yield from ((source, file.counts.get(number, 0)) for number, source in sources.items())

    def time_range(self) -> tuple[int, int] | None:
        """Return the first and the last log time [ns], None for a bag without messages."""
        files = [file for file in self._files if file.counts]
        if not files:
            return None
        return min(file.first_ns for file in files), max(file.last_ns for file in files)

    def topics(self) -> tuple[TopicSummary, ...]:
        """Return all topics by name; a topic written in several types is listed once for each."""
        counts: Counter[tuple[str, str]] = Counter()
        for file in self._files:
            for number, channel in file.channels.items():
                counts[self._names.relative(channel.topic), _schema_name(file, number)] += file.counts.get(number, 0)
        return tuple(TopicSummary(name, kind, count) for (name, kind), count in sorted(counts.items()))

    def missing(self, topic: InputTopic) -> tuple[str, ...]:
        """Return the topics without messages that an input needs: its own, or those of the mapping."""
        present = {source.topic for source, count in self._counts() if count}
        return tuple(name for name in self.mapping.needed(topic.name) if name not in present)

    def records(self) -> Iterator[Record]:
        """Yield the records of the input topics by log time, on equal times in the order of the file within a chunk."""
        return (record_of(*row) for _, row in self.rows())

    def rows(self, last_ns: float = math.inf) -> Iterator[tuple[int, Row]]:
        """Yield log times [ns] and rows of the records, up to a log time [ns]."""
        for table in self.tables(last_ns):
            yield from zip(table.log_ns.tolist(), table.rows(), strict=True)

    def events(
        self, stream: SampleStream, advance: Callable[[float], None], last_ns: float = math.inf
    ) -> Iterator[tuple[int, StreamEvent]]:
        """Yield the events of a stream of the records, with the log time [ns] of the record that completed each.

        It ends at a log time [ns]; ``advance`` is called with the number of records read since its last call.
        """
        for count, (log_ns, row) in enumerate(self.rows(last_ns), 1):
            for event in stream.push_row(*row):
                yield log_ns, event
            if count % PROGRESS_EVERY == 0:
                advance(PROGRESS_EVERY)

    def tables(self, last_ns: float = math.inf) -> Iterator[RecordTable]:
        """Yield the records up to a log time [ns] as tables of many records each."""
        if self._inputs is not None:
            self._made = self._inputs()
            yield from self._mapped_tables(self._made, last_ns)
            return
        self._unreadable.clear()
        pending, end_ns = EMPTY, np.uint64(min(last_ns, 2**64 - 1))
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
        block = segment.read()
        tables, places = [], []
        for number, source in self._sources[index].items():
            if source.topic in _INPUTS and (rows := np.flatnonzero(block.channel == number)).size:
                table, decoded = decode(block, rows, _INPUTS[source.topic])
                if skipped := rows.size - len(table):
                    self._unreadable[source.topic] += skipped
                tables.append(table)
                places.append(rows[decoded])
        if not tables:
            return EMPTY
        # Back into the order of the file, then by log time.
        return joined((concatenated(tables)[np.argsort(np.concatenate(places))],))

    def _mapped_tables(self, inputs: MappedInputs, last_ns: float) -> Iterator[RecordTable]:
        logged: list[tuple[int, Row]] = []
        for log_ns, source, content in self._contents(last_ns):
            if not isinstance(content, bytes):
                records = inputs.take_record(content)
            elif (message := self._decoded(source, content)) is None:
                continue
            else:
                try:
                    records = inputs.take(source.topic, message, log_ns)
                except InputError as error:
                    raise InputError(f'{self.path}: {error}') from None
            logged += [(log_ns, record.row()) for record in records]
            if len(logged) >= 5000:
                yield table_of(logged)
                logged = []
        yield table_of(logged)

    def stored(self) -> Iterator[tuple[int, str, bytes | Record]]:
        """Yield log time [ns], topic and content by log time: our own messages as records, those mapped as stored."""
        return ((log_ns, source.topic, content) for log_ns, source, content in self._contents())

    def _contents(self, last_ns: float = math.inf) -> Iterator[tuple[int, _Source, bytes | Record]]:
        """Yield log time [ns], channel and content of the messages up to a log time [ns], as :meth:`stored`."""
        own = {topic.name: topic for topic in INPUT_TOPICS if topic.name not in self.mapping.replaced}
        for log_ns, source, payload in self._payloads({*own, *self.mapping.topics}):
            if log_ns > last_ns:
                return
            if source.mapped is not None:
                yield log_ns, source, payload
            elif (message := self._decoded(source, payload)) is not None:
                yield log_ns, source, record_from_message(own[source.topic], message)

    def mapped_types(self) -> dict[str, StoredType]:
        """Return the types of the topics of the mapping in the bag; InputError if a topic has several."""
        found: dict[str, StoredType] = {}
        for source in (source for sources in self._sources for source in sources.values()):
            if source.mapped is not None and found.setdefault(source.topic, source.mapped).name != source.mapped.name:
                raise InputError(
                    f'{self.path}: topic {source.topic} is of {found[source.topic].name} and of {source.mapped.name}'
                )
        return found

    def _payloads(self, topics: Collection[str]) -> Iterator[tuple[int, _Source, bytes]]:
        """Yield log times [ns], channels and payloads of the messages of some topics, by log time."""
        self._unreadable.clear()
        pending: list[tuple[int, _Source, bytes]] = []
        for first_ns, index, segment in self._segments():
            ready = bisect_left(pending, first_ns, key=itemgetter(0))
            yield from pending[:ready]
            block = segment.read()
            wanted = {number: item for number, item in self._sources[index].items() if item.topic in topics}
            columns = (block.channel, block.log_ns, block.start, block.end)
            pending[:ready] = ()
            for channel, log_ns, start, end in zip(*(column.tolist() for column in columns), strict=True):
                if (source := wanted.get(channel)) is not None:
                    pending.append((log_ns, source, block.data[start:end].tobytes()))
            pending.sort(key=itemgetter(0))  # equal times stay in the order of the segments, and of the file in each
        yield from pending

    def _decoded(self, source: _Source, payload: bytes) -> Any:
        """Return a message, None if it cannot be read."""
        from rosbags.serde import SerdeError  # noqa: PLC0415 - rarely needed

        try:
            if source.mapped is not None:
                return source.mapped.decode(payload)
            return typestore().deserialize_cdr(payload, full_type(_OURS[source.topic]))
        except SerdeError:
            self._unreadable[source.topic] += 1
            return None


def require_topics(reader: BagReader) -> None:
    """Raise InputError, naming them, if required topics have no messages in the bag."""
    if missing := missing_topics(reader):
        found = [topic.name for topic in reader.topics() if topic.count]
        where = in_namespaces(found) or f'found: {", ".join(found) or "nothing"}'
        raise InputError(f'{reader.path}: no messages on {", ".join(missing)} ({where})')


def missing_topics(reader: BagReader) -> tuple[str, ...]:
    """Return the names of the required topics without messages in the bag."""
    return tuple(name for topic in REQUIRED_TOPICS for name in reader.missing(topic))


def in_namespaces(topics: Iterable[str]) -> str:
    """Return in which namespaces required topics are, and how to choose one; '' if in none."""
    required = tuple(topic.name for topic in REQUIRED_TOPICS)
    elsewhere = [name.strip('/') for name in topics if name.endswith(required)]
    others = {name.rpartition('ato/')[0].strip('/') for name in elsewhere} - {''}
    return f'they are in /{", /".join(sorted(others))}; {NAMESPACE}' if others else ''


def in_two(
    advance: Callable[[float], None], opening_share: float = 0.3
) -> tuple[Callable[[float], None], Callable[[float], None]]:
    """Split a report of progress into one for opening and one for reading a bag, each in shares of its own work [1].

    Opening is ``opening_share`` of the work, as far as the bag is scanned then: one with an index is not.
    """
    opened = 0.0

    def opening(share: float) -> None:
        nonlocal opened
        opened += opening_share * share
        advance(opening_share * share)

    return opening, lambda share: advance((1.0 - opened) * share)


def _schema_name(file: BagFile, channel: int) -> str:
    schema = file.schemas.get(file.channels[channel].schema_id)
    return '' if schema is None else type_name(schema.name)


def _check_type(file: BagFile, number: int, where: str, name: str, recorded: str) -> None:
    channel = file.channels[number]
    if (found := _schema_name(file, number)) != full_type(name):
        raise InputError(f'{where}: type {full_type(name)} expected, {found or "none"} found')
    _check_encoding(channel, where)
    schema = file.schemas[channel.schema_id]
    text = plain_text(schema.data)
    if is_packaged(text, name):
        return
    recorded = channel.metadata.get('topic_type_hash') or recorded
    stored = StoredType(file.path, schema).digest if text.strip() else recorded
    if stored != digest(name):
        raise InputError(
            f'{where}: definition of {full_type(name)} differs: {digest(name)} expected, '
            f'{stored or "no definition"} found'
        )


def _check_encoding(channel: Channel, where: str) -> None:
    if channel.message_encoding != 'cdr':
        raise InputError(f'{where}: encoding cdr expected, {channel.message_encoding!r} found')
