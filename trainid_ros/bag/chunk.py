# SPDX-License-Identifier: Apache-2.0
"""One chunk of an MCAP file: its head, and its records unpacked within a limit and checked.

Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from typing import TYPE_CHECKING, Final, NamedTuple

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped] # comes with mcap
from zstandard import ZstdDecompressor, ZstdError

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_CHUNK: Final = 64 << 20
"""Largest chunk that is unpacked unless a larger one is asked for [bytes]."""
MAX_HEAD: Final = 64
"""Number of bytes that hold the head of every chunk."""
_FIRST: Final = struct.Struct('<QQQII')  # log times, unpacked size, checksum, length of the name of the compression
_SIZE: Final = struct.Struct('<Q')
_NAMES: Final = ('', 'lz4', 'zstd')
_PIECE: Final = 1 << 20
_INPUT_PIECE: Final = 1 << 16


class DamageError(Exception):
    """A piece of a file cannot be used; the text says why."""


class ChunkHead(NamedTuple):
    """Head of a chunk."""

    size: int  # Size of its records [bytes]
    crc: int  # Checksum of its records, 0 without one
    compression: str  # '', 'lz4' or 'zstd'
    start: int  # Where the stored records start in the content of the chunk
    stored: int  # Their stored size [bytes]


def read_head(content: bytes, length: int) -> ChunkHead | None:
    """Return the head of a chunk, given the first bytes of its content; None if it does not fit its length."""
    if len(content) < _FIRST.size:
        return None
    _, _, size, crc, name_length = _FIRST.unpack_from(content)
    end = _FIRST.size + name_length
    name = content[_FIRST.size : end].decode('ascii', errors='replace')
    if name not in _NAMES or len(content) < end + _SIZE.size:
        return None
    (stored,) = _SIZE.unpack_from(content, end)
    start = end + _SIZE.size
    return ChunkHead(size, crc, name, start, stored) if start + stored == length else None


def unpack(head: ChunkHead, stored: bytes) -> bytes:
    """Return the records of a chunk, checked.

    Raises:
        DamageError: They cannot be unpacked, or size or checksum is not that of the head.
    """
    data = b''.join(_pieces(head, stored))
    if len(data) != head.size:
        raise DamageError(f'unpacks to {len(data)} instead of {head.size} bytes')
    if head.crc and zlib.crc32(data) != head.crc:
        raise DamageError('checksum does not fit')
    return data


def unpack_start(head: ChunkHead, stored: bytes) -> bytes:
    """Return what can be unpacked of a chunk whose end is missing."""
    data = b''
    try:
        for piece in _pieces(head, stored):
            data += piece
    except DamageError:
        pass
    return data


def _pieces(head: ChunkHead, stored: bytes) -> Iterator[bytes]:
    """Yield the unpacked records in pieces: at most one byte more than the head states."""
    try:
        if head.compression == 'zstd':
            yield from _unpack_zstd(stored, head.size + 1)
        elif head.compression == 'lz4':
            yield from _unpack_lz4(stored, head.size + 1)
        else:
            yield stored
    except (ZstdError, RuntimeError) as error:  # lz4 raises the latter
        raise DamageError(f'cannot be unpacked ({" ".join(str(error).split())})') from None


def _unpack_zstd(stored: bytes, limit: int) -> Iterator[bytes]:
    with ZstdDecompressor().stream_reader(BytesIO(stored)) as reader:
        while limit > 0 and (piece := reader.read(min(limit, _PIECE))):
            yield piece
            limit -= len(piece)


def _unpack_lz4(stored: bytes, limit: int) -> Iterator[bytes]:
    reader, place = LZ4FrameDecompressor(), 0
    while limit > 0 and not reader.eof:
        given = b''
        if reader.needs_input:
            given, place = stored[place : place + _INPUT_PIECE], place + _INPUT_PIECE
            if not given:
                return
        piece = reader.decompress(given, min(limit, _PIECE))
        yield piece
        limit -= len(piece)
