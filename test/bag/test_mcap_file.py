# SPDX-License-Identifier: Apache-2.0
"""What counts as a record, byte by byte; large messages of other topics, of which only what is needed is read."""

from __future__ import annotations

import math
import struct
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_origin, get_type_hints

import pytest
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from test.own_bag import changed
from trainid_ros.bag import mcap_file
from trainid_ros.bag.mcap_file import MAGIC, Record, RecordFile
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.run_reader import survey

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.interface.records import Row

IMAGE = bytes(300_000)
IMAGES = 40
CHUNK = 768 * 1024
TINY = Path(__file__).parents[2] / 'bags' / 'tiny'


def write(
    tiny: Path,
    path: Path,
    compression: CompressionType,
    *,
    image: bytes = IMAGE,
    apart: bool = False,
    chunk_bytes: int = CHUNK,
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


tiny_rows = cache(partial(rows, TINY))


class Counted(RecordFile):
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
    expected, _, count, span = tiny_rows()
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


def test_a_survey_counts_each_bag_as_one_however_much_of_it_is_scanned(tmp_path: Path) -> None:
    large, steps = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE, image=bytes(60_000)), list[float]()
    survey([large, TINY], advance=steps.append)
    assert min(steps) >= 0.0
    assert math.fsum(steps) == pytest.approx(2.0)


def test_a_damaged_image_is_no_matter(tmp_path: Path) -> None:
    marked = b'image' * 60_000
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE, image=marked)
    with changed(path) as content:
        content[content.index(marked) + 1000] ^= 1
    assert rows(path)[:2] == (tiny_rows()[0], [])


@pytest.mark.parametrize('at', [9, 15, 23], ids=['channel', 'log time', 'place'])
def test_whole_chunks_are_read_where_their_indexes_claim_other_messages(tmp_path: Path, at: int) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE)
    with path.open('rb') as file, changed(path) as content:
        summary = make_reader(file).get_summary()
        assert summary is not None
        for chunk in summary.chunk_indexes:
            for offset in chunk.message_index_offsets.values():
                content[offset + at] ^= 3
    assert rows(path)[0] == tiny_rows()[0]


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


@pytest.mark.parametrize(
    ('compression', 'chunk_bytes', 'change'),
    [
        *((compression, CHUNK, {'grown': [opcode]}) for compression in CompressionType for opcode in GROWING),
        *((CompressionType.NONE, 0, {'grown': [opcode]}) for opcode in (Opcode.SCHEMA, Opcode.CHANNEL)),
        *(
            (CompressionType.ZSTD, CHUNK, {'added': packed(opcode, b'new') + packed(opcode, b'')})
            for opcode in (0x10, 0x7F, 0x80, 0xFF)
        ),
    ],
)
def test_records_that_are_longer_than_known_or_of_unknown_kinds_lose_nothing(
    tmp_path: Path, compression: CompressionType, chunk_bytes: int, change: dict[str, Any]
) -> None:
    path = write(TINY, tmp_path / 'a.mcap', compression, chunk_bytes=chunk_bytes)
    content = extended(path.read_bytes(), **change)
    assert chunk_bytes or len(content) > path.stat().st_size
    path.write_bytes(content)
    assert rows(path)[:2] == (tiny_rows()[0], [])


@pytest.mark.parametrize('opcode', GROWING_AT_THE_END)
def test_records_of_the_summary_may_be_longer_than_known(tmp_path: Path, opcode: int) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE)
    path.write_bytes(extended(path.read_bytes(), at_the_end=[opcode]))
    file = RecordFile(path)
    summary = file.summary()
    file.close()
    assert summary.statistics is not None
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    assert rows(path)[:2] == (tiny_rows()[0], [])


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
    expected = tiny_rows()[0]
    rest = iter(expected)
    assert all(row in rest for row in found)
    assert len(found) > 0.4 * len(expected)
    assert [f'from byte {chunks[1].offset} on are lost' in text for text in warnings].count(True) == 1
    assert f'{path}: {count} of ' in warnings[-1]


