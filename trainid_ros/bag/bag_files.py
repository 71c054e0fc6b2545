# SPDX-License-Identifier: Apache-2.0
"""Locate and open the files of a bag: a rosbag2 directory, with or without its metadata, or a bare file."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from trainid_ros.bag.db3_file import Db3File
from trainid_ros.bag.mcap_file import McapFile, hint_of
from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import read_text
from trainid_ros.train.strict_yaml import load

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

BagFile: TypeAlias = McapFile | Db3File

METADATA: Final = 'metadata.yaml'
_SQLITE: Final = b'SQLite format 3\0'
_START_BYTES: Final = 64
_STORAGES: Final = ('mcap', 'sqlite3')
SUFFIXES: Final = ('.mcap', '.db3')
_MODES: Final = ('none', 'file', 'message')
_COMPRESSED: Final = '.zstd'  # suffix of a file that ros2 bag compressed as a whole
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


def open_file(
    path: Path, max_chunk: int, is_needed: Callable[[str], bool], advance: Callable[[int], None] = lambda _: None
) -> BagFile:
    """Open one file of a bag: MCAP, or the sqlite3 storage of rosbag2; arguments are those of :class:`McapFile`.

    Raises:
        InputError: It cannot be read.
    """
    if _start(path).startswith(_SQLITE):
        return Db3File(path, is_needed)
    return McapFile(path, max_chunk, is_needed, advance)


def _start(path: Path) -> bytes:
    try:
        with path.open('rb') as file:
            return file.read(_START_BYTES)
    except OSError:
        return b''  # opening it says why


def locate(path: Path) -> BagFiles:
    """Return the files of the bag at a path.

    Raises:
        InputError: The path does not exist or is not a bag, a file is missing, or the storage is not known.
    """
    if not path.exists():
        raise InputError(f'{path}: no such bag')
    if not (path.is_file() or path.is_dir()):  # a pipe or a device may have no end
        raise InputError(f'{path}: is neither a file nor a directory')
    if path.is_file() and path.suffix.lower() in _TABLES:
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
            bags += [Path(folder, name) for name in names if name.lower().endswith(SUFFIXES)]
    return bags


def _from_folder(path: Path, warning: str) -> BagFiles:
    files = _bag_files(path)
    if not files:
        what = f'neither {METADATA} nor an {" or ".join(SUFFIXES)} file'
        raise InputError(f'{path}: no bag in this directory ({what}){_hint(path)}')
    return BagFiles(files, warnings=(warning,))


def _bag_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a bag in a directory in the order of recording."""
    entries = (entry for entry in path.iterdir() if entry.suffix.lower() in SUFFIXES and entry.is_file())
    return tuple(sorted(entries, key=_part_number))


def _hint(path: Path) -> str:
    """Return what a directory without a bag holds instead, '' if that is not known."""
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
        info = document[_ROOT_KEY]
        names = dict.fromkeys(PureWindowsPath(str(name)).name for name in info['relative_file_paths'])
        count, hashes = int(info['message_count']), tuple(_hashes(info))
        custom = tuple((str(name), str(text)) for name, text in (info.get('custom_data') or {}).items())
        storage, mode = str(info['storage_identifier']), str(info.get('compression_mode') or 'none').lower()
        _check_storage(storage, mode)
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = ' '.join(str(error).split()).removeprefix(f'{where}: ')
        return _from_folder(path, f'{where}: unreadable ({reason}), the files were read without it')
    if not names:
        raise InputError(f'{where}: lists no files')
    warnings = []
    if mode != 'none':
        names = {name.removesuffix(_COMPRESSED): None for name in names}
        if mode == 'message' or not all((path / name).is_file() for name in names):
            raise InputError(
                f'{where}: compression mode {mode!r} of ros2 bag is not supported, only compressed chunks '
                'inside an .mcap (see ros2 bag convert)'
            )
        warnings.append(f'{where}: compression mode {mode!r}, but the files are unpacked, and were read')
    listed = [path / name for name in names]
    others = [file for file in _bag_files(path) if file not in listed]
    if missing := [file for file in listed if not file.is_file()]:
        warning = f'{missing[0]}: file listed in {METADATA} is missing'
        if len(missing) == len(listed) and not others:
            raise InputError(warning + _hint(path))
        return BagFiles(_bag_files(path), count, hashes, (f'{warning}, the files that are there were read',), custom)
    # The recorder was killed before it listed them, or they were copied in.
    parts = [file for file in others if _series(file) in map(_series, listed)]
    warnings += [f'{file}: not listed in {METADATA}, read as a part of the bag' for file in parts]
    warnings += [f'{file}: not listed in {METADATA}, not read' for file in others if file not in parts]
    files = tuple(sorted([*listed, *parts], key=_part_number)) if parts else tuple(listed)
    return BagFiles(files, count, hashes, tuple(warnings), custom)


def _series(path: Path) -> tuple[str, str]:
    """Return the name that the numbered parts of a split bag share, that of the file if it is none, and its suffix."""
    head, number, _ = _part_number(path)
    return head if number >= 0 else path.name, path.suffix


def _check_storage(storage: str, mode: str) -> None:
    """Raise ValueError for a storage or compression that is not known."""
    if storage not in _STORAGES or mode not in _MODES:
        raise ValueError(f'storage {storage!r} with compression mode {mode!r} is not known')


def _hashes(info: Any) -> Iterable[tuple[str, str]]:
    for entry in info.get('topics_with_message_count') or ():
        topic = entry['topic_metadata']
        yield str(topic['name']), str(topic.get('type_description_hash') or '')
