# SPDX-License-Identifier: Apache-2.0
"""Which channels of the files of a bag are read, under which names, and whether their types are right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from trainid_ros.bag.types import digest, full_type, is_packaged
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS

if TYPE_CHECKING:
    from collections.abc import Mapping as ReadOnly
    from collections.abc import Sequence

    from mcap.records import Channel

    from trainid_ros.bag.bag_files import BagFile
    from trainid_ros.bag.stored_types import StoredType
    from trainid_ros.mapping.mapping import Mapping

_OURS: Final = {topic.name: topic.message for topic in INPUT_TOPICS} | {
    name: topic.message for topic in OUTPUT_TOPICS for name in (topic.name, topic.last_valid) if name
}


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a bag: name relative to the namespace where it lies in it, full type, messages."""

    name: str
    type: str
    count: int


class ChannelSource(NamedTuple):
    """One channel of one file: topic by our name or that of the mapping, short type name, stored type if mapped."""

    topic: str
    name: str
    mapped: StoredType | None = None


class TopicNames:
    """Names of topics in a namespace, and which of them are read."""

    def __init__(self, namespace: str, mapping: Mapping) -> None:
        """Take the namespace of the topics, and where each input comes from."""
        self._prefix = f'/{namespace.strip("/")}/'.replace('//', '/')
        self._replaced = mapping.replaced
        # Names in the mapping by full name.
        self._mapped = {self._full(source.topic): source.topic for source in mapping.sources}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Topics of the mapping that lie outside the namespace: another train's numbers under the name of this one."""
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
        # A name outside the namespace keeps its slash, so that it is nobody's input: two trains may share a bag.
        return self._full(name, '/').removeprefix(self._prefix)

    def is_needed(self, name: str) -> bool:
        """Return whether messages of a topic are read."""
        return self.relative(name) in _OURS or self._full(name, '/') in self._mapped

    def sources(self, file: BagFile, hashes: ReadOnly[str, str]) -> dict[int, ChannelSource]:
        """Return the channels of a file that are read, by number.

        Args:
            file: The file.
            hashes: Type hashes by full name of the topic, of files that hold no definitions.

        Raises:
            InputError: A type is not the one of the interface, or messages cannot be decoded.
        """
        sources = {}
        for number, channel in file.channels.items():
            if (foreign := self._mapped.get(self._full(channel.topic, '/'))) is not None:
                _check_encoding(channel, f'{file.path}: topic {channel.topic}')
                sources[number] = ChannelSource(foreign, _schema_name(file, number), _stored_type(file, number))
                continue
            topic = self.relative(channel.topic)
            if topic in _OURS and topic not in self._replaced:
                _check_type(file, number, f'{file.path}: topic {topic}', _OURS[topic], hashes.get(channel.topic, ''))
                sources[number] = ChannelSource(topic, _OURS[topic])
        return sources

    def summaries(self, files: Sequence[BagFile]) -> tuple[TopicSummary, ...]:
        """Return all topics of some files by name; a topic written in several types is listed once for each."""
        counts: dict[tuple[str, str], int] = {}
        for file in files:
            for number, channel in file.channels.items():
                key = (self.relative(channel.topic), _schema_name(file, number))
                counts[key] = counts.get(key, 0) + file.counts.get(number, 0)
        return tuple(TopicSummary(name, kind, count) for (name, kind), count in sorted(counts.items()))

    def _full(self, name: str, prefix: str = '') -> str:
        """Return the full name of a topic; relative ones lie in the namespace."""
        return name if name.startswith('/') else f'{prefix or self._prefix}{name}'


def _schema_name(file: BagFile, channel: int) -> str:
    schema = file.schemas.get(file.channels[channel].schema_id)
    return '' if schema is None else schema.name


def _check_type(file: BagFile, number: int, where: str, name: str, recorded: str) -> None:
    """Raise InputError if the type of a channel is not the one of the interface."""
    channel = file.channels[number]
    if (found := _schema_name(file, number)) != full_type(name):
        raise InputError(f'{where}: type {full_type(name)} expected, {found or "none"} found')
    _check_encoding(channel, where)
    text = file.schemas[channel.schema_id].data.decode('utf-8', errors='replace')
    if is_packaged(text, name):
        return
    recorded = channel.metadata.get('topic_type_hash') or recorded
    stored = _stored_type(file, number).digest if text.strip() else recorded
    if stored != digest(name):
        raise InputError(
            f'{where}: definition of {full_type(name)} differs: {digest(name)} expected, '
            + f'{stored or "no definition"} found'
        )


def _stored_type(file: BagFile, channel: int) -> StoredType:
    # Imported here because most bags hold the packaged definitions.
    from trainid_ros.bag.stored_types import StoredType  # noqa: PLC0415

    return StoredType(file.path, file.schemas[file.channels[channel].schema_id])


def _check_encoding(channel: Channel, where: str) -> None:
    """Raise InputError, naming file and topic, if the messages of a channel cannot be decoded."""
    if channel.message_encoding != 'cdr':
        raise InputError(f'{where}: encoding cdr expected, {channel.message_encoding!r} found')
