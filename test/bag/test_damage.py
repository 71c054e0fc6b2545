# SPDX-License-Identifier: Apache-2.0
"""All kinds of damage to a bag on disk."""

from __future__ import annotations

import os
import resource
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from benchmarks.damage import campaign
from test.own_bag import START_NS as STAMP
from test.own_bag import changed, error_of, read_bag
from trainid_ros.bag.mcap_file import MAGIC, ChunkHead, RecordFile
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import full_type, message_from_record, typestore
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import MassRecord

if TYPE_CHECKING:
    from trainid_ros.interface.records import Record

COUNT = 2000


def write_file(
    path: Path,
    compression: CompressionType = CompressionType.NONE,
    *,
    chunked: bool = True,
    chunk_bytes: int = 8192,
    count: int = COUNT,
) -> list[MassRecord]:
    """Write a bare file of many small chunks, with CRC, or without chunks."""
    name = full_type('TrainMass')
    text, _ = typestore().generate_msgdef(name, ros_version=2)
    records = [MassRecord(STAMP + i, 1e5 + i) for i in range(count)]
    writer = McapWriter(
        str(path), chunk_size=chunk_bytes, compression=compression, use_chunking=chunked, enable_data_crcs=True
    )
    writer.start('ros2')
    schema = writer.register_schema(name, 'ros2msg', text.encode())
    channel = writer.register_channel('/ato/mass', 'cdr', schema)
    for record in records:
        payload = bytes(typestore().serialize_cdr(message_from_record(record), name))
        writer.add_message(channel, record.stamp_ns, payload, record.stamp_ns)
    writer.finish()  # type: ignore[no-untyped-call]
    return records


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / 'x.mcap'


@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize('chunked', [True, False])
def test_every_kind_of_intact_file_is_read(path: Path, compression: CompressionType, *, chunked: bool) -> None:
    assert (write_file(path, compression, chunked=chunked), []) == read_bag(path)


@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize('chunked', [True, False])
@pytest.mark.parametrize('share', [0.3, 0.6])
def test_cut_file_is_recovered_up_to_the_cut(
    path: Path, compression: CompressionType, share: float, *, chunked: bool
) -> None:
    records = write_file(path, compression, chunked=chunked)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    found, (warning,) = read_bag(path)
    assert found == records[: len(found)]
    # Index and summary are the smaller part of the file, so nearly this share of the messages is left.
    assert 0.5 * share * COUNT < len(found) < COUNT
    assert str(path) in warning
    assert f'{len(found)} messages' in warning


def test_lost_index_loses_no_message(bag: Path) -> None:
    path = bag / 'bag.mcap'
    path.write_bytes(path.read_bytes()[:-20])
    found, warnings = read_bag(bag)
    assert len(found) == 200
    assert [('index' in text) for text in warnings] == [True]


def test_lost_messages_are_detected_by_the_metadata(bag: Path) -> None:
    path = bag / 'metadata.yaml'
    path.write_text(path.read_text().replace('message_count: 200', 'message_count: 201'))
    assert read_bag(bag)[1] == [f'{bag}: 200 of 201 messages found']


@pytest.mark.parametrize('compression', list(CompressionType))
def test_file_padded_with_zeros_after_a_power_cut(path: Path, compression: CompressionType) -> None:
    records = write_file(path, compression)
    content = path.read_bytes()
    start, length = first_chunk(content)
    kept = start + 3 * length + length // 2
    path.write_bytes(content[:kept] + bytes(len(content) - kept))
    found, (warning,) = read_bag(path)
    assert found == records[: len(found)]
    assert 0 < len(found) < COUNT
    assert 'cut off' in warning


def first_chunk(content: bytes | bytearray) -> tuple[int, int]:
    """Return the offset and the length of the first chunk with its head."""
    position = len(MAGIC)
    while True:
        opcode, length = struct.unpack_from('<BQ', content, position)
        if opcode == Opcode.CHUNK:
            return position, length + 9
        position += 9 + length