def test_messages_on_unknown_channels_are_lost_alone(tmp_path: Path) -> None:
    path = write(TINY, tmp_path / 'a.mcap', CompressionType.NONE, image=b'', chunk_bytes=0)
    expected, messages = rows(path)[0], iter(places(path, Opcode.MESSAGE))
    for channel in (98, 99):
        start = next(messages).start
        with changed(path) as content:
            content[start : start + 2] = struct.pack('<H', channel)
    found, warnings, _, _ = rows(path)
    assert found in (expected, expected[1:], expected[2:])
    for channel in (98, 99):
        assert any(f'messages on the unknown channel {channel} ' in text for text in warnings)


def places(path: Path, opcode: int) -> Iterable[Record]:
    """Yield the records of one kind."""
    file, position = RecordFile(path), len(MAGIC)
    while (record := file.record(position)) is not None:
        if record.opcode == opcode:
            yield record
        position = record.end
    file.close()


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
    found = Record(Opcode.CHUNK, len(MAGIC) + 9, len(MAGIC) + 9 + min(length, len(head)))
    assert opened(tmp_path / 'x.mcap', content).chunk_head(found) is None


@pytest.mark.parametrize('record', [DATA_END + FOOTER, FOOTER, chunk() + DATA_END + FOOTER])
@pytest.mark.parametrize('garbage', [b'', b'\xff', b'\xff' * 100])
@pytest.mark.parametrize('chunked', [False, True])
def test_records_are_found_behind_garbage(tmp_path: Path, record: bytes, garbage: bytes, chunked: bool) -> None:
    file = opened(tmp_path / 'x.mcap', garbage + record)
    assert file.search(len(MAGIC), chunked=chunked) == len(MAGIC) + len(garbage)


def test_where_no_record_follows_the_search_ends_at_the_end(tmp_path: Path) -> None:
    file = opened(tmp_path / 'x.mcap', b'\xff' * 100)
    assert file.search(len(MAGIC), chunked=True) == file.end == len(MAGIC) + 100


KINDS = (
    *(records.Header, records.Schema, records.Channel, records.MessageIndex, records.ChunkIndex),
    *(records.AttachmentIndex, records.Statistics, records.Metadata, records.MetadataIndex, records.SummaryOffset),
    *(records.DataEnd, records.Footer),
)


@pytest.mark.parametrize('kind', KINDS)
def test_the_shortest_record_of_each_kind_is_one_and_a_shorter_one_is_not(tmp_path: Path, kind: type[Any]) -> None:
    shortest = kind(**{name: (get_origin(hint) or hint)() for name, hint in get_type_hints(kind).items()})
    builder = RecordBuilder()
    shortest.write(builder)
    content: bytes = builder.end()  # type: ignore[no-untyped-call]
    opcode, length = struct.unpack_from('<BQ', content)
    assert len(content) == 9 + length
    file = opened(tmp_path / 'x.mcap', content)
    assert file.record(len(MAGIC)) == Record(opcode, len(MAGIC) + 9, file.end)
    cut = struct.pack('<BQ', opcode, length - 1) + content[9:-1]
    assert opened(tmp_path / 'y.mcap', cut).record(len(MAGIC)) is None


@pytest.mark.parametrize(('opcode', 'is_one'), [(0x10, False), (0x7F, False), (0x80, True), (0xFF, True)])
def test_a_record_of_a_private_kind_needs_no_known_one_behind_it(tmp_path: Path, opcode: int, is_one: bool) -> None:
    """The specification keeps the kinds from 0x80 on for others."""
    file = opened(tmp_path / 'x.mcap', struct.pack('<BQ', opcode, 0) + b'\xff' * 20)
    assert (file.record(len(MAGIC)) is not None) is is_one
