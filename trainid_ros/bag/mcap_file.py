# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, read without trust in its index.

The file is scanned once when it is opened: every chunk is unpacked and checked, so damage is known
before the first message is handed out and counts are exact. What stays in memory is where each message
starts in its chunk; the chunks are read again, one by one, when they are asked for.

Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple, NoReturn

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream
from zstandard import ZstdError

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

MAGIC: Final = b'\x89MCAP0\r\n'
_HEAD: Final = struct.Struct('<BQ')  # opcode, length of the record
# Channel, sequence, log time and publish time of a message.
_MESSAGE: Final = np.dtype([('channel', '<u2'), ('sequence', '<u4'), ('log_ns', '<u8'), ('publish_ns', '<u8')])
_LENGTH: Final = np.dtype('<i8')
_RUN_BYTES: Final = 1 << 20  # messages outside chunks are taken together up to this size
_DEFINITIONS: Final = (Opcode.SCHEMA, Opcode.CHANNEL)
_PLAIN: Final = (*_DEFINITIONS, Opcode.MESSAGE)
_DAMAGE: Final = (
    McapError,
    CRCValidationError,
    ZstdError,
    RuntimeError,  # lz4
    MemoryError,  # an absurd size
    OverflowError,
    struct.error,
    UnicodeDecodeError,
)


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """The messages of one segment, in the order of the file.

    Attributes:
        data: The bytes they lie in, shape (m,).
        start: Where their payloads start in ``data``, shape (n,).
        end: Where they end, shape (n,).
        channel: Numbers of their channels, shape (n,).
        log_ns: Log times, shape (n,).

    """

    data: NDArray[np.uint8]
    start: NDArray[np.intp]
    end: NDArray[np.intp]
    channel: NDArray[np.uint16]
    log_ns: NDArray[np.uint64]


class _Head(NamedTuple):
    """Opcode, start and end of one record."""

    opcode: int
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Segment:
    """A chunk, or a run of messages outside chunks: its place in the file, its log times, and where messages start."""

    offset: int
    length: int
    is_chunk: bool
    first_ns: int
    last_ns: int
    starts: NDArray[np.uint32]