@pytest.mark.parametrize('compression', list(CompressionType))
def test_only_the_chunk_with_a_flipped_bit_is_lost(path: Path, compression: CompressionType) -> None:
    records = write_file(path, compression)
    with changed(path) as content:
        start, length = first_chunk(content)
        content[start + length // 2] ^= 0x10
    found, warnings = read_bag(path)
    # Its definitions were lost too: they come from the summary.
    assert found == records[-len(found) :]
    assert len(found) > 0.9 * COUNT
    assert warnings[0].startswith(f'{path}: {length} bytes from byte {start} on are lost: ')
    assert warnings[1:] == [f'{path}: {len(found)} of {COUNT} messages found']


@pytest.mark.parametrize('shift', [-1, 5, -300, 300])
@pytest.mark.parametrize('has_crc', [True, False])
def test_bytes_lost_or_added_in_the_first_chunk_lose_no_other_one(path: Path, shift: int, *, has_crc: bool) -> None:
    records = write_file(path)
    content = bytearray(path.read_bytes())
    start, length = first_chunk(content)
    place = start + length // 2
    content[place : place - min(shift, 0)] = bytes(max(shift, 0))
    if not has_crc:
        content[-len(MAGIC) - 4 : -len(MAGIC)] = bytes(4)
    path.write_bytes(content)
    found, warnings = read_bag(path)
    assert found == records[-len(found) :]
    assert len(found) > 0.8 * COUNT
    assert warnings[-1] == f'{path}: {len(found)} of {COUNT} messages found'


def test_no_summary_is_looked_for_where_there_is_none(path: Path) -> None:
    records = write_file(path)
    with changed(path) as content:
        content[-len(MAGIC) - 20 : -len(MAGIC)] = bytes(20)  # as of a writer without a summary
    assert RecordFile(path).summary().statistics is None
    assert read_bag(path)[0] == records


def test_every_flipped_byte_of_a_written_chunk_is_found(bag: Path) -> None:
    path = bag / 'bag.mcap'
    content = path.read_bytes()
    start, length = first_chunk(content)
    for place in range(start + 9 + 16, start + length, max(1, length // 40)):
        damaged = bytearray(content)
        damaged[place] ^= 0x01
        path.write_bytes(damaged)
        assert f'{path}: nothing of it can be used: ' in error_of(path)


@pytest.mark.parametrize('kind', ['cut at a byte', 'one bit flipped', 'a block of zeros'])
@pytest.mark.parametrize('compression', list(CompressionType))
def test_random_damage_loses_no_intact_chunk(tmp_path: Path, compression: CompressionType, kind: str) -> None:
    score = campaign(5, tmp_path, compression, kind, seed=2)
    assert score.files == 5
    assert score.intact > 2000
    assert score.share == 1.0
    assert (score.rejected, score.wrong, score.unsaid) == (0, 0, 0)


@pytest.mark.parametrize(
    ('compression', 'share'), [(CompressionType.NONE, 0.99), (CompressionType.LZ4, 0.7), (CompressionType.ZSTD, 0.7)]
)
def test_messages_of_a_chunk_that_was_cut_off_are_used(path: Path, compression: CompressionType, share: float) -> None:
    records = write_file(path, compression, count=5000, chunk_bytes=1 << 20)  # all in one chunk
    content = path.read_bytes()
    start, length = first_chunk(content)
    path.write_bytes(content[: start + length - 30])
    found, (warning,) = read_bag(path)
    assert found == records[: len(found)]
    assert len(found) > share * len(records)
    assert warning.endswith(f'{len(found)} messages were recovered, the last {length - 30} bytes are incomplete')


def test_chunk_that_unpacks_to_more_than_the_limit_is_left_out(path: Path) -> None:
    records = write_file(path, CompressionType.ZSTD)
    with pytest.raises(InputError, match=r'0.00782 MB in one piece, above the limit of .* MB \(--max-chunk\)'):
        BagReader(path, max_chunk=1000).__enter__()
    with BagReader(path, max_chunk=9000) as reader:
        assert reader.message_count == len(records)


def bomb(compression: str, stored: bytes, size: int) -> bytes:
    """Return a file with one chunk that states a size."""
    name = compression.encode()
    content = struct.pack('<QQQII', 0, 0, size, 0, len(name)) + name + struct.pack('<Q', len(stored)) + stored
    header = struct.pack('<II', 0, 0)
    return MAGIC + struct.pack('<BQ', 1, len(header)) + header + struct.pack('<BQ', 6, len(content)) + content


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_at_most_one_byte_more_than_stated_is_unpacked(compression: str) -> None:
    packed = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress}[compression](b'abc' * 1000)
    head = ChunkHead(10, 0, compression, 0, len(packed))
    assert head.unpack_start(packed) == (b'abc' * 4)[:11]


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
@pytest.mark.parametrize('stated', [1000, 60_000_000, 1_500_000_000])
def test_bombs_take_little_memory(path: Path, compression: str, stated: int) -> None:
    size = 200_000_000
    packed = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress}[compression](bytes(size))
    path.write_bytes(bomb(compression, packed, stated) + bomb(compression, packed, stated)[8:] + MAGIC)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert 'nothing of it can be used' in error_of(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 150_000  # kB


def test_many_chunks_that_unpack_to_much_are_left_out_without_unpacking_them(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = 50_000_000
    chunk = bomb('zstd', zstandard.compress(bytes(size)), size)[8 + 17 :]
    path.write_bytes(MAGIC + struct.pack('<BQII', 1, 8, 0, 0) + 500 * chunk + MAGIC)
    unpacked: list[ChunkHead] = []

    def note(head: ChunkHead, stored: bytes) -> bytes:
        unpacked.append(head)
        return unpack(head, stored)

    unpack = ChunkHead.unpack
    monkeypatch.setattr(ChunkHead, 'unpack', note)
    assert 'nothing of it can be used' in error_of(path)
    assert len(unpacked) == 1


def test_record_length_that_runs_past_the_end_of_a_closed_file(path: Path) -> None:
    records = write_file(path)
    with changed(path) as content:
        struct.pack_into('<Q', content, len(MAGIC) + 1, 1 << 60)
    found, (warning,) = read_bag(path)
    assert found == records
    assert f'bytes from byte {len(MAGIC)} on are lost: no valid record' in warning


def test_wrong_value_without_a_checksum_of_its_own_is_said(path: Path) -> None:
    write_file(path, chunked=False)
    with changed(path) as content:
        content[len(content) // 2] ^= 0x10
    assert read_bag(path)[1]


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        (b'', 'is empty'),
        (MAGIC, 'holds no records, only the MCAP signature'),
        (b'no bag at all', 'is not an MCAP file'),
        (MAGIC[:5], 'is not an MCAP file'),
        (MAGIC + bytes(100), 'was cut off before the first complete message, nothing can be recovered'),
    ],
)
def test_file_without_content_is_named(path: Path, content: bytes, reason: str) -> None:
    path.write_bytes(content)
    assert error_of(path) == f'{path}: {reason}'


def test_missing_metadata_is_reported_and_the_bag_read(bag: Path, records: list[Record]) -> None:
    (bag / 'metadata.yaml').unlink()
    found, (warning,) = read_bag(bag)
    assert found == records
    assert 'metadata.yaml is missing' in warning


@pytest.mark.parametrize('text', ['{', 'nothing: here', '', 'rosbag2_bagfile_information: 3', '\udcff', 'mcaq', 'nonf'])
def test_unreadable_metadata_is_reported_and_the_bag_read(bag: Path, records: list[Record], text: str) -> None:
    path = bag / 'metadata.yaml'
    whole = path.read_text()
    flipped = {
        'mcaq': whole.replace('storage_identifier: mcap', 'storage_identifier: mcaq'),
        'nonf': whole.replace("compression_mode: ''", 'compression_mode: nonf'),
    }
    path.write_bytes(flipped.get(text, text).encode('utf-8', 'surrogateescape'))
    found, (warning,) = read_bag(bag)
    assert found == records
    assert 'metadata.yaml: unreadable' in warning
    assert '\n' not in warning
    assert text not in flipped or text in warning


def test_file_named_in_metadata_but_missing(bag: Path, records: list[Record]) -> None:
    (bag / 'bag.mcap').rename(bag / 'other.mcap')
    found, (warning,) = read_bag(bag)
    assert found == records
    assert warning.startswith(f'{bag / "bag.mcap"}: file listed in metadata.yaml is missing, ')
    (bag / 'other.mcap').unlink()
    assert error_of(bag) == f'{bag / "bag.mcap"}: file listed in metadata.yaml is missing'


def test_pipes_and_devices_are_no_bags(tmp_path: Path, bag: Path) -> None:
    os.mkfifo(tmp_path / 'pipe.mcap')
    assert error_of(tmp_path / 'pipe.mcap').endswith('is neither a file nor a directory')
    assert error_of(Path('/dev/zero')).endswith('is neither a file nor a directory')
    (bag / 'metadata.yaml').unlink()
    os.mkfifo(bag / 'metadata.yaml')
    os.mkfifo(bag / 'z.mcap')
    assert len(read_bag(bag)[0]) == 200


def test_a_path_without_a_bag_is_named(tmp_path: Path) -> None:
    assert error_of(tmp_path / 'nope') == f'{tmp_path / "nope"}: no such bag'
    assert 'no bag in this directory' in error_of(tmp_path)
    (tmp_path / 'x.csv').write_text('t,v\n', encoding='utf-8')
    assert error_of(tmp_path / 'x.csv').endswith('x.csv: is a table, not a bag; trainid import makes a bag of it')


def test_parts_of_a_split_bag_are_read_in_order(tmp_path: Path) -> None:
    records = write_file(tmp_path / 'x_9.mcap')
    write_file(tmp_path / 'x_10.mcap')
    found, _ = read_bag(tmp_path)
    # Both parts have the same stamps; on a tie the part with the smaller number comes first.
    assert found == [record for record in records for _ in range(2)]


def test_record_that_runs_past_the_end_of_its_chunk_is_lost_alone(path: Path) -> None:
    records = write_file(path, chunk_bytes=1 << 20)  # all in one chunk
    with changed(path) as content:
        start, length = first_chunk(content)
        head = 9 + 40  # of a chunk that is not compressed
        content[start + 9 + 24 : start + 9 + 28] = bytes(4)  # no checksum of the chunk
        message = last_message(content, start + head, start + length)
        struct.pack_into('<Q', content, message + 1, 1000)
    found, warnings = read_bag(path)
    assert found == records[:-1]
    size = length - head
    assert warnings[0].endswith(f'are lost: all after {message - start - head} of the {size} bytes that it unpacks to')


def last_message(content: bytes | bytearray, position: int, end: int) -> int:
    """Return the offset of the last record in the records between two offsets."""
    last = position
    while position < end:
        last = position
        position += 9 + struct.unpack_from('<Q', content, position + 1)[0]
    return last
