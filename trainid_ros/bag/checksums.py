# SPDX-License-Identifier: Apache-2.0
"""Checksums of a new MCAP file: of its chunks, its data section and its summary. rosbags leaves all of them at 0."""

from __future__ import annotations

import struct
import sys
import zlib
from typing import TYPE_CHECKING, Final

from mcap.opcode import Opcode

from trainid_ros.bag.record_file import HEAD, MAGIC, RecordFile

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

if TYPE_CHECKING:
    from rosbags.rosbag2.storage_mcap import McapWriter

_CRC: Final = struct.Struct('<I')
_IN_CHUNK: Final = HEAD.size + 24  # after two log times and the size
_SUMMARY_START: Final = struct.Struct('<Q')
# zstd can check its own data, which also serves files that were never finished.
_OPTIONS: Final = {int(zstd.CompressionParameter.checksum_flag): 1}


class Checksums:
    """Notes the checksum of each chunk as it is written, and stores all checksums once the file is finished."""

    def __init__(self, storage: McapWriter) -> None:
        """Follow the chunks that a storage writes."""
        self._storage = storage
        self._chunks: list[tuple[int, int]] = []
        storage.compressor = self._compress

    def _compress(self, records: bytes) -> bytes:
        # The chunk starts where the file ends now.
        self._chunks.append((self._storage.bio.tell() + _IN_CHUNK, zlib.crc32(records)))
        return zstd.compress(records, options=_OPTIONS) if self._storage.compression else records

    def store(self) -> None:
        """Write the checksums into the finished file."""
        path = self._storage.path
        with path.open('r+b') as file:

            def put(offset: int, value: int) -> None:
                file.seek(offset)
                file.write(_CRC.pack(value))
                file.flush()

            for offset, crc in self._chunks:
                put(offset, crc)
            written = RecordFile(path)
            position = len(MAGIC)
            while (record := written.record(position)) is not None and record.opcode != Opcode.DATA_END:
                position = record.end
            put(position + HEAD.size, written.crc(0, position))
            end = written.end - _CRC.size
            (summary,) = _SUMMARY_START.unpack(written.read(end - 2 * _SUMMARY_START.size, _SUMMARY_START.size))
            put(end, written.crc(summary, end))
            written.close()
