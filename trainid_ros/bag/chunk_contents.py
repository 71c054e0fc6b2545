# SPDX-License-Identifier: Apache-2.0
"""What the index of an MCAP file says of a chunk, so that only needed messages are read: most bytes may be of cameras.

Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from trainid_ros.bag.chunk import MAX_HEAD, read_head
from trainid_ros.bag.record_file import HEAD, MESSAGE_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable

    from mcap.records import ChunkIndex
    from numpy.typing import NDArray

    from trainid_ros.bag.record_file import Record, RecordFile

# Share of a chunk that needed messages may have [1]: of one with more, all is read, and its checksum is checked.
_SPARSE: Final = 0.1
_MOST_INDEX: Final = 1 << 24  # bytes
_BLOCK: Final = 1 << 12  # bytes that are read at once
_INDEX: Final = struct.Struct('<BQHI')  # opcode, length, channel, size of the entries
_START: Final = struct.Struct('<BQHIQ')  # of a message record: opcode, length, channel, sequence, log time


class ChunkContents(NamedTuple):
    """Messages of a chunk by its index."""

    counts: dict[int, int]  # Number of messages by channel
    # Offset in the file and length of each run of needed message records, in the order of the file
    runs: tuple[tuple[int, int], ...]
    starts: tuple[int, ...]  # Where their contents start if the runs are joined
    end: int  # Where the index of the chunk ends in the file


class _Entry(NamedTuple):
    """One message by the index: its place in the chunk, log time, channel."""

    place: int
    log_ns: int
    channel: int


def indexed_contents(
    file: RecordFile, chunk: Record, index: ChunkIndex | None, is_needed: Callable[[int], bool]
) -> ChunkContents | None:
    """Return what a chunk holds by its index.

    Args:
        file: The file.
        chunk: The chunk.
        index: Its index in the summary of the file, None if there is none.
        is_needed: Whether the messages of a channel are needed.

    Returns:
        None if the index does not fit what it points to, or if the chunk should be read as a whole.
    """
    if index is None or index.chunk_length != chunk.end - chunk.offset or not index.message_index_offsets:
        return None
    length = index.message_index_length
    block = file.read(chunk.end, length) if length < _MOST_INDEX else b''
    counts, needed = {}, []
    for channel, offset in index.message_index_offsets.items():
        entries = _entries(block, offset - chunk.end, channel)
        if not len(entries):
            return None
        counts[channel] = len(entries)
        if is_needed(channel):
            needed += [_Entry(place, log_ns, channel) for log_ns, place in entries.tolist()]
    if needed and index.compression:
        return None
    found = _locate(file, chunk, sorted(needed))
    return None if found is None else ChunkContents(counts, *found, chunk.end + length)


def _entries(block: bytes, start: int, channel: int) -> NDArray[np.uint64]:
    """Return log time and place in the chunk of each message of a channel, shape (n, 2); n = 0 if that is not there."""
    none = np.empty((0, 2), dtype=np.uint64)
    if not 0 <= start <= len(block) - _INDEX.size:
        return none
    opcode, _, found, size = _INDEX.unpack_from(block, start)
    if opcode != Opcode.MESSAGE_INDEX or found != channel or size % 16 or start + _INDEX.size + size > len(block):
        return none
    return np.frombuffer(block, '<u8', size // 8, start + _INDEX.size).reshape(-1, 2)


def _locate(
    file: RecordFile, chunk: Record, entries: list[_Entry]
) -> tuple[tuple[tuple[int, int], ...], tuple[int, ...]] | None:
    """Return runs and starts of messages, see ChunkContents; None if they are not there, or are much of the chunk."""
    length = chunk.end - chunk.start
    head = read_head(file.read(chunk.start, min(MAX_HEAD, length)), length)
    if head is None:
        return None
    begin, total, block, place_of = chunk.start + head.start, 0, b'', 0
    runs: list[tuple[int, int]] = []
    starts: list[int] = []
    for entry in entries:
        if not place_of <= entry.place <= place_of + len(block) - _START.size:
            block, place_of = file.read(begin + entry.place, _BLOCK), entry.place
        if len(block) < _START.size:
            return None
        opcode, size, channel, _, log_ns = _START.unpack_from(block, entry.place - place_of)
        is_there = (opcode, channel, log_ns) == (Opcode.MESSAGE, entry.channel, entry.log_ns) and size >= MESSAGE_BYTES
        starts.append(total + HEAD.size)
        total += HEAD.size + size
        offset = begin + entry.place
        if not is_there or total > _SPARSE * length or offset + HEAD.size + size > chunk.end:
            return None
        if runs and sum(runs[-1]) == offset:
            runs[-1] = (runs[-1][0], runs[-1][1] + HEAD.size + size)
        else:
            runs.append((offset, HEAD.size + size))
    return tuple(runs), tuple(starts)
