# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file by their places: read where one is expected, found again after damage.

The library ``mcap`` reads their content. Records may be longer than known, and of unknown kinds; both are skipped.

Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from io import BytesIO
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped] # comes with mcap
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from zstandard import ZstdDecompressor, ZstdError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

MAGIC: Final = b'\x89MCAP0\r\n'  # first and last bytes of an MCAP file
MAX_CHUNK: Final = 64 << 20
"""Largest chunk that is unpacked unless a larger one is asked for [bytes]."""
HEAD: Final = struct.Struct('<BQ')  # opcode, length of the record
MESSAGE_BYTES: Final = 22
"""Size of the head of a message: channel, sequence, log time, publish time."""
UNREADABLE: Final = (McapError, struct.error, UnicodeDecodeError, OverflowError, KeyError)
"""Errors of the library on the content of a damaged record."""
_FOOTER: Final = struct.Struct('<BQQQI')  # with its head; start of summary, start of its offsets, checksum of both
_CHUNK: Final = struct.Struct('<QQQII')  # log times, unpacked size, checksum, length of the name of the compression
_SIZE: Final = struct.Struct('<Q')
_INDEX: Final = struct.Struct('<HI')  # channel, size of the entries, which have 16 bytes each
# Shortest content of each kind of record [bytes].
_MIN_BYTES: Final[dict[int, int]] = {
    Opcode.HEADER: 8, Opcode.FOOTER: 20, Opcode.SCHEMA: 14, Opcode.CHANNEL: 16, Opcode.MESSAGE: MESSAGE_BYTES,
    Opcode.CHUNK: 40, Opcode.MESSAGE_INDEX: 6, Opcode.CHUNK_INDEX: 64, Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48, Opcode.STATISTICS: 46, Opcode.METADATA: 8, Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4,
}  # fmt: skip
# Records that are looked for after damage: their content shows that they are whole. Others may lie outside chunks.
_TARGETS: Final = frozenset({Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.DATA_END, Opcode.FOOTER})
_UNCHUNKED_TARGETS: Final = _TARGETS | {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_SUMMARY: Final = frozenset(
    {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX}
    | {Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET}
)
_FOLLOWING: Final = 2  # records that must follow one whose place or kind is in doubt
_BLOCK: Final = 1 << 12  # bytes that are searched first; and by which a summary is looked for elsewhere
_MAX_BLOCK: Final = 1 << 20  # bytes that are read at once


class DamageError(Exception):
    """A piece of a file cannot be used; the text says why."""


class Record(NamedTuple):
    """One record: opcode, and where its content starts and ends."""

    opcode: int  # kind of the record
    start: int  # start of its content [bytes]
    end: int  # end of its content [bytes]

    @property
    def offset(self) -> int:
        """Where the record itself starts."""
        return self.start - HEAD.size


class ChunkHead(NamedTuple):
    """Head of a chunk."""

    size: int  # Size of its records [bytes]
    crc: int  # Checksum of its records, 0 without one
    compression: str  # '', 'lz4' or 'zstd'
    start: int  # Where the stored records start in the content of the chunk
    stored: int  # Their stored size [bytes]

    def unpack(self, stored: bytes) -> bytes:
        """Return the records, checked; DamageError if they cannot be unpacked, or size or checksum do not fit."""
        data = self.unpack_start(stored)
        if len(data) != self.size:
            raise DamageError(f'unpacks to {len(data)} instead of {self.size} bytes')
        if self.crc and zlib.crc32(data) != self.crc:
            raise DamageError('checksum does not fit')
        return data

    def unpack_start(self, stored: bytes) -> bytes:
        """Return the unpacked records, unchecked, at most one byte more than the head states; DamageError if none."""
        try:
            if self.compression == 'zstd':
                with ZstdDecompressor().stream_reader(BytesIO(stored)) as reader:
                    return reader.read(self.size + 1)
            if self.compression == 'lz4':
                return bytes(LZ4FrameDecompressor().decompress(stored, self.size + 1))
        except (ZstdError, RuntimeError) as error:  # lz4 raises the latter
            raise DamageError(f'cannot be unpacked ({" ".join(str(error).split())})') from None
        return stored


class RecordFile:
    """An MCAP file."""

    def __init__(self, path: Path) -> None:
        """Open a file; OSError if that fails."""
        self._file = path.open('rb')
        self.size = self._file.seek(0, os.SEEK_END)  # bytes
        # Whether it ends as a finished file does.
        self.is_closed = self.size > 2 * len(MAGIC) and self.read(self.size - len(MAGIC), len(MAGIC)) == MAGIC
        # Where its records end: that of a recording that was cut off may be allocated on disk but not written.
        self.end = self.size - len(MAGIC) if self.is_closed else self._end_of_zeros()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, offset: int, length: int) -> bytes:
        """Return the bytes from an offset on, fewer at the end of the file."""
        return os.pread(self._file.fileno(), length, offset)

    def record(self, offset: int) -> Record | None:
        """Return the record that starts at an offset, None if none that can be right does."""
        found = last = self._record(offset)
        # Of an unknown kind is only what known records follow: garbage looks alike.
        for _ in range(_FOLLOWING):
            if last is None or is_known(last.opcode) or last.end == self.end:
                break
            last = self._record(last.end)
        return None if last is None else found

    def _record(self, offset: int) -> Record | None:
        """Return the record that starts at an offset, judged by itself."""
        content = self.read(offset, HEAD.size)
        if len(content) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(content)
        found = Record(opcode, offset + HEAD.size, offset + HEAD.size + length)
        most = _MIN_BYTES[opcode] if opcode in {Opcode.FOOTER, Opcode.DATA_END} else length  # these never grow
        if found.end > self.end or not opcode or not _MIN_BYTES.get(opcode, 0) <= length <= most:
            return None
        if opcode == Opcode.CHUNK and self.chunk_head(found) is None:
            return None
        if opcode == Opcode.MESSAGE_INDEX:
            _, size = _INDEX.unpack(self.read(found.start, _INDEX.size))
            if size % 16 or _INDEX.size + size > length:
                return None
        return found

    def chunk_head(self, chunk: Record) -> ChunkHead | None:
        """Return the head of a chunk, None if it does not fit; the end of the stored records may be missing."""
        content = self.read(chunk.start, min(64, chunk.end - chunk.start))
        if len(content) < _CHUNK.size:
            return None
        _, _, size, crc, name_length = _CHUNK.unpack_from(content)
        end = _CHUNK.size + name_length
        name = content[_CHUNK.size : end].decode('ascii', errors='replace')
        if name not in {'', 'lz4', 'zstd'} or len(content) < end + _SIZE.size:
            return None
        (stored,) = _SIZE.unpack_from(content, end)
        start = end + _SIZE.size
        (length,) = _SIZE.unpack(self.read(chunk.start - _SIZE.size, _SIZE.size))
        return ChunkHead(size, crc, name, start, stored) if start + stored <= length else None

    def search(self, offset: int, *, chunked: bool) -> int:
        """Return the start of the first record from an offset on that others follow, the end if there is none.

        ``chunked`` is True if messages lie in chunks only: those of a damaged chunk are no records of the file.
        """
        block = _BLOCK
        while offset + HEAD.size <= self.end:
            content = np.frombuffer(self.read(offset, min(block, self.end - offset)), dtype=np.uint8)
            for place in _candidates(content).tolist():
                if self._begins_records(offset + place, _TARGETS if chunked else _UNCHUNKED_TARGETS):
                    return offset + int(place)
            offset += content.size - HEAD.size + 1
            block = min(2 * block, _MAX_BLOCK)
        return self.end

    def _begins_records(self, offset: int, targets: frozenset[int]) -> bool:
        """Return whether a record that is a target begins at an offset, and known ones follow it."""
        record = self._record(offset)
        if record is None or record.opcode not in targets:
            return False
        for _ in range(_FOLLOWING):
            if record.end == self.end:
                return True
            record = self._record(record.end)
            if record is None or not is_known(record.opcode):
                return False
        return True

    def summary(self) -> Summary:
        """Return the summary at the end of a finished file, as far as it can be read."""
        offset = self.end - _FOOTER.size
        opcode, _, position, _, crc = _FOOTER.unpack(self.read(offset, _FOOTER.size))
        if opcode != Opcode.FOOTER or not position:  # without a summary, none needs to be looked for
            return Summary()
        stated, is_whole = self._summary_from(position, crc)
        if is_whole:
            return stated
        # Bytes were lost or added before it: it lies elsewhere, and so do the chunks of its index. The end of it fits
        # without a checksum too, so what starts first is the whole.
        for start in range(max(position - _BLOCK, len(MAGIC)), min(position + _BLOCK, offset)):
            first = self._record(start)
            if first is None or first.opcode not in _SUMMARY:
                continue
            moved, is_whole = self._summary_from(start, crc)
            if is_whole:
                moved.chunk_indexes.clear()
                return moved
        return stated

    def _summary_from(self, start: int, crc: int) -> tuple[Summary, bool]:
        """Return the readable part of a summary that starts at an offset, and whether it is whole."""
        found = Summary()
        if not 0 < start < self.end or self.size - start > MAX_CHUNK:
            return found, False
        content = self.read(start, self.size - start)
        if crc and zlib.crc32(content[: -4 - len(MAGIC)]) != crc:
            return found, False
        try:
            for record in StreamReader(BytesIO(content), skip_magic=True, emit_chunks=True).records:
                match record:
                    case Schema():
                        found.schemas[record.id] = record
                    case Channel():
                        found.channels[record.id] = record
                    case ChunkIndex():
                        found.chunk_indexes.append(record)
                    case Statistics():
                        found.statistics = record
        except UNREADABLE:
            return found, False
        return found, True

    def crc(self, start: int, end: int) -> int:
        """Return the checksum of the bytes between two offsets."""
        crc = 0
        for offset in range(start, end, _MAX_BLOCK):
            crc = zlib.crc32(self.read(offset, min(_MAX_BLOCK, end - offset)), crc)
        return crc

    def _end_of_zeros(self) -> int:
        """Return where the zeros at the end of the file start."""
        end = self.size
        while end:
            start = max(0, end - _MAX_BLOCK)
            if content := self.read(start, end - start).rstrip(b'\0'):
                return start + len(content)
            end = start
        return 0


def is_known(opcode: int) -> bool:
    """Return whether the kind of a record is one of the specification, or is kept for others."""
    return opcode in _MIN_BYTES or opcode >= 0x80


def _candidates(content: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return the places of bytes that could be the opcode of a record shorter than a terabyte."""
    count = max(0, content.size - HEAD.size + 1)
    opcode = content[:count]
    fits = (opcode >= Opcode.FOOTER) & (opcode <= Opcode.DATA_END)
    for place in range(6, HEAD.size):
        fits &= content[place : place + count] == 0
    return np.flatnonzero(fits)
