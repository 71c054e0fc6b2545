# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, read without trust in its contents.

The file is scanned once when it is opened: damage is known before the first message is handed out. Damaged pieces are
left out, and each is named. A chunk is unpacked and checked, unless the index of the file says that few of its bytes
are of needed topics, as beside cameras, and agrees with the records it points to: then only those are read, and
a checksum of the whole chunk cannot be checked. What stays in memory is where each message starts; the chunks are
read again, one by one, when they are asked for.

The library ``mcap`` reads the content of records. They may be longer than known, and of unknown kinds; both are
skipped. Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

import numpy as np
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped] # comes with mcap
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from numpy.typing import NDArray
from zstandard import ZstdDecompressor, ZstdError

from trainid_ros.bag.types import MessageBlock, Segment, values_at
from trainid_ros.interface.errors import InputError

MAGIC: Final = b'\x89MCAP0\r\n'  # first and last bytes of an MCAP file
MAX_CHUNK: Final = 64 << 20
"""Largest chunk that is unpacked unless a larger one is asked for [bytes]."""
HEAD: Final = struct.Struct('<BQ')  # opcode, length of the record
# Channel, sequence, log time and publish time of a message; its length stands before them.
_MESSAGE: Final = np.dtype([('channel', '<u2'), ('sequence', '<u4'), ('log_ns', '<u8'), ('publish_ns', '<u8')])
# With their heads: message up to its log time; channel of an index and size of its entries, which have 16 bytes each;
# footer, with start of the summary, start of its offsets, checksum of both.
_START: Final = struct.Struct('<BQHIQ')
_INDEX: Final = struct.Struct('<BQHI')
_FOOTER: Final = struct.Struct('<BQQQI')
# Shortest content of each kind of record [bytes].
_MIN_BYTES: Final[dict[int, int]] = {
    Opcode.HEADER: 8, Opcode.FOOTER: 20, Opcode.SCHEMA: 14, Opcode.CHANNEL: 16, Opcode.MESSAGE: _MESSAGE.itemsize,
    Opcode.CHUNK: 40, Opcode.MESSAGE_INDEX: 6, Opcode.CHUNK_INDEX: 64, Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48, Opcode.STATISTICS: 46, Opcode.METADATA: 8, Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4,
}  # fmt: skip
_DEFINITIONS: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL})
_PLAIN: Final = _DEFINITIONS | {Opcode.MESSAGE}
# Records that are looked for after damage: their content shows that they are whole. Others may lie outside chunks.
_TARGETS: Final = frozenset({Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.DATA_END, Opcode.FOOTER})
_SUMMARY: Final = _DEFINITIONS | {
    Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET,
}  # fmt: skip
_FOLLOWING: Final = 2  # records that must follow one whose place or kind is in doubt
_BLOCK: Final = 1 << 12  # bytes that are read or searched first; and by which a summary is looked for elsewhere
# Bytes that are read at once, from one report of progress to the next, and of messages outside chunks taken together.
_MB: Final = 1 << 20
_MAX_NAMED: Final = 5  # losses
# Share of a chunk that needed messages may have [1]: of one with more, all is read, and its checksum is checked.
_SPARSE: Final = 0.1
# Errors of the library on the content of a damaged record.
_UNREADABLE: Final = (McapError, struct.error, UnicodeDecodeError, OverflowError, KeyError)
# Other formats by their first bytes.
_HINTS: Final = {
    b'\x28\xb5\x2f\xfd': ': it is compressed by zstd, as ros2 bag does in mode file; unpack it with zstd -d',
    b'\x1f\x8b': ': it is compressed by gzip; unpack it with gunzip',
    b'#ROSBAG V': ': it is a ROS 1 bag; convert it with rosbags-convert',
    b'version https://git-lfs': ': it is a pointer of Git LFS; get the file with git lfs pull',
}


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
            if last is None or _is_known(last.opcode) or last.end == self.end:
                break
            last = self._record(last.end)
        return None if last is None else found

    def _record(self, offset: int) -> Record | None:
        """Return the record that starts at an offset, judged by itself."""
        content = self.read(offset, _INDEX.size)
        if len(content) < HEAD.size:
            return None
        opcode, length = HEAD.unpack_from(content)
        found = Record(opcode, offset + HEAD.size, offset + HEAD.size + length)
        most = _MIN_BYTES[opcode] if opcode in {Opcode.FOOTER, Opcode.DATA_END} else length  # these never grow
        if found.end > self.end or not opcode or not _MIN_BYTES.get(opcode, 0) <= length <= most:
            return None
        if opcode == Opcode.CHUNK and self.chunk_head(found) is None:
            return None
        if opcode == Opcode.MESSAGE_INDEX:
            *_, size = _INDEX.unpack(content)
            if size % 16 or _INDEX.size + size > found.end - offset:
                return None
        return found

    def chunk_head(self, chunk: Record) -> ChunkHead | None:
        """Return the head of a chunk, None if it does not fit; the end of the stored records may be missing."""
        stream = ReadDataStream(BytesIO(self.read(chunk.start, min(64, chunk.end - chunk.start))))
        try:
            stream.read(16)  # log times
            size, crc, name = stream.read8(), stream.read4(), stream.read_prefixed_string()
            stored = stream.read8()
        except _UNREADABLE:
            return None
        length = int.from_bytes(self.read(chunk.start - 8, 8), 'little')
        fits = name in {'', 'lz4', 'zstd'} and stream.count + stored <= length
        return ChunkHead(size, crc, name, stream.count, stored) if fits else None

    def search(self, offset: int, *, chunked: bool) -> int:
        """Return the start of the first record from an offset on that others follow, the end if there is none.

        ``chunked`` is True if messages lie in chunks only: those of a damaged chunk are no records of the file.
        """
        block = _BLOCK
        while offset + HEAD.size <= self.end:
            content = np.frombuffer(self.read(offset, min(block, self.end - offset)), dtype=np.uint8)
            for place in _candidates(content).tolist():
                if self._begins_records(offset + place, _TARGETS if chunked else _TARGETS | _PLAIN):
                    return offset + int(place)
            offset += content.size - HEAD.size + 1
            block = min(2 * block, _MB)
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
            if record is None or not _is_known(record.opcode):
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
        if start >= self.end or self.size - start > MAX_CHUNK:
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
        except _UNREADABLE:
            return found, False
        return found, True

    def crc(self, start: int, end: int) -> int:
        """Return the checksum of the bytes between two offsets."""
        crc = 0
        for offset in range(start, end, _MB):
            crc = zlib.crc32(self.read(offset, min(_MB, end - offset)), crc)
        return crc

    def _end_of_zeros(self) -> int:
        """Return where the zeros at the end of the file start."""
        end = self.size
        while end:
            start = max(0, end - _MB)
            if content := self.read(start, end - start).rstrip(b'\0'):
                return start + len(content)
            end = start
        return 0


