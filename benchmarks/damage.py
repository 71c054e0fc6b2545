# SPDX-License-Identifier: Apache-2.0
"""Damaged bags: cut at any byte, one flipped bit anywhere, blocks of zeros; closed bags with and without compression.

Of each damaged bag all messages outside the damaged chunks must be read, none with other values, and a loss must be
said. Damage outside the messages, such as in the index, need not be said if no message is lost.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

from benchmarks.tables import Table, columns
from trainid_ros.bag.mcap_file import MAGIC, McapFile, RecordFile
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import full_definition, full_type, message_from_record, typestore
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import MassRecord, Record

_MESSAGES: Final = 5_000
_CHUNK_BYTES: Final = 16_384
_BLOCK_BYTES: Final = 4096
_FIRST_NS: Final = 1_700_000_000_000_000_000
_SEED: Final = 1


@dataclass(frozen=True, slots=True)
class Original:
    """An intact bag of one file: its bytes, its records, and start, end and number of messages of each chunk."""

    content: bytes
    records: list[Record]
    chunks: list[tuple[int, int, int]]


@dataclass(frozen=True, slots=True)
class Damaged:
    """A damaged file, and the first and last place that differ from the original."""

    content: bytes
    first: int
    last: int


@dataclass(slots=True)
class Score:
    files: int = 0
    rejected: int = 0
    wrong: int = 0
    unsaid: int = 0
    intact: int = 0
    found: int = 0
    longest_s: float = 0.0

    @property
    def share(self) -> float:
        """Share of the messages in intact chunks that were read."""
        return self.found / self.intact if self.intact else 1.0


def write_original(folder: Path, compression: CompressionType) -> Original:
    """Write a bag of many small chunks with checksums, as rosbag2 does."""
    path, name = folder / 'original.mcap', full_type('TrainMass')
    records = [MassRecord(_FIRST_NS + 200_000_000 * i, 2e5 + i) for i in range(_MESSAGES)]
    writer = Writer(str(path), _CHUNK_BYTES, compression, index_types=IndexType.ALL, enable_data_crcs=True)
    writer.start('ros2')
    schema = writer.register_schema(name, 'ros2msg', full_definition('TrainMass').encode())
    channel = writer.register_channel('/ato/mass', 'cdr', schema)
    for record in records:
        payload = bytes(typestore().serialize_cdr(message_from_record(record), name))
        writer.add_message(channel, record.stamp_ns, payload, record.stamp_ns)
    writer.finish()  # type: ignore[no-untyped-call]
    file = McapFile(path)
    counts = [segment.read().start.size for segment in file.segments]
    file.close()
    return Original(
        path.read_bytes(), [*records], [(*place, n) for place, n in zip(_chunks(path), counts, strict=True)]
    )


def _chunks(path: Path) -> Iterator[tuple[int, int]]:
    file, position = RecordFile(path), len(MAGIC)
    while (record := file.record(position)) is not None and record.opcode != Opcode.DATA_END:
        if record.opcode == Opcode.CHUNK:
            yield record.offset, record.end
        position = record.end
    file.close()


def cut(content: bytes, rng: np.random.Generator) -> Damaged:
    place = int(rng.integers(len(MAGIC) + 1, len(content)))
    return Damaged(content[:place], place, len(content))


def flip(content: bytes, rng: np.random.Generator) -> Damaged:
    place, changed = int(rng.integers(len(content))), bytearray(content)
    changed[place] ^= 1 << int(rng.integers(8))
    return Damaged(bytes(changed), place, place)


def erase(content: bytes, rng: np.random.Generator) -> Damaged:
    """Overwrite one block with zeros."""
    place, changed = int(rng.integers(len(content) // _BLOCK_BYTES)) * _BLOCK_BYTES, bytearray(content)
    changed[place : place + _BLOCK_BYTES] = bytes(_BLOCK_BYTES)
    return Damaged(bytes(changed), place, place + _BLOCK_BYTES - 1)


KINDS: Final[dict[str, Callable[[bytes, np.random.Generator], Damaged]]] = {
    'cut at a byte': cut,
    'one bit flipped': flip,
    'a block of zeros': erase,
}


def judge(original: Original, damaged: Damaged, path: Path, score: Score) -> None:
    """Read a damaged file and add the outcome to a score."""
    path.write_bytes(damaged.content)
    score.files += 1
    intact: list[Record] = []
    first = 0
    for start, end, count in original.chunks:
        if end <= damaged.first or start > damaged.last:
            intact += original.records[first : first + count]
        first += count
    score.intact += len(intact)
    before = time.perf_counter()
    try:
        with BagReader(path) as reader:
            found, warnings = list(reader.records()), reader.warnings
    except InputError:
        score.rejected += bool(intact)
        return
    score.longest_s = max(score.longest_s, time.perf_counter() - before)
    known, read = set(original.records), set(found)
    score.found += sum(record in read for record in intact)
    score.wrong += len(found) != len(read) or not read <= known
    score.unsaid += len(found) < len(original.records) and not warnings


def campaign(files: int, folder: Path, compression: CompressionType, kind: str, seed: int = _SEED) -> Score:
    rng, score = np.random.default_rng(seed), Score()
    original = write_original(folder, compression)
    for _ in range(files):
        judge(original, KINDS[kind](original.content, rng), folder / 'damaged.mcap', score)
    return score


def measure(files: int) -> tuple[Table, ...]:
    header = columns(
        'damage | files | rejected | intact messages read | files with a wrong value | loss not said | longest s'
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:
            for compression in CompressionType:
                score = campaign(files, Path(folder), compression, kind)
                counts = (score.files, score.rejected, f'{score.share:.3%}', score.wrong, score.unsaid)
                rows.append((f'{kind}, {compression.name.lower()}', *map(str, counts), f'{score.longest_s:.2f}'))
    note = (
        f'Bags of {_MESSAGES} messages in chunks of {_CHUNK_BYTES} bytes with checksums. Rejected: although a chunk '
        'was intact. Intact: in chunks that the damage does not touch.'
    )
    return (Table('Damaged bags', header, tuple(rows), note),)
