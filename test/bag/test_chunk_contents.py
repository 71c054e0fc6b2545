# SPDX-License-Identifier: Apache-2.0
"""Bags with large messages of other topics: only what is needed is read, and the same comes out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from trainid_ros.bag import mcap_file, record_file
from trainid_ros.bag.reader import BagReader

if TYPE_CHECKING:
    from trainid_ros.interface.records import Row

IMAGE = bytes(300_000)
IMAGES = 40
TINY = Path(__file__).parents[2] / 'bags' / 'tiny'


def write(tiny: Path, path: Path, compression: CompressionType, *, image: bytes = IMAGE, apart: bool = False) -> Path:
    """Write the messages of the tiny bag with images between them, or with all images at the end."""
    source = next(tiny.glob('*.mcap'))
    with source.open('rb') as file, path.open('wb') as out:
        reader, writer = make_reader(file), Writer(out, chunk_size=768 * 1024, compression=compression)
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
    content = bytearray(path.read_bytes())
    content[content.index(marked) + 1000] ^= 1
    path.write_bytes(content)
    assert rows(path)[:2] == (expected, [])
    # Indexes that claim messages of another channel: the whole chunks are read instead.
    path = write(TINY, tmp_path / 'b.mcap', CompressionType.NONE, image=marked)
    content = bytearray(path.read_bytes())
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        for offset in chunk.message_index_offsets.values():
            content[offset + 9] ^= 3
    path.write_bytes(content)
    assert rows(path)[0] == expected
