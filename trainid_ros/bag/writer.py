# SPDX-License-Identifier: Apache-2.0
"""Write bags that ``ros2 bag play`` can play: rosbag2 directory, MCAP, chunks compressed with zstd."""

from __future__ import annotations

import os
import shutil
import sys
import time
import zlib
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, cast

from mcap.opcode import Opcode
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter

from trainid_ros.bag.mcap_file import HEAD, MAGIC, RecordFile
from trainid_ros.bag.types import (
    PACKAGE,
    digest,
    estimate_message,
    full_definition,
    full_type,
    message_from_record,
    typestore,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import OUTPUT_TOPICS, Record, Row, input_topic, output_topic, record_of
from trainid_ros.interface.results import Output, Status

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rosbags.interfaces import Connection

    from trainid_ros.bag.reader import LoggedRecord

# rmw represents "no limit" by its largest duration.
_NO_LIMIT: Final = QosTime(9223372036, 854775807)

# Of inputs and live estimates, and of last valid estimates.
STREAM_QOS: Final = Qos(
    history=QosHistory.KEEP_LAST,
    depth=10,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=_NO_LIMIT,
    lifespan=_NO_LIMIT,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_NO_LIMIT,
    avoid_ros_namespace_conventions=False,
)
LATCHED_QOS: Final = STREAM_QOS._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)


class _Checksums:
    """Notes the checksum of each chunk as it is written, and stores all at the end; rosbags leaves them at 0."""

    def __init__(self, storage: McapWriter) -> None:
        self._storage = storage
        self._chunks: list[tuple[int, int]] = []
        storage.compressor = self._compress

    def _compress(self, records: bytes) -> bytes:
        # The chunk starts where the file ends now; its checksum follows two log times and the size.
        self._chunks.append((self._storage.bio.tell() + HEAD.size + 24, zlib.crc32(records)))
        # zstd can check its own data, which also serves files that were never finished.
        options = {int(zstd.CompressionParameter.checksum_flag): 1}
        return zstd.compress(records, options=options)

    def store(self) -> None:
        """Write the checksums into the finished file."""
        path = self._storage.path
        with path.open('r+b', buffering=0) as file:

            def put(offset: int, value: int) -> None:
                os.pwrite(file.fileno(), value.to_bytes(4, 'little'), offset)

            for offset, crc in self._chunks:
                put(offset, crc)
            written = RecordFile(path)
            position = len(MAGIC)
            while (record := written.record(position)) is not None and record.opcode != Opcode.DATA_END:
                position = record.end
            put(position + HEAD.size, written.crc(0, position))
            end = written.end - 4  # the footer ends with start of the summary, start of its offsets, checksum
            put(end, written.crc(int.from_bytes(written.read(end - 16, 8), 'little'), end))
            written.close()


class BagWriter:
    """Writes one new bag, as an observer of a replay too; use as a context manager.

    Chunks, data section and summary carry checksums. If the ``with`` block ends in an exception, the bag is removed.
    """

    def __init__(self, path: str | Path) -> None:
        """Set the directory of the bag, which is created on entering the context."""
        self.path = Path(path)
        self.message_count = 0
        self._writer: Writer | None = None
        self._connections: dict[str, Connection] = {}
        self._types = typestore()

    def __enter__(self) -> Self:
        """Create the directory; InputError if the path exists or cannot be created."""
        if self.path.exists() or self.path.is_symlink():
            raise InputError(f'{self.path}: exists already and is not overwritten')
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        try:
            self._writer.open()
        except OSError as error:
            raise InputError(f'{self.path}: cannot be written ({error.strerror})') from None
        self._checksums = _Checksums(cast(McapWriter, self._writer.storage))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish the bag, or remove it if the block failed."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        with ExitStack() as stack:
            stack.callback(shutil.rmtree, self.path, ignore_errors=True)
            stack.callback(writer.abort)
            if kind is None:
                writer.close()
                self._checksums.store()
                stack.pop_all()

    def on_record(self, entry: LoggedRecord) -> None:
        """Write an input with its own log time, so that the new bag replays in the same order."""
        self.write_record(entry.record, entry.log_ns)

    def write_record(self, record: Record, log_ns: int | None = None) -> None:
        """Write a record on its topic, logged at a time [ns] or at its stamp."""
        topic = input_topic(record)
        logged_ns = record.stamp_ns if log_ns is None else log_ns
        self.write_message(topic.name, topic.message, logged_ns, message_from_record(record))

    def on_output(self, output: Output[Any], log_ns: int | None = None) -> None:
        """Write an estimator output, and its latched copy if it is valid, logged at a time [ns] or at its stamp."""
        topic, message = output_topic(output.estimate), estimate_message(output)
        logged_ns = output.stamp_ns if log_ns is None else log_ns
        self.write_message(topic.name, topic.message, logged_ns, message)
        if topic.last_valid and message.status == Status.VALID:
            self.write_message(topic.last_valid, topic.message, logged_ns, message)

    def write_message(self, topic: str, msgtype: str, stamp_ns: int, message: Any) -> None:
        """Write a message of the rosbags class of its type; InputError if its log time [ns] cannot be stored.

        The name of the topic may lack the leading slash. The type is the short name of one of our messages, or the full
        name of any in :func:`typestore`.
        """
        if self._writer is None:
            raise InputError(f'{self.path}: the bag is not open')
        if not 0 <= stamp_ns < 2**63:
            raise InputError(f'{self.path}: topic {topic}: log time {stamp_ns} ns cannot be stored')
        name = msgtype if '/' in msgtype else full_type(msgtype)
        connection = self._connections.get(topic) or self._connect(self._writer, topic, name)
        self._writer.write(connection, stamp_ns, self._types.serialize_cdr(message, name))
        self.message_count += 1

    def _connect(self, writer: Writer, topic: str, name: str) -> Connection:
        full = topic if topic.startswith('/') else f'/{topic}'
        latched = any(full == f'/{item.last_valid}' for item in OUTPUT_TOPICS)
        profile = LATCHED_QOS if latched else STREAM_QOS
        package, _, message = name.partition('/msg/')
        # The definition in the typestore has no comments.
        text, rihs01 = (full_definition(message), digest(message)) if package == PACKAGE else (None, None)
        connection = writer.add_connection(
            full, name, typestore=self._types, msgdef=text, rihs01=rihs01, offered_qos_profiles=[profile]
        )
        self._connections[topic] = connection
        return connection


def write_rows(path: Path, rows: Iterable[tuple[int, Row]], files: Mapping[str, str]) -> None:
    """Write inputs with their log times [ns] to a new bag, and texts to files in its folder, beside other threads.

    InputError or OSError if that fails.
    """
    with BagWriter(path) as writer:
        for count, (log_ns, row) in enumerate(rows):
            writer.write_record(record_of(*row), log_ns)
            if count % 32 == 0:  # messages, which take about 1 ms
                time.sleep(0.001)  # or else a thread that gets a message would wait for 5 ms
    for name, text in files.items():
        (path / name).write_text(text, encoding='utf-8')
