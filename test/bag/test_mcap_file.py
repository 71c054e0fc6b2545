# SPDX-License-Identifier: Apache-2.0
"""Bags with large messages of other topics, of which only what is needed is read, and with records that have grown."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from test.own_bag import changed
from trainid_ros.bag import mcap_file, record_file
from trainid_ros.bag.reader import BagReader

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.interface.records import Row

IMAGE = bytes(300_000)
IMAGES = 40
TINY = Path(__file__).parents[2] / 'bags' / 'tiny'


def write(
    tiny: Path,
    path: Path,
    compression: CompressionType,
    *,
    image: bytes = IMAGE,
    apart: bool = False,
    chunk_bytes: int = 768 * 1024,
) -> Path:
    """Write the messages of the tiny bag with images between them, or with all images at the end."""
    source = next(tiny.glob('*.mcap'))
    with source.open('rb') as file, path.open('wb') as out:
        reader = make_reader(file)
        writer = Writer(out, chunk_size=chunk_bytes, compression=compression, use_chunking=chunk_bytes > 0)
        writer.start('ros2')
        schema = writer.register_schema('x/msg/Image', 'ros2msg', b'uint8[] data')
        camera = writer.register_channel('/camera', 'cdr', schema)
        numbers: dict[int, int] = {}
        messages = list(reader.iter_messages(log_time_order=True))
        every = len(messages) // IMAGES
        for k, (schema_found, channel, message) in enumerate(messages):
            if channel.id not in numbers and schema_found is not None:
                kind = writer.register_schema(schema_found.name, schema_found.encoding, schema_found.data)
                numbers[channel.id] = writer.register_channel(channel.topic, 'cdr', kind, channel.metadata)
            writer.add_message(numbers[channel.id], message.log_time, message.data, message.publish_time)
            if not apart and k % every == 0:
                writer.add_message(camera, message.log_time, image, message.log_time)
        for k in range(IMAGES if apart else 0):
            writer.add_message(camera, messages[0][2].log_time + k, image, messages[0][2].log_time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def rows(path: Path) -> tuple[list[tuple[int, Row]], list[str], int, tuple[int, int] | None]:
    """Return rows, warnings, number of messages and time range of a bag."""
    with BagReader(path) as reader:
        return list(reader.rows()), reader.warnings, reader.message_count, reader.time_range()


class Counted(record_file.RecordFile):
    """A file that counts the bytes read."""

    total = 0

    def read(self, offset: int, length: int) -> bytes:
        """Return and count bytes."""
        content = super().read(offset, length)
        Counted.total += len(content)
        return content


@pytest.mark.parametrize('apart', [False, True])
@pytest.mark.parametrize('compression', [CompressionType.NONE, CompressionType.ZSTD])
def test_the_same_messages_are_read_beside_a_camera(
    tmp_path: Path, compression: CompressionType, *, apart: bool
) -> None:
    path = write(TINY, tmp_path / 'a.mcap', compression, apart=apart)
    expected, _, count, span = rows(TINY)
    found, warnings, more, found_span = rows(path)
    assert found == expected
    assert warnings == []
    assert found_span == span
    assert IMAGES <= more - count <= IMAGES + 2


@pytest.mark.parametrize('apart', [False, True])
def test_images_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, apart: bool) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE, apart=apart)
    monkeypatch.setattr(mcap_file, 'RecordFile', Counted)
    Counted.total = 0
    rows(path)
    assert Counted.total < 0.25 * path.stat().st_size


def test_a_damaged_image_is_no_matter_and_a_damaged_index_is_not_relied_on(tmp_path: Path) -> None:
    expected = rows(TINY)[0]
    marked = b'image' * 60_000
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE, image=marked)
    with changed(path) as content:
        content[content.index(marked) + 1000] ^= 1
    assert rows(path)[:2] == (expected, [])
    # Indexes that claim messages of another channel: the whole chunks are read instead.
    path = write(TINY, tmp_path / 'b.mcap', CompressionType.NONE, image=marked)
    with path.open('rb') as file, changed(path) as content:
        summary = make_reader(file).get_summary()
        assert summary is not None
        for chunk in summary.chunk_indexes:
            for offset in chunk.message_index_offsets.values():
                content[offset + 9] ^= 3
    assert rows(path)[0] == expected


MAGIC = record_file.MAGIC
# All that the specification lets grow, in the part with the messages and after it.
GROWING = (Opcode.HEADER, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
GROWING_AT_THE_END = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.SUMMARY_OFFSET, Opcode.CHUNK_INDEX)


def packed(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


def extended(content: bytes, grown: Iterable[int] = (), added: bytes = b'', at_the_end: Iterable[int] = ()) -> bytes:
    """Return a file in which some kinds of records have three more bytes, and something was added after each chunk.

    The index of the chunks is left out where places change, and so are checksums.
    """
    out, position, is_summary, summary = bytearray(MAGIC), len(MAGIC), False, 0
    while position < len(content) - len(MAGIC):
        opcode, length = struct.unpack_from('<BQ', content, position)
        body = content[position + 9 : position + 9 + length]
        position += 9 + length
        if opcode in (at_the_end if is_summary else grown):
            body += b'\x05\0\xff'
        if opcode == Opcode.DATA_END:
            body = bytes(4)
        elif opcode == Opcode.FOOTER:
            body = struct.pack('<QQI', summary, 0, 0)
        elif opcode == Opcode.CHUNK_INDEX and (grown or added):
            continue
        out += packed(opcode, body)
        if opcode == Opcode.CHUNK:
            out += added
        elif opcode == Opcode.DATA_END:
            is_summary, summary = True, len(out)
    return bytes(out) + MAGIC


@pytest.mark.parametrize('opcode', GROWING)
@pytest.mark.parametrize('compression', list(CompressionType))
def test_records_may_be_longer_than_known(tmp_path: Path, compression: CompressionType, opcode: int) -> None:
    path = write(TINY, tmp_path / 'a.mcap', compression)
    path.write_bytes(extended(path.read_bytes(), grown=[opcode]))
    assert rows(path)[:2] == (rows(TINY)[0], [])


@pytest.mark.parametrize('opcode', [Opcode.SCHEMA, Opcode.CHANNEL])
def test_definitions_may_be_longer_than_known(tmp_path: Path, opcode: int) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE, chunk_bytes=0)
    content = extended(path.read_bytes(), grown=[opcode])
    assert len(content) > path.stat().st_size
    path.write_bytes(content)
    assert rows(path)[:2] == (rows(TINY)[0], [])


@pytest.mark.parametrize('opcode', GROWING_AT_THE_END)
def test_records_of_the_summary_may_be_longer_than_known(tmp_path: Path, opcode: int) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE)
    path.write_bytes(extended(path.read_bytes(), at_the_end=[opcode]))
    file = record_file.RecordFile(path)
    summary = file.summary()
    file.close()
    assert summary.statistics is not None
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    assert rows(path)[:2] == (rows(TINY)[0], [])


@pytest.mark.parametrize('opcode', [0x10, 0x7F, 0x80, 0xFF])
def test_records_of_unknown_kinds_are_ignored(tmp_path: Path, opcode: int) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.ZSTD)
    path.write_bytes(extended(path.read_bytes(), added=packed(opcode, b'new') + packed(opcode, b'')))
    assert rows(path)[:2] == (rows(TINY)[0], [])


@pytest.mark.parametrize('opcode', [*GROWING, 0x10])
def test_damage_to_a_file_with_longer_records_costs_one_chunk(tmp_path: Path, opcode: int) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.ZSTD, image=b'', chunk_bytes=50_000)
    added = packed(0x10, b'new') if opcode == 0x10 else b''
    content = bytearray(extended(path.read_bytes(), grown=[opcode], added=added))
    path.write_bytes(content)
    chunks = list(places(path, Opcode.CHUNK))
    assert len(chunks) > 2
    content[chunks[1].offset : chunks[1].offset + 100] = bytes(100)
    path.write_bytes(content)
    found, warnings, count, _ = rows(path)
    expected = rows(TINY)[0]
    rest = iter(expected)
    assert all(row in rest for row in found)
    assert len(found) > 0.4 * len(expected)
    assert [f'from byte {chunks[1].offset} on are lost' in text for text in warnings].count(True) == 1
    assert f'{path}: {count} of ' in warnings[-1]


def places(path: Path, opcode: int) -> Iterable[record_file.Record]:
    """Yield the records of one kind."""
    file, position = record_file.RecordFile(path), len(MAGIC)
    while (record := file.record(position)) is not None:
        if record.opcode == opcode:
            yield record
        position = record.end
    file.close()