class McapFile:
    """The messages of one MCAP file, also of a file whose recording was cut off.

    Attributes:
        path: The file.
        channels: Channels by number.
        schemas: Message definitions by number.
        counts: Number of messages by channel number.
        segments: Pieces of the file that hold messages, in file order.
        warnings: What is wrong with the file although it can be read.

    """

    def __init__(self, path: Path) -> None:
        """Open and scan a file.

        Raises:
            InputError: If it is not MCAP, is empty, is corrupt, or nothing of it can be recovered.

        """
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.counts: Counter[int] = Counter()
        self.segments: list[Segment] = []
        self.warnings: list[str] = []
        try:
            self._file = path.open('rb')
        except OSError as error:
            msg = f'{path}: cannot be opened ({error.strerror})'
            raise InputError(msg) from None
        try:
            self._scan()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, segment: Segment) -> MessageBlock:
        """Return the messages of one segment."""
        data = self._load(segment.offset, segment.length, is_chunk=segment.is_chunk)
        return _block(data, segment.starts.astype(np.intp))

    def _scan(self) -> None:
        size = self._file.seek(0, 2)
        if size == 0:
            self._fail('is empty')
        self._file.seek(0)
        if (start := self._file.read(len(MAGIC))) != MAGIC:
            sqlite = start == b'SQLite f'
            self._fail('is an SQLite file, only mcap is supported' if sqlite else 'is not an MCAP file')
        if size == len(MAGIC):
            self._fail('holds no records, only the MCAP signature')
        self._file.seek(-len(MAGIC), 2)
        closed = size > 2 * len(MAGIC) and self._file.read(len(MAGIC)) == MAGIC
        end, finished = self._scan_records(size, closed=closed)
        if closed and not finished:
            self._fail(f'is corrupt: no valid record at byte {end}')
        if not closed:
            self._report_truncation(size - end, finished=finished)

    def _report_truncation(self, lost: int, *, finished: bool) -> None:
        if finished:
            self.warnings.append(f'{self.path}: the index at the end is damaged, all messages were read')
            return
        if not self.segments:
            self._fail('was cut off before the first complete chunk, nothing can be recovered')
        self.warnings.append(
            f'{self.path}: the recording was cut off: {sum(self.counts.values())} messages up to the last '
            f'complete chunk were recovered, the last {lost} bytes are lost'
        )

    def _scan_records(self, size: int, *, closed: bool) -> tuple[int, bool]:
        """Take in the data section; return where it stopped and whether that was its proper end."""
        reached = len(MAGIC)
        for opcode, start, end in self._pieces(size):
            if opcode == Opcode.DATA_END:
                return end, True
            try:
                if opcode in {Opcode.CHUNK, Opcode.MESSAGE}:
                    self._add(start, end, is_chunk=opcode == Opcode.CHUNK)
            except InputError:
                # Where a recording was cut off, the last chunk may be allocated on disk but not written.
                if closed:
                    raise
                break
            reached = end
        return reached, False

    def _pieces(self, size: int) -> Iterator[_Head]:
        """Yield the records of the file with their heads; schemas, channels and messages in a row as one message."""
        position = run = len(MAGIC)
        while position + _HEAD.size <= size:
            self._file.seek(position)
            opcode, length = _HEAD.unpack(self._file.read(_HEAD.size))
            after = position + _HEAD.size + length
            if opcode == 0 or after > size:
                break
            plain = opcode in _PLAIN
            if run < position and (not plain or after - run > _RUN_BYTES):
                yield _Head(Opcode.MESSAGE, run, position)
                run = position
            if not plain:
                yield _Head(opcode, position, after)
                run = after
            position = after
        if run < position:
            yield _Head(Opcode.MESSAGE, run, position)

    def _add(self, start: int, end: int, *, is_chunk: bool) -> None:
        """Read the records between two offsets; note the channels and, if there are messages, the segment."""
        data = self._load(start, end - start, is_chunk=is_chunk)
        starts, definitions = self._walk(data, start)
        for head in definitions:
            self._define(head.opcode, data[head.start : head.end], start)
        if not starts.size:
            return
        block = _block(data, starts)
        counts = {channel: count for channel, count in enumerate(np.bincount(block.channel).tolist()) if count}
        if unknown := [channel for channel in counts if channel not in self.channels]:
            self._fail(f'is corrupt: message on unknown channel {unknown[0]} near byte {start}')
        self.counts.update(counts)
        first, last = int(block.log_ns.min()), int(block.log_ns.max())
        self.segments.append(Segment(start, end - start, is_chunk, first, last, starts.astype(np.uint32)))

    def _define(self, opcode: int, content: bytes, offset: int) -> None:
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
            else:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
        except _DAMAGE:
            self._fail(f'is corrupt: unreadable channel or schema near byte {offset}')

    def _load(self, offset: int, length: int, *, is_chunk: bool) -> bytes:
        """Return the records stored in a piece of the file, unpacked and checked."""
        if not is_chunk:
            return _read(self._file, offset, length)
        content = _read(self._file, offset + _HEAD.size, length - _HEAD.size)
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(content)))
            stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        except _DAMAGE as error:
            self._fail(f'is corrupt: chunk at byte {offset}: {" ".join(str(error).split()) or "unreadable"}')
        if size != chunk.uncompressed_size:
            self._fail(f'is corrupt: chunk at byte {offset}: {size} of {chunk.uncompressed_size} bytes')
        return stream.read(size)

    def _walk(self, data: bytes, offset: int) -> tuple[NDArray[np.intp], list[_Head]]:
        """Return where messages start, and the schemas and channels, in a block of bytes read at ``offset``."""
        starts: list[int] = []
        definitions: list[_Head] = []
        unpack, message = _HEAD.unpack_from, int(Opcode.MESSAGE)
        position, size = 0, len(data)
        while position + _HEAD.size <= size:
            opcode, length = unpack(data, position)
            start = position + _HEAD.size
            position = start + length
            if opcode == message:
                starts.append(start)
            elif opcode in _DEFINITIONS:
                definitions.append(_Head(opcode, start, position))
        places = np.array(starts, dtype=np.intp)
        if position != size or bool(np.any(_lengths(data, places) < _MESSAGE.itemsize)):
            self._fail(f'is corrupt: broken record near byte {offset}')
        return places, definitions

    def _fail(self, what: str) -> NoReturn:
        msg = f'{self.path}: {what}'
        raise InputError(msg)


def _block(data: bytes, starts: NDArray[np.intp]) -> MessageBlock:
    """Return the messages whose records, without opcode and length, start at these places."""
    heads = _values(data, starts, _MESSAGE)
    ends = starts + _lengths(data, starts)
    content = np.frombuffer(data, dtype=np.uint8)
    return MessageBlock(content, starts + _MESSAGE.itemsize, ends, heads['channel'], heads['log_ns'])


def _lengths(data: bytes, starts: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the lengths of records, which stand before their starts."""
    return _values(data, starts - _LENGTH.itemsize, _LENGTH)


def _values(data: bytes, at: NDArray[np.intp], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the values that start at each place, shape (n,)."""
    rows = np.frombuffer(data, dtype=np.uint8)[at[:, None] + np.arange(kind.itemsize)]
    return np.asarray(rows.view(kind)[:, 0])


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)
