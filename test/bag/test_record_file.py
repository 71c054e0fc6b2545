# SPDX-License-Identifier: Apache-2.0
"""What counts as a record, byte by byte."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest
from mcap.opcode import Opcode

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
    """The name may be that of a compression; no other bytes follow it."""
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
