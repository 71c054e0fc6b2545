# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file by their places: read where one is expected, found again after damage.

Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from trainid_ros.bag.chunk import MAX_HEAD, read_head

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

MAGIC: Final = b'\x89MCAP0\r\n'
HEAD: Final = struct.Struct('<BQ')  # opcode, length of the record
MESSAGE_BYTES: Final = 22
"""Size of the head of a message: channel, sequence, log time, publish time."""
_FOOTER: Final = struct.Struct('<BQQQI')  # with its head; start of summary, start of its offsets, checksum of both
_CRC: Final = struct.Struct('<I')
_PRIVATE: Final = 0x80  # opcodes from here on are for records of others
_SHORTEST: Final[dict[int, int]] = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: MESSAGE_BYTES,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 52,
    Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48,
    Opcode.STATISTICS: 46,
    Opcode.METADATA: 8,
    Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17,
    Opcode.DATA_END: 4,
}
_SIZES: Final[dict[int, int]] = {Opcode.FOOTER: 20, Opcode.DATA_END: 4}  # of those that always have the same
_INDEX: Final = struct.Struct('<HI')  # channel, size of what follows
# What damage may be followed by: records whose content shows that they are whole, and what may lie outside chunks.
_TARGETS: Final = frozenset({Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.DATA_END, Opcode.FOOTER})
_UNCHUNKED_TARGETS: Final = _TARGETS | {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_FOLLOWING: Final = 2
_FIRST_BLOCK: Final = 1 << 12
_MOST_BLOCK: Final = 1 << 20
_MOST_SUMMARY: Final = 1 << 26
# Most bytes by which a summary is looked for elsewhere.
_MOST_SHIFT: Final = 4096


class Record(NamedTuple):
    """One record: opcode, and where its content starts and ends."""

    opcode: int
    start: int
    end: int

    @property
    def offset(self) -> int:
        """Where the record itself starts."""
        return self.start - HEAD.size


class RecordFile:
    """An MCAP file.

    Attributes:
        size: Its size [bytes].
        is_closed: True if it ends as a finished file does.
        end: Where its records end.
    """

    def __init__(self, path: Path) -> None:
        """Open a file; OSError if that fails."""
        self._file = path.open('rb')
        self.size = self._file.seek(0, os.SEEK_END)
        self.is_closed = self.size > 2 * len(MAGIC) and self.read(self.size - len(MAGIC), len(MAGIC)) == MAGIC
        # Where a recording was cut off, the end may be allocated on disk but not written.
        self.end = self.size - len(MAGIC) if self.is_closed else self._end_of_zeros()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, offset: int, length: int) -> bytes:
        """Return the bytes from an offset on, fewer at the end of the file."""
        return os.pread(self._file.fileno(), length, offset)

    def record(self, offset: int) -> Record | None:
        """Return the record that starts at an offset, None if none that can be right does."""
        content = self.read(offset, HEAD.size)
        if len(content) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(content)
        found = Record(opcode, offset + HEAD.size, offset + HEAD.size + length)
        if found.end > self.end or not (opcode >= _PRIVATE or _fits(opcode, length)):
            return None
        if opcode == Opcode.CHUNK and read_head(self.read(found.start, min(MAX_HEAD, length)), length) is None:
            return None
        if opcode == Opcode.MESSAGE_INDEX and _INDEX.unpack(self.read(found.start, _INDEX.size))[1] != length - 6:
            return None
        return found

    def search(self, offset: int, *, chunked: bool) -> int:
        """Return the start of the first record from an offset on that others follow, the end if there is none.

        Args:
            offset: Where to start.
            chunked: True if messages lie in chunks only: those of a damaged chunk are no records of the file.
        """
        block = _FIRST_BLOCK
        while offset + HEAD.size <= self.end:
            content = np.frombuffer(self.read(offset, min(block, self.end - offset)), dtype=np.uint8)
            for place in _candidates(content).tolist():
                if self._begins_records(offset + place, _TARGETS if chunked else _UNCHUNKED_TARGETS):
                    return offset + int(place)
            offset += content.size - HEAD.size + 1
            block = min(2 * block, _MOST_BLOCK)
        return self.end

    def _begins_records(self, offset: int, targets: frozenset[int]) -> bool:
        """Return whether a record that is a target begins at an offset, and others follow it."""
        record = self.record(offset)
        if record is None or record.opcode not in targets:
            return False
        for _ in range(_FOLLOWING):
            if record.end == self.end:
                return True
            record = self.record(record.end)
            if record is None:
                return False
        return True

    def summary(self) -> list[tuple[int, bytes]]:
        """Return opcode and content of the records of the summary at the end of a finished file, as far as it goes."""
        offset = self.end - _FOOTER.size
        opcode, _, position, _, crc = _FOOTER.unpack(self.read(offset, _FOOTER.size))
        if opcode != Opcode.FOOTER or not position:  # without a summary, none needs to be looked for
            return []
        if found := self._summary_from(position, offset, crc):
            return found
        # Bytes were lost or added before it: it lies elsewhere, and so do the chunks of its index. The end of it fits
        # without a checksum too, so what starts first is the whole.
        for start in range(position - _MOST_SHIFT, position + _MOST_SHIFT):
            if found := self._summary_from(start, offset, crc):
                return [(kind, content) for kind, content in found if kind != Opcode.CHUNK_INDEX]
        return [] if crc else self._contents(position, offset)[0]

    def _summary_from(self, start: int, end: int, crc: int) -> list[tuple[int, bytes]]:
        """Return opcode and content of the records between two offsets; none if they or their checksum do not fit."""
        if not 0 < start < end or self.record(start) is None:
            return []
        if crc and end - start <= _MOST_SUMMARY and self.crc(start, self.end - _CRC.size) != crc:
            return []
        found, reached = self._contents(start, end)
        return found if reached == end else []

    def _contents(self, start: int, end: int) -> tuple[list[tuple[int, bytes]], int]:
        """Return opcode and content of the records from an offset on, and where the last one ends."""
        found: list[tuple[int, bytes]] = []
        if not 0 < start < end or end - start > _MOST_SUMMARY:
            return found, start
        while start < end and (record := self.record(start)) is not None:
            found.append((record.opcode, self.read(record.start, record.end - record.start)))
            start = record.end
        return found, start

    def crc_fits(self, data_end: Record) -> bool:
        """Return whether the bytes before a record have the checksum that it states, if it states one."""
        (stated,) = _CRC.unpack(self.read(data_end.start, _CRC.size))
        return not stated or self.crc(0, data_end.offset) == stated

    def crc(self, start: int, end: int) -> int:
        """Return the checksum of the bytes between two offsets."""
        crc = 0
        for offset in range(start, end, _MOST_BLOCK):
            crc = zlib.crc32(self.read(offset, min(_MOST_BLOCK, end - offset)), crc)
        return crc

    def _end_of_zeros(self) -> int:
        """Return where the zeros at the end of the file start."""
        end = self.size
        while end:
            start = max(0, end - _MOST_BLOCK)
            if content := self.read(start, end - start).rstrip(b'\0'):
                return start + len(content)
            end = start
        return 0


def values_at(data: bytes | NDArray[np.uint8], at: NDArray[np.intp], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the values that start at each place of a block of bytes, shape (n,)."""
    if not at.size:
        return np.empty(0, dtype=kind)
    everywhere: NDArray[Any] = np.ndarray((len(data) - kind.itemsize + 1,), kind, data, strides=(1,))
    return everywhere[at]


def _fits(opcode: int, length: int) -> bool:
    """Return whether a record of this kind may have this length."""
    return opcode in _SHORTEST and length >= _SHORTEST[opcode] and length == _SIZES.get(opcode, length)


def _candidates(content: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return the places of bytes that could be the opcode of a record shorter than a terabyte."""
    count = max(0, content.size - HEAD.size + 1)
    opcode = content[:count]
    fits = (opcode >= Opcode.FOOTER) & (opcode <= Opcode.DATA_END)
    for place in range(6, HEAD.size):
        fits &= content[place : place + count] == 0
    return np.flatnonzero(fits)
