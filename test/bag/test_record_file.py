# SPDX-License-Identifier: Apache-2.0
"""What counts as a record, byte by byte."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from trainid_ros.bag.record_file import MAGIC, Record, RecordFile

if TYPE_CHECKING:
    from pathlib import Path

FOOTER = struct.pack('<BQQQI', Opcode.FOOTER, 20, 0, 0, 0)
DATA_END = struct.pack('<BQI', Opcode.DATA_END, 4, 0)


def opened(path: Path, content: bytes) -> RecordFile:
    path.write_bytes(MAGIC + content + MAGIC)
    return RecordFile(path)


def chunk(compression: str = '', stored: int = 5, content: bytes = b'12345') -> bytes:
    head = struct.pack('<QQQII', 1, 2, len(content), 0, len(compression)) + compression.encode()
    return struct.pack('<BQ', Opcode.CHUNK, len(head) + 8 + len(content)) + head + struct.pack('<Q', stored) + content


def test_a_chunk_states_how_its_records_are_stored(tmp_path: Path) -> None:
    file = opened(tmp_path / 'x.mcap', chunk('lz4') + DATA_END)
    found = file.record(len(MAGIC))
    assert found is not None
    head = file.chunk_head(found)
    assert head is not None
    assert (head.size, head.compression, head.stored) == (5, 'lz4', 5)
    assert file.read(found.start + head.start, 5) == b'12345'


@pytest.mark.parametrize(
    'content', [chunk('gzip'), chunk(stored=6), chunk()[: -len('12345') - 1]], ids=['compression', 'stored', 'cut']
)
def test_what_cannot_be_a_chunk_is_no_record(tmp_path: Path, content: bytes) -> None:
    assert opened(tmp_path / 'x.mcap', content).record(len(MAGIC)) is None


@pytest.mark.parametrize(('name', 'length'), [('lz4', 40), ('lz4', 0), ('', 40)])
def test_a_chunk_without_its_stored_size_has_no_head(tmp_path: Path, name: str, length: int) -> None:
    """The record ends with the name of the compression, or before it."""
    head = struct.pack('<QQQII', 1, 2, 5, 0, len(name)) + name.encode()
    content = struct.pack('<BQ', Opcode.CHUNK, len(head)) + head
    start = len(MAGIC) + 9
    assert (
        opened(tmp_path / 'x.mcap', content).chunk_head(Record(Opcode.CHUNK, start, start + min(length, len(head))))
        is None
    )


@pytest.mark.parametrize('record', [DATA_END + FOOTER, FOOTER, chunk() + DATA_END + FOOTER])
@pytest.mark.parametrize('garbage', [b'', b'\xff', b'\xff' * 100])
@pytest.mark.parametrize('chunked', [False, True])
def test_records_are_found_behind_garbage(tmp_path: Path, record: bytes, garbage: bytes, chunked: bool) -> None:
    file = opened(tmp_path / 'x.mcap', garbage + record)
    assert file.search(len(MAGIC), chunked=chunked) == len(MAGIC) + len(garbage)


def test_where_no_record_follows_the_search_ends_at_the_end(tmp_path: Path) -> None:
    file = opened(tmp_path / 'x.mcap', b'\xff' * 100)
    assert file.search(len(MAGIC), chunked=True) == file.end == len(MAGIC) + 100


SHORTEST = (
    Header('', ''),
    Schema(data=b'', encoding='', id=1, name=''),
    Channel(id=1, topic='', message_encoding='', metadata={}, schema_id=1),
    MessageIndex(channel_id=1, records=[]),
    ChunkIndex(
        chunk_length=0, chunk_start_offset=0, compression='', compressed_size=0, message_end_time=0,
        message_index_length=0, message_index_offsets={}, message_start_time=0, uncompressed_size=0,
    ),
    AttachmentIndex(offset=0, length=0, create_time=0, log_time=0, data_size=0, name='', media_type=''),
    Statistics(
        attachment_count=0, channel_count=0, channel_message_counts={}, chunk_count=0, message_count=0,
        message_end_time=0, message_start_time=0, metadata_count=0, schema_count=0,
    ),
    Metadata(metadata={}, name=''),
    MetadataIndex(offset=0, length=0, name=''),
    SummaryOffset(group_opcode=Opcode.SCHEMA, group_start=0, group_length=0),
    DataEnd(data_section_crc=0),
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0),
)  # fmt: skip


@pytest.mark.parametrize('shortest', SHORTEST, ids=lambda record: type(record).__name__)
def test_the_shortest_record_of_each_kind_is_one_and_a_shorter_one_is_not(tmp_path: Path, shortest: McapRecord) -> None:
    builder = RecordBuilder()
    shortest.write(builder)
    content: bytes = builder.end()  # type: ignore[no-untyped-call]
    opcode, length = struct.unpack_from('<BQ', content)
    assert len(content) == 9 + length
    file = opened(tmp_path / 'x.mcap', content)
    assert file.record(len(MAGIC)) == Record(opcode, len(MAGIC) + 9, file.end)
    cut = struct.pack('<BQ', opcode, length - 1) + content[9:-1]
    assert opened(tmp_path / 'y.mcap', cut).record(len(MAGIC)) is None