class Piece(NamedTuple):
    """A piece of the file: a chunk, one whose end is missing, or records outside chunks."""

    offset: int  # where it starts in the file [bytes]
    end: int  # where it ends in the file [bytes]
    is_chunk: bool  # or records outside chunks
    is_cut: bool = False  # its end is missing


class McapFile:
    """The messages of one MCAP file, also of a damaged one and of one whose recording was cut off."""

    def __init__(
        self,
        path: Path,
        max_chunk: int = MAX_CHUNK,
        is_needed: Callable[[str], bool] = lambda _: True,
        advance: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Open and scan a file; InputError if it is not MCAP, is empty, or nothing of it can be used.

        Chunks that unpack to more than ``max_chunk`` [bytes], and larger messages outside chunks, are left out, and
        messages of topics that are not needed may be. ``advance`` is called with the number of bytes scanned since.
        """
        self.path = path
        self.channels: dict[int, Channel] = {}  # by number
        self.schemas: dict[int, Schema] = {}  # message definitions by number
        self.counts: Counter[int] = Counter()  # messages by number of the channel
        self.segments: list[Segment] = []  # with messages of needed topics, in file order
        self.first_ns = self.last_ns = 0  # first and last log time [ns], 0 without messages
        self.promised: int | None = None  # number of messages that the file states
        self.warnings: list[str] = []  # what is wrong with the file although it can be read
        # Repeats the definitions, in case that those before the messages are lost.
        self._summary = Summary()
        self._indexes: dict[int, ChunkIndex] = {}
        self._is_needed = is_needed
        self._advance, self._reported = advance, 0
        self._max_chunk = max_chunk
        self._unpacked = 0
        self._all_checked, self._chunked, self._ends_cut = True, False, False
        self._losses: list[str] = []
        self._lost_bytes = 0
        try:
            self._file = RecordFile(path)
        except OSError as error:
            raise InputError(f'{path}: cannot be opened ({error.strerror})') from None
        try:
            self._scan()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, piece: Piece, starts: NDArray[np.uint32], runs: tuple[tuple[int, int], ...] = ()) -> MessageBlock:
        """Return the messages of a segment; InputError if the file has changed since it was opened.

        ``starts`` is where their records start, without opcode and length, in what is read: all of the piece, or
        ``runs`` of the file by offset and length.
        """
        try:
            data = b''.join(self._file.read(*run) for run in runs) if runs else self._load(piece)
            return _messages_at(data, starts.astype(np.intp))
        except (DamageError, IndexError):
            self._fail('has changed while it was read')

    def _scan(self) -> None:
        file = self._file
        if file.size == 0:
            self._fail('is empty')
        start = file.read(0, _BLOCK)
        if not start.startswith(MAGIC) and not file.is_closed:
            self._fail(f'is not an MCAP file{hint_of(start)}')
        if file.size == len(MAGIC):
            self._fail('holds no records, only the MCAP signature')
        if file.is_closed:
            self._summary = file.summary()
            self._indexes = {index.chunk_start_offset: index for index in self._summary.chunk_indexes}
            if (statistics := self._summary.statistics) is not None:
                self.promised = statistics.message_count
        reached, last = self._scan_records()
        if file.is_closed and self._losses and not self.counts:
            self._fail(f'nothing of it can be used: {self._losses[0]}')
        self.warnings += [f'{self.path}: {loss}' for loss in self._losses[:_MAX_NAMED]]
        if (more := len(self._losses) - _MAX_NAMED) > 0:
            self.warnings.append(f'{self.path}: {more} more losses, of {self._lost_bytes} bytes with those named')
        if not file.is_closed and last is not None:
            self.warnings.append(f'{self.path}: the index at the end is damaged, all messages before it were read')
        elif not file.is_closed:
            if not self.segments:
                self._fail('was cut off before the first complete message, nothing can be recovered')
            self.warnings.append(
                f'{self.path}: the recording was cut off: {sum(self.counts.values())} messages were recovered, '
                f'the last {file.size - reached} bytes {"are incomplete" if self._ends_cut else "are lost"}'
            )
        elif not (self._all_checked or self._losses or last is None) and (
            (stated := int.from_bytes(file.read(last.start, 4), 'little')) and file.crc(0, last.offset) != stated
        ):
            self.warnings.append(f'{self.path}: checksum of the file does not fit, some messages may be wrong')

    def _lose(self, start: int, end: int, why: str) -> None:
        self._losses.append(f'{end - start} bytes from byte {start} on are lost: {why}')
        self._lost_bytes += end - start

    def _scan_records(self) -> tuple[int, Record | None]:
        """Take in the data section; return where the last record used ends, and the end of data if there is one."""
        file, position, run = self._file, len(MAGIC), len(MAGIC)
        while True:
            if position >= self._reported + _MB:
                self._advance(position - self._reported)
                self._reported = position
            record = file.record(position) if position < file.end else None
            plain = record is not None and record.opcode in _PLAIN
            if run < position and (record is None or not plain or record.end - run > _MB):
                self._take(Piece(run, position, is_chunk=False))
                run = position
            if record is None:
                is_chunk = file.read(position, 1) == bytes([Opcode.CHUNK])
                self._chunked |= is_chunk
                found = file.search(position + 1, chunked=self._chunked)
                if position >= file.end or (found == file.end and not file.is_closed):
                    if is_chunk and position + HEAD.size < file.end:  # its end is missing
                        self._take(Piece(position, file.end, is_chunk=True, is_cut=True))
                    return position, None
                self._lose(position, found, 'no valid record')
                position = run = found
            elif record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return record.end, record if record.opcode == Opcode.DATA_END else None
            elif plain:
                position = self._follow(record, record.offset + 1)
                if position < record.end:  # the record is lost
                    self._take(Piece(run, record.offset, is_chunk=False))
                    run = position
            else:
                position = run = self._take_record(record)

    def _take_record(self, record: Record) -> int:
        """Take in a record that is neither a message nor a definition; return where the next one starts."""
        if record.opcode != Opcode.CHUNK or (head := self._file.chunk_head(record)) is None:
            self._all_checked &= _is_known(record.opcode)  # it may be a known one whose opcode is damaged
            return self._follow(record, record.offset + 1)
        self._chunked = True
        if end := self._take_indexed(record, record.start + head.start):
            return end
        self._take(Piece(record.offset, record.end, is_chunk=True))
        return self._follow(record, record.start + head.start + head.stored)

    def _take_indexed(self, chunk: Record, begin: int) -> int:
        """Take in a chunk, whose records begin at an offset, by the index of the file: only needed messages are read.

        Return where its index ends; 0 if it does not fit what it points to, or if all of the chunk should be read.
        """
        index = self._indexes.get(chunk.offset)
        if index is None or index.chunk_length != chunk.end - chunk.offset or not index.message_index_offsets:
            return 0
        length = index.message_index_length
        block = self._file.read(chunk.end, length) if length < 16 * _MB else b''
        counts, needed = {}, []
        for channel, offset in index.message_index_offsets.items():
            entries = _entries(block, offset - chunk.end, channel)
            if not len(entries):
                return 0
            counts[channel] = len(entries)
            known = self._summary.channels.get(channel)
            if known is None or self._is_needed(known.topic):
                needed.append((channel, entries))
        most = 0.0 if index.compression else _SPARSE * (chunk.end - chunk.start) / (HEAD.size + _MESSAGE.itemsize)
        if sum(len(entries) for _, entries in needed) > most:
            return 0
        wanted = sorted((place, log_ns, channel) for channel, entries in needed for log_ns, place in entries.tolist())
        found = self._locate(chunk, begin, wanted)
        if found is None or self._file.record(chunk.end + length) is None:
            return 0
        for number in counts:
            self._use_summary(number)
        self.counts.update(counts)
        first_ns, last_ns = index.message_start_time, index.message_end_time
        self._span(first_ns, last_ns)
        if found[0]:
            runs, starts = found
            piece = Piece(chunk.offset, chunk.end, is_chunk=True)
            read = partial(self._read, piece, np.array(starts, dtype=np.uint32), tuple(runs))
            self.segments.append(Segment(first_ns, last_ns, read))
        return chunk.end + length

    def _locate(
        self, chunk: Record, begin: int, entries: list[tuple[int, int, int]]
    ) -> tuple[list[tuple[int, int]], list[int]] | None:
        """Return where the messages of a chunk are by their entries: place in the chunk, log time, channel.

        Return offset in the file and length of each run of their records, in the order of the file, and where their
        contents start if the runs are joined; None if they are not there, or are much of the chunk.
        """
        total, block, place_of = 0, b'', 0
        runs: list[tuple[int, int]] = []
        starts: list[int] = []
        for place, log_ns, channel in entries:
            if not place_of <= place <= place_of + len(block) - _START.size:
                block, place_of = self._file.read(begin + place, _BLOCK), place
            if len(block) < _START.size:
                return None
            opcode, size, found_channel, _, found_ns = _START.unpack_from(block, place - place_of)
            fits = (opcode, found_channel, found_ns) == (Opcode.MESSAGE, channel, log_ns) and size >= _MESSAGE.itemsize
            offset, length = begin + place, HEAD.size + size
            starts.append(total + HEAD.size)
            total += length
            if not fits or total > _SPARSE * (chunk.end - chunk.start) or offset + length > chunk.end:
                return None
            if runs and sum(runs[-1]) == offset:
                runs[-1] = (runs[-1][0], runs[-1][1] + length)
            else:
                runs.append((offset, length))
        return runs, starts

    def _span(self, first_ns: int, last_ns: int) -> None:
        self.first_ns = min(self.first_ns, first_ns) if self.last_ns else first_ns
        self.last_ns = max(self.last_ns, last_ns)

    def _follow(self, record: Record, begin: int) -> int:
        """Return where a record ends; if none follows there but one begins before, where that one starts."""
        if record.end >= self._file.end or self._file.record(record.end) is not None:
            return record.end
        found = self._file.search(begin, chunked=self._chunked)
        if found >= record.end:
            return record.end
        self._lose(record.offset, found, 'a record of a wrong length')
        return found

    def _take(self, piece: Piece) -> None:
        """Note the definitions and the messages of a piece of the file, or why it is lost."""
        try:
            data = self._load(piece, is_new=True)
        except DamageError as error:
            if not piece.is_cut:
                self._lose(piece.offset, piece.end, str(error))
            return
        starts, end = self._walk(data)
        if end < len(data) and not piece.is_cut:
            self._lose(piece.offset, piece.end, f'all after {end} of the {len(data)} bytes that it unpacks to')
        if starts.size:
            self._add(piece, data, starts)

    def _walk(self, data: bytes) -> tuple[NDArray[np.intp], int]:
        """Note the definitions in a block of bytes; return where messages start, and where the last record ends."""
        starts = array('Q')
        unpack_head, message = HEAD.unpack_from, int(Opcode.MESSAGE)
        position, size = 0, len(data)
        while position + HEAD.size <= size:
            opcode, length = unpack_head(data, position)
            start = position + HEAD.size
            if start + length > size or not opcode:
                break
            position = start + length
            if opcode == message:
                starts.append(start)
            elif opcode in _DEFINITIONS:
                self._define(opcode, data[start:position])
        return np.asarray(starts, dtype=np.intp), position

    def _define(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
            else:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
        except _UNREADABLE:
            self._losses.append('an unreadable message definition')

    def _use_summary(self, number: int) -> bool:
        """Take the definition of a channel from the summary; return whether it is there."""
        channel = self._summary.channels.get(number)
        if channel is None:
            return False
        self.channels[number] = channel
        if (schema := self._summary.schemas.get(channel.schema_id)) is not None:
            self.schemas.setdefault(channel.schema_id, schema)
        return True

    def _add(self, piece: Piece, data: bytes, starts: NDArray[np.intp]) -> None:
        """Note the messages of a block of bytes that have a channel."""
        starts = starts[_lengths_at(data, starts) >= _MESSAGE.itemsize]
        channel = values_at(data, starts, _MESSAGE)['channel']
        for number in np.flatnonzero(np.bincount(channel)).tolist():
            if number not in self.channels and not self._use_summary(number):
                starts, channel = starts[channel != number], channel[channel != number]
                self._losses.append(f'messages on the unknown channel {number} near byte {piece.offset} are lost')
        if not starts.size:
            return
        block = _messages_at(data, starts)
        self.counts.update(dict(enumerate(np.bincount(block.channel).tolist())))
        first, last = int(block.log_ns.min()), int(block.log_ns.max())
        self._span(first, last)
        self._ends_cut = piece.is_cut
        self.segments.append(Segment(first, last, partial(self._read, piece, starts.astype(np.uint32))))

    def _load(self, piece: Piece, *, is_new: bool = False) -> bytes:
        """Return the records of a piece, unpacked and checked, ``is_new`` the first time; DamageError if that fails."""
        file, chunk = self._file, Record(Opcode.CHUNK, piece.offset + HEAD.size, piece.end)
        head = file.chunk_head(chunk) if piece.is_chunk else None
        if piece.is_chunk and head is None:
            raise DamageError('no valid head of a chunk')
        size = piece.end - piece.offset if head is None else max(head.size, head.stored)
        if size > self._max_chunk:
            raise DamageError(
                f'{size / _MB:.3g} MB in one piece, above the limit of {self._max_chunk / _MB:.3g} MB (--max-chunk)'
            )
        if head is None:
            self._all_checked = False
            return file.read(piece.offset, size)
        if is_new:  # before anything is unpacked
            # Chunks that together exceed the largest one may unpack to 50 times the size of the file.
            most = max(self._max_chunk, 50 * file.size)
            if self._unpacked + head.size > most:
                raise DamageError(f'the chunks of the file unpack to more than {most / _MB:.3g} MB (--max-chunk)')
            self._unpacked += head.size
        self._all_checked &= head.crc != 0
        stored = file.read(chunk.start + head.start, min(head.stored, chunk.end - chunk.start - head.start))
        if not piece.is_cut:
            return head.unpack(stored)
        try:
            return head.unpack_start(stored)
        except DamageError:  # nothing of it is whole
            return b''

    def _fail(self, what: str) -> NoReturn:
        raise InputError(f'{self.path}: {what}')


def hint_of(start: bytes) -> str:
    """Return the format of a file other than MCAP by its first bytes, with the remedy; '' if it is not known."""
    return next((text for sign, text in _HINTS.items() if start.startswith(sign)), '')


def _entries(block: bytes, start: int, channel: int) -> NDArray[np.uint64]:
    """Return log time and place in the chunk of each message of a channel, shape (n, 2); n = 0 if that is not there."""
    none = np.empty((0, 2), dtype=np.uint64)
    if not 0 <= start <= len(block) - _INDEX.size:
        return none
    opcode, _, found, size = _INDEX.unpack_from(block, start)
    if opcode != Opcode.MESSAGE_INDEX or found != channel or size % 16 or start + _INDEX.size + size > len(block):
        return none
    return np.frombuffer(block, '<u8', size // 8, start + _INDEX.size).reshape(-1, 2)


def _messages_at(data: bytes, starts: NDArray[np.intp]) -> MessageBlock:
    """Return the messages whose records, without opcode and length, start at these places."""
    heads = values_at(data, starts, _MESSAGE)
    content = np.frombuffer(data, dtype=np.uint8)
    return MessageBlock(
        content, starts + _MESSAGE.itemsize, starts + _lengths_at(data, starts), heads['channel'], heads['log_ns']
    )


def _lengths_at(data: bytes, starts: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the lengths of records, which stand before their starts."""
    return values_at(data, starts - 8, np.dtype('<i8'))


def _is_known(opcode: int) -> bool:
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
