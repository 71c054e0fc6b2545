# SPDX-License-Identifier: Apache-2.0
"""Locate and open the files of a bag: a rosbag2 directory, with or without its metadata, or a bare file."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any, Final, Protocol

from trainid_ros.bag.mcap_file import McapFile
from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import load, read_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from mcap.records import Channel, Schema

    from trainid_ros.bag.message_block import MessageBlock

METADATA: Final = 'metadata.yaml'
_SQLITE: Final = b'SQLite format 3\0'
_STORAGES: Final = ('mcap', 'sqlite3')
SUFFIXES: Final = ('.mcap', '.db3')
_TABLES: Final = ('.csv', '.parquet', '.npz')
_ROOT_KEY: Final = 'rosbag2_bagfile_information'


@dataclass(frozen=True, slots=True)
class BagFiles:
    """The files of a bag in the order of recording, and the contents of ``metadata.yaml``."""

    files: tuple[Path, ...]  # The files
    message_count: int | None = None  # Number of messages according to the metadata, None if unknown
    hashes: tuple[tuple[str, str], ...] = ()  # Pairs of full topic name and type hash
    warnings: tuple[str, ...] = ()  # Faults of the directory that do not prevent reading
    # Pairs of name and text that the recording was given (``ros2 bag record --custom-data``)
    custom_data: tuple[tuple[str, str], ...] = ()


class Span(Protocol):
    """A part of a file with messages, from a first to a last log time [ns]."""

    @property
    def first_ns(self) -> int:
        """First log time [ns]."""

    @property
    def last_ns(self) -> int:
        """Last log time [ns]."""


class BagFile(Protocol):
    """One file of a bag, open; attributes as those of :class:`McapFile`."""

    path: Path
    promised: int | None
    warnings: list[str]

    @property
    def channels(self) -> Mapping[int, Channel]:
        """Channels by number."""

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """Message definitions by number."""

    @property
    def counts(self) -> Mapping[int, int]:
        """Number of messages by channel number."""

    @property
    def segments(self) -> Sequence[Span]:
        """Parts of the file that hold messages of needed topics."""

    @property
    def first_ns(self) -> int:
        """First log time [ns], 0 without messages."""

    @property
    def last_ns(self) -> int:
        """Last log time [ns]."""

    def messages(self, segment: Any) -> MessageBlock:
        """Return the messages of one segment.

        Raises:
            InputError: The file cannot be read.
        """

    def close(self) -> None:
        """Close the file."""


def open_file(
    path: Path, max_chunk: int, is_needed: Callable[[str], bool], advance: Callable[[int], None] = lambda _: None
) -> BagFile:
    """Open one file of a bag: MCAP, or the sqlite3 storage of rosbag2; arguments are those of :class:`McapFile`.

    Raises:
        InputError: It cannot be read.
    """
    if _is_sqlite(path):
        # Imported here because reading MCAP needs no rosbags.
        from trainid_ros.bag.db3_file import Db3File  # noqa: PLC0415

        return Db3File(path, is_needed)
    return McapFile(path, max_chunk, is_needed, advance)


def _is_sqlite(path: Path) -> bool:
    try:
        with path.open('rb') as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False  # opening it says why


def locate(path: Path) -> BagFiles:
    """Return the files of the bag at a path.

    Raises:
        InputError: The path does not exist or is not a bag, a file is missing, or the storage is not known.
    """
    if not path.exists():
        raise InputError(f'{path}: no such bag')
    if not (path.is_file() or path.is_dir()):  # a pipe or a device may have no end
        raise InputError(f'{path}: is neither a file nor a directory')
    if path.is_file() and path.suffix in _TABLES:
        raise InputError(f'{path}: is a table, not a bag; trainid import makes a bag of it')
    if path.is_file():
        return BagFiles((path,))
    if (path / METADATA).is_file():
        return _from_metadata(path)
    return _from_folder(path, f'{path}: {METADATA} is missing, the files were read without it')


def bags_below(path: Path) -> list[Path]:
    """Return the bags in a folder at any depth, or the path itself if it is a file.

    A folder with a ``metadata.yaml`` is a bag; in others each file of a recorder is one.
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
            bags += [Path(folder, name) for name in names if name.endswith(SUFFIXES)]
    return bags


def _from_folder(path: Path, warning: str) -> BagFiles:
    files = _bag_files(path)
    if not files:
        raise InputError(f'{path}: no bag in this directory (neither {METADATA} nor an {" or ".join(SUFFIXES)} file)')
    return BagFiles(files, warnings=(warning,))


def _bag_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a bag in a directory in the order of recording."""
    entries = (entry for entry in path.iterdir() if entry.suffix in SUFFIXES and entry.is_file())
    return tuple(sorted(entries, key=_part_number))


def _part_number(path: Path) -> tuple[str, int, str]:
    """Return a sort key: ``bag_10.mcap`` comes after ``bag_9.mcap``, as rosbag2 numbers the parts of a split bag."""
    head, _, tail = path.stem.rpartition('_')
    return (head, int(tail), path.name) if tail.isdecimal() else (path.stem, -1, path.name)


def _from_metadata(path: Path) -> BagFiles:
    where = path / METADATA
    try:
        document: Any = load(read_text(where), str(where))
        info = document[_ROOT_KEY]
        names = dict.fromkeys(PureWindowsPath(str(name)).name for name in info['relative_file_paths'])
        count, hashes = int(info['message_count']), tuple(_hashes(info))
        custom = tuple((str(name), str(text)) for name, text in (info.get('custom_data') or {}).items())
        _check_storage(where, str(info['storage_identifier']), str(info.get('compression_mode') or 'none').lower())
    except _UnsupportedError as error:
        raise InputError(str(error)) from None
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = ' '.join(str(error).split()).removeprefix(f'{where}: ')
        return _from_folder(path, f'{where}: unreadable ({reason}), the files were read without it')
    if not names:
        raise InputError(f'{where}: lists no files')
    if not (missing := [path / name for name in names if not (path / name).is_file()]):
        return BagFiles(tuple(path / name for name in names), count, hashes, custom_data=custom)
    warning = f'{missing[0]}: file listed in {METADATA} is missing'
    if not (others := _bag_files(path)):
        raise InputError(warning)
    return BagFiles(others, count, hashes, (f'{warning}, the files that are there were read',), custom)


class _UnsupportedError(Exception):
    """The bag is stored in a way that is known but not supported."""


def _check_storage(where: Path, storage: str, mode: str) -> None:
    """Raise _UnsupportedError for a storage or compression that is known, ValueError for one that is not."""
    if mode in {'file', 'message'}:
        raise _UnsupportedError(
            f'{where}: compression mode {mode!r} of ros2 bag is not supported, only compressed chunks '
            'inside an .mcap (see ros2 bag convert)'
        )
    if storage not in _STORAGES or mode != 'none':
        raise ValueError(f'storage {storage!r} with compression mode {mode!r} is not known')


def _hashes(info: Any) -> Iterable[tuple[str, str]]:
    for entry in info.get('topics_with_message_count') or ():
        topic = entry['topic_metadata']
        yield str(topic['name']), str(topic.get('type_description_hash') or '')
