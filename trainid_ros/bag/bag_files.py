# SPDX-License-Identifier: Apache-2.0
"""The files of a bag: a rosbag2 directory, with or without its metadata, or a bare file, MCAP or sqlite3."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path, PureWindowsPath
from typing import Any, Final, NoReturn, TypeAlias

import numpy as np
from mcap.records import Channel, Schema

from trainid_ros.bag.mcap_file import McapFile, hint_of
from trainid_ros.bag.types import MessageBlock, Segment, full_definition, full_type
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, OUTPUT_TOPICS
from trainid_ros.interface.text import pluralise
from trainid_ros.train.fields import read_text
from trainid_ros.train.strict_yaml import load

_MESSAGES_AT_ONCE: Final = 5000  # from a sqlite3 file
_OURS: Final = {full_type(topic.message): topic.message for topic in (*INPUT_TOPICS, *OUTPUT_TOPICS)}
# SQLite stores any type in any column: texts compare above all numbers as times, and may stand for payloads.
_TIMES: Final = 'SELECT timestamp FROM messages WHERE timestamp >= 0 AND typeof(timestamp) = "integer" ORDER BY 1'
_MESSAGES: Final = (
    'SELECT topic_id, timestamp, CAST(data AS BLOB) FROM messages '
    'WHERE topic_id IN ({}) AND timestamp BETWEEN ? AND ? ORDER BY timestamp, id'
)


class Db3File:
    """The messages of one ``.db3`` file; attributes as those of :class:`McapFile`."""

    def __init__(self, path: Path, is_needed: Callable[[str], bool]) -> None:
        """Open a file; messages of topics that are not needed are left out. InputError if it cannot be read."""
        self.path = path
        self.promised: int | None = None
        self.warnings: list[str] = []
        # The path must be quoted in a URI: a part after # names no file.
        uri = f'{path.absolute().as_uri()}?immutable=1'
        self._file = sqlite3.connect(uri, uri=True, check_same_thread=False)
        self._file.text_factory = partial(str, encoding='utf-8', errors='replace')
        try:
            self.channels, self.schemas = self._topics()
            self.segments = self._spans()
            self.last_ns = self.segments[-1].last_ns if self.segments else 0
            counts = 'SELECT topic_id, count(*) FROM messages WHERE timestamp BETWEEN 0 AND ? GROUP BY 1'
            found = dict(self._file.execute(counts, (self.last_ns,))) if self.segments else {}
            total = self._file.execute('SELECT count(*) FROM messages').fetchone()[0]
        except sqlite3.Error as error:
            self._fail(error)
        self.first_ns = self.segments[0].first_ns if self.segments else 0
        self.counts = {number: found[number] for number in self.channels if number in found}
        self._needed = [number for number, channel in self.channels.items() if is_needed(channel.topic)]
        for left_out, what in (
            (total - sum(found.values()), 'without a valid log time'),
            (sum(found.values()) - sum(self.counts.values()), 'on unknown topics'),
        ):
            if left_out:
                self.warnings.append(f'{path}: {pluralise(left_out, "message")} {what} left out')
        journal = path.with_name(f'{path.name}-wal')
        if journal.is_file() and journal.stat().st_size:
            self.warnings.append(f'{journal}: messages of an interrupted recording, which are not read')

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, first_ns: int, last_ns: int) -> MessageBlock:
        """Return the needed messages between two log times [ns], in their order; InputError if the file is damaged."""
        try:
            query = _MESSAGES.format(','.join('?' * len(self._needed)))
            found = self._file.execute(query, (*self._needed, first_ns, last_ns)).fetchall()
        except sqlite3.Error as error:
            self._fail(error)
        payloads = [data or b'' for _, _, data in found]
        sizes = np.array([len(data) for data in payloads], dtype=np.intp)
        ends = np.cumsum(sizes, dtype=np.intp)
        return MessageBlock(
            data=np.frombuffer(bytearray().join(payloads), dtype=np.uint8),
            start=ends - sizes,
            end=ends,
            channel=np.array([number for number, _, _ in found], dtype=np.int64),
            log_ns=np.array([log_ns for _, log_ns, _ in found], dtype=np.uint64),
        )

    def _spans(self) -> list[Segment]:
        """Return spans of some thousand messages each; they do not overlap."""
        times = (row[0] for row in self._file.execute(_TIMES))
        spans: list[Segment] = []
        while some := list(islice(times, _MESSAGES_AT_ONCE)):
            # Messages of equal log times belong to one span.
            first_ns = max(some[0], spans[-1].last_ns + 1) if spans else some[0]
            if some[-1] >= first_ns:
                spans.append(Segment(first_ns, some[-1], partial(self._read, first_ns, some[-1])))
        return spans

    def _topics(self) -> tuple[dict[int, Channel], dict[int, Schema]]:
        """Return channels and definitions, both by the number of the topic."""
        hashes = 'type_description_hash' if self._has('topics', 'type_description_hash') else "''"
        # As text, whatever is stored: a topic that nobody reads must not make the others unreadable.
        rows = self._file.execute(
            f'SELECT id, {_texts("name", "type", "serialization_format")}, {hashes} FROM topics ORDER BY id'
        )
        texts: dict[str, tuple[str, str]] = {}
        if self._has('message_definitions', 'encoded_message_definition'):
            query = f'SELECT {_texts("topic_type", "encoding", "encoded_message_definition")} FROM message_definitions'
            texts = {kind: (encoding, text) for kind, encoding, text in self._file.execute(query)}
        channels, schemas = {}, {}
        for number, topic, kind, encoding, digest in rows.fetchall():
            form, text = texts.get(kind, ('', ''))
            # Older files hold no definitions, so the packaged one is taken for our types.
            if kind in _OURS and not (digest or text):
                form, text = 'ros2msg', full_definition(_OURS[kind])
            metadata = {'topic_type_hash': digest} if digest else {}
            channels[number] = Channel(number, topic, encoding, metadata, schema_id=number)
            schemas[number] = Schema(number, text.encode(), form, kind)
        return channels, schemas

    def _has(self, table: str, column: str) -> bool:
        return any(row[1] == column for row in self._file.execute(f'PRAGMA table_info({table})'))

    def _fail(self, error: Exception) -> NoReturn:
        self.close()
        raise InputError(f'{self.path}: unreadable sqlite3 storage ({" ".join(str(error).split())})') from None


def _texts(*columns: str) -> str:
    return ', '.join(f"CAST(coalesce({column}, '') AS TEXT)" for column in columns)


BagFile: TypeAlias = McapFile | Db3File  # a file of a bag, by its storage

METADATA: Final = 'metadata.yaml'  # file that names the files of a bag
SUFFIXES: Final = ('.mcap', '.db3')  # of files that are read as bags


@dataclass(frozen=True, slots=True)
class BagFiles:
    """The files of a bag in the order of recording, and the contents of ``metadata.yaml``."""

    files: tuple[Path, ...]  # The files
    message_count: int | None = None  # Number of messages according to the metadata, None if unknown
    hashes: tuple[tuple[str, str], ...] = ()  # Pairs of full topic name and type hash
    warnings: tuple[str, ...] = ()  # Faults of the directory that do not prevent reading
    # Pairs of name and text that the recording was given (``ros2 bag record --custom-data``)
    custom_data: tuple[tuple[str, str], ...] = ()


def open_file(path: Path, max_chunk: int, is_needed: Callable[[str], bool], advance: Callable[[int], None]) -> BagFile:
    """Open one file of a bag, MCAP or the sqlite3 storage of rosbag2; arguments and errors as of :class:`McapFile`."""
    if _start(path).startswith(b'SQLite format 3\0'):
        return Db3File(path, is_needed)
    return McapFile(path, max_chunk, is_needed, advance)


def _start(path: Path) -> bytes:
    try:
        with path.open('rb') as file:
            return file.read(64)
    except OSError:
        return b''  # opening it says why


def locate(path: Path) -> BagFiles:
    """Return the files of the bag at a path; InputError if it is no bag, a file is missing, or its storage unknown."""
    if not path.exists():
        raise InputError(f'{path}: no such bag')
    if not (path.is_file() or path.is_dir()):  # a pipe or a device may have no end
        raise InputError(f'{path}: is neither a file nor a directory')
    if path.is_file() and path.suffix.lower() in {'.csv', '.parquet', '.npz'}:
        raise InputError(f'{path}: is a table, not a bag; trainid import makes a bag of it')
    if path.is_file():
        return BagFiles((path,))
    if (path / METADATA).is_file():
        return _from_metadata(path)
    return _from_folder(path, f'{path}: {METADATA} is missing, the files were read without it')


def bags_below(path: Path) -> list[Path]:
    """Return the bags in a folder at any depth, or the path itself if it is a file.

    A folder with a ``metadata.yaml`` is a bag; in others each file of a recorder is one, also a compressed one.
    """
    if not path.is_dir():
        return [path]
    bags: list[Path] = []
    seen: set[str] = set()
    for folder, folders, names in os.walk(path, followlinks=True):
        real = os.path.realpath(folder)
        if real in seen:  # links may lead in circles
            folders.clear()
            continue
        seen.add(real)
        if METADATA in names:
            folders.clear()
            bags.append(Path(folder))
        else:
            files = (Path(folder, name) for name in names)
            bags += [file for file in files if file.suffix.lower() in SUFFIXES or _packed_hint(file)]
    return bags


def _from_folder(path: Path, warning: str) -> BagFiles:
    files = _bag_files(path)
    if not files:
        what = f'neither {METADATA} nor an {" or ".join(SUFFIXES)} file'
        raise InputError(f'{path}: no bag in this directory ({what}){_hint(path)}')
    return BagFiles(files, warnings=(warning, *_packed(path)))


def _bag_files(path: Path) -> tuple[Path, ...]:
    entries = (entry for entry in path.iterdir() if entry.suffix.lower() in SUFFIXES and entry.is_file())
    return tuple(sorted(entries, key=_part_number))


def _packed(path: Path) -> Iterator[str]:
    """Yield a warning for each compressed file of a bag in a folder; a recorder leaves its last one as it is."""
    yield from (f'{entry}: not read{hint}' for entry in sorted(path.iterdir()) if (hint := _packed_hint(entry)))


def _packed_hint(path: Path) -> str:
    """Return the hint about a compressed file of a bag, '' if it is none or is also there unpacked."""
    unpacked = path.with_suffix('')
    return hint_of(_start(path)) if unpacked.suffix.lower() in SUFFIXES and not unpacked.exists() else ''


def _hint(path: Path) -> str:
    """Return a hint about the contents of a directory without a bag, '' if they are not known."""
    entries = (entry for entry in sorted(path.iterdir()) if entry.is_file())
    return next((f'; {entry.name}{hint}' for entry in entries if (hint := hint_of(_start(entry)))), '')


def _part_number(path: Path) -> tuple[str, int, str]:
    """Return a sort key: ``bag_10.mcap`` comes after ``bag_9.mcap``, as rosbag2 numbers the parts of a split bag."""
    head, _, tail = path.stem.rpartition('_')
    return (head, int(tail), path.name) if tail.isdecimal() else (path.stem, -1, path.name)


def _from_metadata(path: Path) -> BagFiles:
    where = path / METADATA
    try:
        document: Any = load(read_text(where), str(where))
        info = document['rosbag2_bagfile_information']
        names = dict.fromkeys(PureWindowsPath(str(name)).name for name in info['relative_file_paths'])
        count = int(info['message_count'])
        topics = [entry['topic_metadata'] for entry in info.get('topics_with_message_count') or ()]
        hashes = tuple((str(topic['name']), str(topic.get('type_description_hash') or '')) for topic in topics)
        custom = tuple((str(name), str(text)) for name, text in (info.get('custom_data') or {}).items())
        storage, mode = str(info['storage_identifier']), str(info.get('compression_mode') or 'none').lower()
    except (InputError, KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        reason = ' '.join(str(error).split()).removeprefix(f'{where}: ')
    else:
        is_known = storage in {'mcap', 'sqlite3'} and mode in {'none', 'file', 'message'}
        reason = '' if is_known else f'storage {storage!r} with compression mode {mode!r} is not known'
    if reason:
        return _from_folder(path, f'{where}: unreadable ({reason}), the files were read without it')
    if not names:
        raise InputError(f'{where}: lists no files')
    warnings = []
    if mode != 'none':
        names = {name.removesuffix('.zstd'): None for name in names}  # of files compressed as a whole
        if mode == 'message' or not all((path / name).is_file() for name in names):
            raise InputError(
                f'{where}: compression mode {mode!r} of ros2 bag is not supported, only compressed chunks '
                'inside an .mcap (see ros2 bag convert)'
            )
        warnings.append(f'{where}: compression mode {mode!r}, but the files are unpacked, and were read')
    listed = [path / name for name in names]
    others = [file for file in _bag_files(path) if file not in listed]
    there = [file for file in listed if file.is_file()]
    missing = [f'{file}: file listed in {METADATA} is missing' for file in listed if file not in there]
    if not (there or others):
        raise InputError(missing[0] + _hint(path))
    # The recorder was killed before it listed them, or they were copied in or renamed.
    parts = [file for file in others if not there or _series(file) in map(_series, listed)]
    warnings += [f'{warning}, the files that are there were read' for warning in missing]
    warnings += [f'{file}: not listed in {METADATA}, read as a part of the bag' for file in parts if there]
    warnings += [f'{file}: not listed in {METADATA}, not read' for file in others if file not in parts]
    files = tuple(sorted([*there, *parts], key=_part_number)) if parts else tuple(there)
    warnings += _packed(path)
    return BagFiles(files, count, hashes, tuple(warnings), custom)


def _series(path: Path) -> tuple[str, str]:
    """Return the name that the numbered parts of a split bag share, that of the file if it is none, and its suffix."""
    head, number, _ = _part_number(path)
    return head if number >= 0 else path.name, path.suffix
