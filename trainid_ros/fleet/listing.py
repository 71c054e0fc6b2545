# SPDX-License-Identifier: Apache-2.0
"""Find the bags of a fleet and list them by metadata and index; no message is decoded."""

from __future__ import annotations

from glob import glob, has_magic
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Statistics

from trainid_ros.bag.bag_files import METADATA, SUFFIXES, bags_below, locate
from trainid_ros.bag.record_file import RecordFile
from trainid_ros.errors import InputError
from trainid_ros.fleet.labels import day_of
from trainid_ros.fleet.plan import PlannedBag
from trainid_ros.records import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from trainid_ros.fleet.labels import LabelRule


def find_bags(given: Sequence[Path]) -> list[Path]:
    """Return the absolute paths of the bags named, in a named folder or fitting a pattern; each once, in order of path.

    Raises:
        InputError: A path does not exist, or holds no bag.

    """
    found: dict[Path, Path] = {}
    for path in given:
        bags = sorted(bag for place in _matching(path) for bag in bags_below(place))
        if not bags:
            msg = f'{path}: holds no bag (neither {METADATA} nor a file {" or ".join(SUFFIXES)})'
            raise InputError(msg)
        for bag in bags:
            found.setdefault(bag.resolve(), bag.absolute())  # a report may be made from another folder
    return list(found.values())


def _matching(path: Path) -> list[Path]:
    if path.exists():
        return [path]
    if not has_magic(str(path)):
        msg = f'{path}: no such bag or folder'
        raise InputError(msg)
    return [Path(name) for name in glob(str(path), recursive=True)]  # noqa: PTH207 - the pattern may be absolute


def list_bags(
    bags: Sequence[Path], rule: LabelRule, advance: Callable[[float], None] = lambda _: None
) -> tuple[PlannedBag, ...]:
    """Return the bags as they are listed in the plan; one that cannot be used has an error."""
    listed = []
    for bag in bags:
        listed.append(_list(bag, rule))
        advance(1.0)
    return tuple(listed)


def _list(path: Path, rule: LabelRule) -> PlannedBag:
    try:
        located = locate(path)
        stats = [file.stat() for file in located.files]
        size, modified_ns = sum(stat.st_size for stat in stats), max(stat.st_mtime_ns for stat in stats)
        start_s, messages = _statistics(located.files)
        labels = rule.labels(path, dict(located.custom_data))
        labels['day'] = day_of(labels['day'], start_s, path) or ''
    except InputError as error:
        return PlannedBag(str(path), error=str(error))
    except OSError as error:
        return PlannedBag(str(path), error=f'{error.filename or path}: {error.strerror}')
    return PlannedBag(str(path), size, modified_ns, start_s, messages, **labels)


def _statistics(files: Iterable[Path]) -> tuple[float | None, int | None]:
    """Return time of the first message [s] and number of messages by the index of all files, None if it is missing."""
    first_ns, messages = [], 0
    for path in files:
        file = RecordFile(path)
        try:
            records = dict(file.summary()) if file.is_closed else {}
        finally:
            file.close()
        if (content := records.get(Opcode.STATISTICS)) is None:
            return None, None
        statistics = Statistics.read(ReadDataStream(BytesIO(content)))
        messages += statistics.message_count
        if statistics.message_count:
            first_ns.append(statistics.message_start_time)
    return (min(first_ns) / NS_PER_S if first_ns else None), messages
