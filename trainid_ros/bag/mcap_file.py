# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, read without trust in its contents.

The file is scanned once when it is opened: damage is known before the first message is handed out. Damaged pieces are
left out, and each is named. A chunk is unpacked and checked, unless the index of the file says that few of its bytes
are of needed topics, as beside cameras, and agrees with the records it points to: then only those are read, and
a checksum of the whole chunk cannot be checked. What stays in memory is where each message starts; the chunks are
read again, one by one, when they are asked for.

Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics

from trainid_ros.bag.chunk import MAX_CHUNK, MAX_HEAD, DamageError, read_head, unpack, unpack_start
from trainid_ros.bag.chunk_contents import indexed_contents
from trainid_ros.bag.definitions import DEFINITIONS, UNREADABLE, Definitions
from trainid_ros.bag.message_block import MessageBlock, channels_at, lengths_at, messages_at
from trainid_ros.bag.record_file import HEAD, MAGIC, MESSAGE_BYTES, Record, RecordFile
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

_RUN_BYTES: Final = 1 << 20  # messages outside chunks are taken together up to this size
_MOST_EXPANSION: Final = 50
"""Most bytes that the chunks of a file may unpack to for each of its bytes, if together above the largest chunk."""
_PLAIN: Final = (*DEFINITIONS, Opcode.MESSAGE)
_CHUNK: Final = bytes([Opcode.CHUNK])
_NAMED_LOSSES: Final = 5
_REPORT_BYTES: Final = 1 << 20  # from one report of progress to the next
_MB: Final = 1 << 20


