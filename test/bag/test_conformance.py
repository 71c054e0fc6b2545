# SPDX-License-Identifier: Apache-2.0
"""The 416 conformance files of the MCAP project, written anew, and the compressed variants of those with chunks.

The files are six sets of records, each with all combinations of ten features that fit it; see ``tests/conformance`` of
https://github.com/foxglove/mcap. That they are the published ones is shown by their checksums.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from itertools import chain, combinations
from typing import TYPE_CHECKING, Final

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import McapRecord

from trainid_ros.bag.mcap_file import MAGIC, McapFile

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

SCHEMA: Final = records.Schema(id=1, name='Example', encoding='c', data=b'\4\5\6')
CHANNEL: Final = records.Channel(id=1, topic='example', schema_id=1, message_encoding='a', metadata={'foo': 'bar'})


def message(sequence: int, log_time: int, publish_time: int) -> records.Message:
    return records.Message(1, log_time, b'\1\2\3', publish_time, sequence)


SETS: Final[dict[str, tuple[McapRecord, ...]]] = {
    'NoData': (),
    'OneSchemalessMessage': (records.Channel(1, 'example', 'text', {}, schema_id=0), message(10, 2, 1)),
    'OneMessage': (SCHEMA, CHANNEL, message(10, 2, 1)),
    'OneAttachment': (records.Attachment(1, 2, 'myFile', 'application/octet-stream', b'\1\2\3'),),
    'OneMetadata': (records.Metadata('myMetadata', {'foo': 'bar'}),),
    'TenMessages': (SCHEMA, CHANNEL, *(message(k, t, t) for k, t in enumerate([0, 2, 1, 3, 3, 5, 4, 7, 8, 9]))),
}
# Features: chunks, indexes of messages, chunks, attachments and metadata, repeated schemas and channels, statistics,
# offsets of the summary, and records that are longer than known.
FEATURES: Final = ('ax', 'ch', 'chx', 'mdx', 'mx', 'pad', 'rch', 'rsh', 'st', 'sum')
NEEDED: Final = {'ax': records.Attachment, 'mdx': records.Metadata, 'rch': records.Channel, 'rsh': records.Schema}
IN_CHUNKS: Final = (records.Schema, records.Channel, records.Message)
FIXED: Final = (Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END, Opcode.FOOTER)  # these are never longer than known
# Of the lines 'SHA-256 name' of all files by name, from the pointers of Git LFS at commit 95d0673 [SHA-256].
OFFICIAL: Final = '2239adf1702da8b31cb127949a17a6eae6934387902d656389accac5eb9879d6'


def variants() -> Iterator[tuple[str, tuple[McapRecord, ...], frozenset[str]]]:
    """Yield name, records and features of each file."""
    for base, content in SETS.items():
        for some in chain.from_iterable(combinations(FEATURES, count) for count in range(len(FEATURES) + 1)):
            features = frozenset(some)
            held = all(any(isinstance(item, NEEDED[key]) for item in content) for key in features & NEEDED.keys())
            chunked = 'ch' in features and any(isinstance(item, IN_CHUNKS) for item in content)
            summed = bool(features & {'chx', 'rsh', 'rch', 'mdx', 'ax', 'st'})
            if held and chunked >= bool(features & {'ch', 'chx', 'mx'}) and summed >= ('sum' in features):
                yield '-'.join((base, *some)), content, features


class FileBuilder:
    """A file that grows by records."""

    def __init__(self, extra: bytes) -> None:
        self.content, self._extra = bytearray(), extra

    def add(self, item: McapRecord) -> tuple[int, int]:
        """Add a record; return where it starts and how long it is."""
        builder, start = RecordBuilder(), len(self.content)
        item.write(builder)
        found: bytes = builder.end()  # type: ignore[no-untyped-call]
        if found[0] not in FIXED:
            found = struct.pack('<BQ', found[0], len(found) - 9 + len(self._extra)) + found[9:] + self._extra
        self.content += found
        return start, len(found)


def written(content: Iterable[McapRecord], features: frozenset[str], compression: str = '') -> bytes:
    """Return a file."""
    items, file, chunk = list(content), FileBuilder(b'\1\xff\xff' if 'pad' in features else b''), FileBuilder(b'')
    indexes: list[McapRecord] = []
    entries: dict[int, list[tuple[int, int]]] = {}
    times = [item.log_time for item in items if isinstance(item, records.Message)]
    span = (min(times, default=0), max(times, default=0))
    file.content += MAGIC
    file.add(records.Header('', ''))
    for item in items:
        if 'ch' in features and isinstance(item, IN_CHUNKS):
            place, _ = chunk.add(item)
            if isinstance(item, records.Message):
                entries[item.channel_id].append((item.log_time, place))
            elif isinstance(item, records.Channel):
                entries[item.id] = []
            continue
        place, size = file.add(item)
        if isinstance(item, records.Attachment) and 'ax' in features:
            indexes.append(records.AttachmentIndex(place, size, 2, 1, len(item.data), item.name, item.media_type))
        elif isinstance(item, records.Metadata) and 'mdx' in features:
            indexes.append(records.MetadataIndex(place, size, item.name))
    if 'ch' in features:
        data, whole = packed(bytes(chunk.content), compression), len(chunk.content)
        start, length = file.add(records.Chunk(compression, data, span[1], span[0], zlib.crc32(chunk.content), whole))
        found = [(key, *file.add(records.MessageIndex(key, entries[key]))) for key in entries if 'mx' in features]
        places, size = {key: place for key, place, _ in found}, sum(size for _, _, size in found)
        if 'chx' in features:
            indexes.append(
                records.ChunkIndex(length, start, compression, len(data), span[1], size, places, span[0], whole)
            )
    file.add(records.DataEnd(zlib.crc32(file.content)))
    finish(file, items, features, indexes, span)
    return bytes(file.content)


def finish(
    file: FileBuilder,
    items: list[McapRecord],
    features: frozenset[str],
    indexes: list[McapRecord],
    span: tuple[int, int],
) -> None:
    """Add the summary to a file, and what follows it."""
    counts = {kind: sum(isinstance(item, kind) for item in items) for kind in (*IN_CHUNKS, *NEEDED.values())}
    by_channel = {1: counts[records.Message]} if counts[records.Message] else {}
    groups: dict[int, Sequence[McapRecord]] = {
        Opcode.SCHEMA: [item for item in items if isinstance(item, records.Schema) and 'rsh' in features],
        Opcode.CHANNEL: [item for item in items if isinstance(item, records.Channel) and 'rch' in features],
        Opcode.STATISTICS: [
            records.Statistics(
                counts[records.Attachment], counts[records.Channel], by_channel, int('ch' in features),
                counts[records.Message], *span[::-1], counts[records.Metadata], counts[records.Schema],
            )
        ] if 'st' in features else [],
        Opcode.METADATA_INDEX: [item for item in indexes if isinstance(item, records.MetadataIndex)],
        Opcode.ATTACHMENT_INDEX: [item for item in indexes if isinstance(item, records.AttachmentIndex)],
        Opcode.CHUNK_INDEX: [item for item in indexes if isinstance(item, records.ChunkIndex)],
    }  # fmt: skip
    begin, offsets = len(file.content), []
    for opcode, group in groups.items():
        start = len(file.content)
        for item in group:
            file.add(item)
        if group:
            offsets.append(records.SummaryOffset(opcode, start, len(file.content) - start))
    end = len(file.content)
    for offset in offsets if 'sum' in features else ():
        file.add(offset)
    places = (begin if offsets else 0, end if 'sum' in features else 0)
    file.content += struct.pack('<BQQQ', Opcode.FOOTER, 20, *places)
    file.content += struct.pack('<I', zlib.crc32(file.content[begin:])) + MAGIC


def packed(data: bytes, compression: str) -> bytes:
    if compression == 'lz4':
        return bytes(lz4.frame.compress(data))
    return zstandard.compress(data) if compression else data


def test_these_are_the_published_files() -> None:
    made = {name: hashlib.sha256(written(content, features)).hexdigest() for name, content, features in variants()}
    assert len(made) == 416
    lines = ''.join(f'{made[name]} {name}\n' for name in sorted(made))
    assert hashlib.sha256(lines.encode()).hexdigest() == OFFICIAL


@pytest.mark.parametrize('compression', ['', 'lz4', 'zstd'])
def test_all_messages_are_read_without_a_warning(tmp_path: Path, compression: str) -> None:
    path = tmp_path / 'x.mcap'
    for name, content, features in variants():
        if compression and 'ch' not in features:
            continue
        path.write_bytes(written(content, features, compression))
        file = McapFile(path)
        blocks = [segment.read() for segment in file.segments]
        file.close()
        found = [
            (log_ns, bytes(block.data[a:b]))
            for block in blocks
            for log_ns, a, b in zip(block.log_ns.tolist(), block.start, block.end, strict=True)
        ]
        expected = [(item.log_time, item.data) for item in content if isinstance(item, records.Message)]
        assert (file.warnings, found, file.promised) == ([], expected, len(expected) if 'st' in features else None), (
            name
        )