class Piece(NamedTuple):
    """A piece of the file: a chunk, one whose end is missing, or records outside chunks."""

    offset: int
    end: int
    is_chunk: bool
    is_cut: bool = False


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece of the file with messages."""

    piece: Piece  # Where it lies
    first_ns: int  # Their first log time
    last_ns: int  # Their last log time
    starts: NDArray[np.uint32]  # Where their records start, without opcode and length, in the bytes that are read
    runs: tuple[tuple[int, int], ...] = ()  # Offset in the file and length of what is read, none for all of the piece


class McapFile:
    """The messages of one MCAP file, also of a damaged one and of one whose recording was cut off.

    Attributes:
        path: The file.
        channels: Channels by number.
        schemas: Message definitions by number.
        counts: Number of messages by channel number.
        segments: Pieces of the file that hold messages of needed topics, in file order.
        first_ns: First log time [ns], 0 without messages.
        last_ns: Last log time [ns].
        promised: Number of messages that the file states, None if it does not.
        warnings: What is wrong with the file although it can be read.
    """

    def __init__(
        self,
        path: Path,
        max_chunk: int = MAX_CHUNK,
        is_needed: Callable[[str], bool] = lambda _: True,
        advance: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Open and scan a file.

        Args:
            path: The file.
            max_chunk: Largest chunk to unpack, and largest message outside chunks to read [bytes].
            is_needed: Whether the messages of a topic are needed; others may be left out.
            advance: Called with the number of bytes scanned since its last call, at most the size of the file.

        Raises:
            InputError: If it is not MCAP, is empty, or nothing of it can be used.
        """
        self.path = path
        self._definitions = Definitions()
        self.channels, self.schemas = self._definitions.channels, self._definitions.schemas
        self.counts: Counter[int] = Counter()
        self.segments: list[Segment] = []
        self.first_ns = self.last_ns = 0
        self.promised: int | None = None
        self.warnings: list[str] = []
        self._indexes: dict[int, ChunkIndex] = {}
        self._is_needed = is_needed
        self._advance, self._reported = advance, 0
        self._max_chunk = max_chunk
        self._unpacked = 0
        self._all_checked = self._chunked = False
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

    def messages(self, segment: Segment) -> MessageBlock:
        """Return the messages of one segment.

        Raises:
            InputError: The file has changed since it was opened.
        """
        try:
            if segment.runs:
                data = b''.join(self._file.read(offset, length) for offset, length in segment.runs)
            else:
                data = self._load(segment.piece)
            return messages_at(data, segment.starts.astype(np.intp))
        except (DamageError, IndexError):
            self._fail('has changed while it was read')

    def _scan(self) -> None:
        file = self._file
        if file.size == 0:
            self._fail('is empty')
        start = file.read(0, len(MAGIC))
        if start != MAGIC and not file.is_closed:
            self._fail('is not an MCAP file')
        if file.size == len(MAGIC):
            self._fail('holds no records, only the MCAP signature')
        self._all_checked = True
        if file.is_closed:
            self._read_summary()
        reached, last = self._scan_records()
        if file.is_closed and self._losses and not self.counts:
            self._fail(f'nothing of it can be used: {self._losses[0]}')
        self._report_losses()
        if not file.is_closed:
            self._report_cut(file.size - reached, finished=last is not None)
        elif not (self._all_checked or self._losses or last is None or file.crc_fits(last)):
            self.warnings.append(f'{self.path}: checksum of the file does not fit, some messages may be wrong')

    def _report_losses(self) -> None:
        self.warnings += [f'{self.path}: {loss}' for loss in self._losses[:_NAMED_LOSSES]]
        if (more := len(self._losses) - _NAMED_LOSSES) > 0:
            self.warnings.append(f'{self.path}: {more} more losses, of {self._lost_bytes} bytes with those named')

    def _report_cut(self, lost: int, *, finished: bool) -> None:
        if finished:
            self.warnings.append(f'{self.path}: the index at the end is damaged, all messages before it were read')
            return
        if not self.segments:
            self._fail('was cut off before the first complete message, nothing can be recovered')
        incomplete = 'are incomplete' if self.segments[-1].piece.is_cut else 'are lost'
        self.warnings.append(
            f'{self.path}: the recording was cut off: {sum(self.counts.values())} messages were recovered, '
            f'the last {lost} bytes {incomplete}'
        )

    def _lose(self, start: int, end: int, why: str) -> None:
        self._losses.append(f'{end - start} bytes from byte {start} on are lost: {why}')
        self._lost_bytes += end - start

    def _read_summary(self) -> None:
        """Note the index, and what is repeated of definitions, in case that those before the messages are lost."""
        for opcode, content in self._file.summary():
            try:
                if opcode in DEFINITIONS:
                    self._definitions.spare.add(opcode, content)
                elif opcode == Opcode.CHUNK_INDEX:
                    index = ChunkIndex.read(ReadDataStream(BytesIO(content)))
                    self._indexes[index.chunk_start_offset] = index
                elif opcode == Opcode.STATISTICS:
                    self.promised = Statistics.read(ReadDataStream(BytesIO(content))).message_count
            except UNREADABLE:
                return

    def _scan_records(self) -> tuple[int, Record | None]:
        """Take in the data section; return where the last record used ends, and the end of data if there is one."""
        file, position, run = self._file, len(MAGIC), len(MAGIC)
        while True:
            self._report(position)
            record = file.record(position) if position < file.end else None
            plain = record is not None and record.opcode in _PLAIN
            if run < position and (record is None or not plain or record.end - run > _RUN_BYTES):
                self._take(Piece(run, position, is_chunk=False))
                run = position
            if record is None:
                self._chunked |= file.read(position, 1) == _CHUNK
                found = file.search(position + 1, chunked=self._chunked)
                if position >= file.end or (found == file.end and not file.is_closed):
                    self._take_start_of_chunk(position)
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

    def _report(self, position: int) -> None:
        """Report progress up to a place in the file, now and then."""
        if position >= self._reported + _REPORT_BYTES:
            self._advance(position - self._reported)
            self._reported = position

    def _take_record(self, record: Record) -> int:
        """Take in a record that is neither a message nor a definition; return where the next one starts."""
        if record.opcode != Opcode.CHUNK:
            return self._follow(record, record.offset + 1)
        self._chunked = True
        if end := self._take_indexed(record):
            return end
        self._take(Piece(record.offset, record.end, is_chunk=True))
        return self._follow(record, record.end)

    def _take_indexed(self, chunk: Record) -> int:
        """Take in a chunk by the index of the file; return where its index ends, 0 if all of it must be read."""
        index = self._indexes.get(chunk.offset)
        contents = indexed_contents(self._file, chunk, index, self._is_channel_needed)
        if index is None or contents is None or self._file.record(contents.end) is None:
            return 0
        for number in contents.counts:
            self._definitions.use_spare(number)
        self.counts.update(contents.counts)
        first_ns, last_ns = index.message_start_time, index.message_end_time
        self._span(first_ns, last_ns)
        if contents.runs:
            piece = Piece(chunk.offset, chunk.end, is_chunk=True)
            starts = np.array(contents.starts, dtype=np.uint32)
            self.segments.append(Segment(piece, first_ns, last_ns, starts, contents.runs))
        return contents.end

    def _is_channel_needed(self, number: int) -> bool:
        channel = self._definitions.spare.channels.get(number)
        return channel is None or self._is_needed(channel.topic)

    def _span(self, first_ns: int, last_ns: int) -> None:
        """Extend the log times."""
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

    def _take_start_of_chunk(self, offset: int) -> None:
        """Take in what is there of a chunk whose end is missing, if one starts at an offset."""
        if offset + HEAD.size < self._file.end and self._file.read(offset, 1) == _CHUNK:
            self._take(Piece(offset, self._file.end, is_chunk=True, is_cut=True))

    def _take(self, piece: Piece) -> None:
        """Note the definitions and the messages of a piece of the file, or why it is lost."""
        if piece.offset == piece.end:
            return
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
            elif opcode in DEFINITIONS:
                try:
                    self._definitions.add(opcode, data[start:position])
                except UNREADABLE:
                    self._losses.append('an unreadable message definition')
        return np.asarray(starts, dtype=np.intp), position

    def _add(self, piece: Piece, data: bytes, starts: NDArray[np.intp]) -> None:
        """Note the messages of a block of bytes that have a channel."""
        starts = starts[lengths_at(data, starts) >= MESSAGE_BYTES]
        channel = channels_at(data, starts)
        for number in np.flatnonzero(np.bincount(channel)).tolist():
            if number not in self.channels and not self._definitions.use_spare(number):
                starts, channel = starts[channel != number], channel[channel != number]
                self._losses.append(f'messages on the unknown channel {number} near byte {piece.offset} are lost')
        if not starts.size:
            return
        block = messages_at(data, starts)
        self.counts.update(dict(enumerate(np.bincount(block.channel).tolist())))
        first, last = int(block.log_ns.min()), int(block.log_ns.max())
        self._span(first, last)
        self.segments.append(Segment(piece, first, last, starts.astype(np.uint32)))

    def _load(self, piece: Piece, *, is_new: bool = False) -> bytes:
        """Return the records of a piece of the file, unpacked and checked; ``is_new`` the first time.

        Raises:
            DamageError: They are damaged or too large.
        """
        file = self._file
        if not piece.is_chunk:
            self._all_checked = False
            self._check_size(piece.end - piece.offset)
            return file.read(piece.offset, piece.end - piece.offset)
        start = piece.offset + HEAD.size
        _, length = HEAD.unpack(file.read(piece.offset, HEAD.size))
        head = read_head(file.read(start, min(MAX_HEAD, piece.end - start)), length)
        if head is None:
            raise DamageError('no valid head of a chunk')
        self._check_size(max(head.size, head.stored))
        if is_new:  # before anything is unpacked
            self._check_expansion(head.size)
        self._all_checked &= head.crc != 0
        stored = file.read(start + head.start, min(head.stored, piece.end - start - head.start))
        return unpack_start(head, stored) if piece.is_cut else unpack(head, stored)

    def _check_size(self, size: int) -> None:
        if size > self._max_chunk:
            raise DamageError(
                f'{size / _MB:.3g} MB in one piece, above the limit of {self._max_chunk / _MB:.3g} MB (--max-chunk)'
            )

    def _check_expansion(self, size: int) -> None:
        most = max(self._max_chunk, _MOST_EXPANSION * self._file.size)
        if self._unpacked + size > most:
            raise DamageError(f'the chunks of the file unpack to more than {most / _MB:.3g} MB (--max-chunk)')
        self._unpacked += size

    def _fail(self, what: str) -> NoReturn:
        raise InputError(f'{self.path}: {what}')
