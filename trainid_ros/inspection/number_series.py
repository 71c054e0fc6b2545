# SPDX-License-Identifier: Apache-2.0
"""All numbers in the messages of a bag over time, whatever their topics and types."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.bag.reader import BagReader, in_two
from trainid_ros.bag.types import WIDE_CHARACTERS, full_type
from trainid_ros.inputs.mapping import Mapping, Signal, Source, Unit
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, stamp_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from trainid_ros.bag.types import StoredType

LONGEST_S: Final = 3600.0
"""Part of a bag that is read [s]."""
# Of a topic with more messages in the bag, each k-th is read.
_MAX_SAMPLES: Final = 20_000
# Larger messages are images and the like [bytes].
_LARGEST: Final = 4096
_LONGEST_ARRAY: Final = 8
_MAX_FIELDS: Final = 64
_PACKAGE: Final = 'trainid_msgs/'
_TYPE: Final = re.compile(r'[a-z][a-z0-9_]*/msg/[A-Za-z0-9]+')
_IMAGES: Final = ('Image', 'CompressedImage', 'PointCloud2', 'LaserScan', 'OccupancyGrid', 'CompressedVideo')
# Our own topics are not read, and their types not checked.
_NONE: Final = Signal(())
_NOTHING: Final = Mapping(speed=_NONE, force=_NONE, gradient=_NONE, brake_command=_NONE, mass=_NONE)


@dataclass(frozen=True, slots=True)
class NumberSeries:
    """One number of the messages of one topic over time."""

    topic: str  # Name of the topic, relative in a namespace
    type: str  # Message type
    field: str  # Path to the number, as in a mapping
    time: NDArray[np.float64]  # Stamps, from the first log time of the bag on [s], shape (n,)
    value: NDArray[np.float64]  # The numbers, shape (n,)
    has_stamps: bool  # Whether the stamps are of headers; if not, they are log times
    is_whole: bool  # Whether the type of the field is that of whole numbers

    @property
    def rate(self) -> float:
        """Median rate [Hz], NaN for a single message."""
        steps = np.diff(np.unique(self.time))
        return 1.0 / float(np.median(steps)) if steps.size else float('nan')


@dataclass(frozen=True, slots=True)
class BagNumbers:
    """The numbers of a bag."""

    # All numbers that are not zero throughout; values that are not finite are left out
    series: tuple[NumberSeries, ...]
    own: frozenset[str]  # Names of our input topics that are there, with our types; their numbers are among the series
    trains: tuple[str, ...]  # Other namespaces that hold our topics with our types
    left_out: tuple[tuple[str, str], ...]  # Topics that are not read, with the reason
    duration_s: float  # Length of the part that was read [s]


def read_numbers(
    path: Path, namespace: str, max_chunk: int, advance: Callable[[float], None] = lambda _: None
) -> BagNumbers:
    """Read the first hour of a bag.

    Args:
        path: Rosbag2 directory, ``.mcap`` or ``.db3`` file.
        namespace: Namespace of the topics; without one all are read.
        max_chunk: Largest chunk to unpack [bytes].
        advance: Called with the share that was read since its last call [1].

    Raises:
        InputError: The bag cannot be read.
    """
    opening, reading = in_two(advance)
    with BagReader(path, namespace, max_chunk, mapping=_NOTHING, opening=opening) as reader:
        topics, span = reader.topics(), reader.time_range() or (0, 0)
    ours = {topic.name: full_type(topic.message) for topic in INPUT_TOPICS}
    is_root = not namespace.strip('/')
    own, wanted, left_out = set(), {}, []
    trains = {train for topic in topics if topic.count and (train := _train_of(topic.name, topic.type))}
    for topic in topics:
        is_own, name = topic.type == ours.get(topic.name), f'/{topic.name}' if is_root else topic.name
        is_elsewhere = topic.name[0] == '/' and not is_root
        if not topic.count or is_elsewhere or (topic.type.startswith(_PACKAGE) and not is_own):
            continue
        if is_own:
            own.add(name)
        if not _TYPE.fullmatch(topic.type) or topic.type.rpartition('/')[2] in _IMAGES:
            left_out.append((name, topic.type or 'no type'))
        else:
            wanted[name] = topic.count
    readable = _readable(path, namespace, max_chunk, wanted)
    left_out += [(name, 'its definition cannot be read') for name in wanted if name not in readable]
    collectors = {name: _Collector(name, max(1, wanted[name] // _MAX_SAMPLES)) for name in readable}
    end_ns = min(span[1], span[0] + round(LONGEST_S * NS_PER_S))
    with BagReader(path, namespace, max_chunk, mapping=_naming(readable)) as reader:
        _collect(reader, collectors, span[0], end_ns, reading)
    left_out += [(item.topic, 'large messages') for item in collectors.values() if item.is_large]
    series = tuple(item for collector in collectors.values() for item in collector.series(span[0]))
    return BagNumbers(series, frozenset(own), tuple(sorted(trains)), tuple(left_out), (end_ns - span[0]) / NS_PER_S)


def _train_of(name: str, kind: str) -> str:
    """Return the namespace of one of our topics outside the given one, '' if it is none."""
    for topic in INPUT_TOPICS:
        if name.endswith(f'/{topic.name}') and kind == full_type(topic.message):
            return f'/{name.removesuffix(topic.name).strip("/")}'
    return ''


def _naming(topics: Iterable[str]) -> Mapping:
    """Return a mapping that names topics, and none of our own."""
    sources = tuple(Source(name, ('data',), Unit('', 1.0)) for name in topics)
    return replace(_NOTHING, speed=Signal(sources))


def _readable(path: Path, namespace: str, max_chunk: int, topics: Iterable[str]) -> list[str]:
    """Return the topics whose definitions can be read."""

    def opens(names: list[str]) -> bool:
        try:
            with BagReader(path, namespace, max_chunk, mapping=_naming(names)) as reader:
                reader.mapped_types()
        except InputError:
            return False
        return True

    names = list(topics)
    return names if opens(names) else [name for name in names if opens([name])]


def _collect(
    reader: BagReader, collectors: dict[str, _Collector], first_ns: int, end_ns: int, advance: Callable[[float], None]
) -> None:
    kinds, done_ns, whole_ns = reader.mapped_types(), first_ns, max(end_ns - first_ns, 1)
    for log_ns, topic, payload in reader.stored():
        if log_ns > end_ns:
            return
        if log_ns - done_ns > whole_ns // 50:
            advance((log_ns - done_ns) / whole_ns)
            done_ns = log_ns
        if isinstance(payload, bytes):
            collectors[topic].add(log_ns, payload, kinds[topic])


class _Collector:
    """The numbers of one topic."""

    def __init__(self, topic: str, every: int) -> None:
        self.topic = topic
        self.is_large = False
        self._every = every
        self._count = 0
        self._type = ''
        self._paths: list[tuple[str | int, ...]] = []
        self._whole: list[bool] = []
        self._rows: list[tuple[int, int, list[float]]] = []

    def add(self, log_ns: int, payload: bytes, kind: StoredType) -> None:
        """Take in a message."""
        from rosbags.serde import SerdeError  # noqa: PLC0415 - rarely needed

        self._count += 1
        if self.is_large or (self._count - 1) % self._every:
            return
        if len(payload) > _LARGEST:
            self.is_large = True
            return
        try:
            message = kind.decode(payload)
        except SerdeError:
            return
        if not self._rows:
            self._type = kind.name
            leaves = list(_leaves(message))[:_MAX_FIELDS]
            self._paths, self._whole = [path for path, _ in leaves], [whole for _, whole in leaves]
        stamp_ns = stamp_of(message) if hasattr(message, 'header') else 0
        try:
            self._rows.append((stamp_ns, log_ns, [_number(message, path) for path in self._paths]))
        except IndexError:  # an array that has become shorter
            return

    def series(self, first_ns: int) -> Iterator[NumberSeries]:
        """Yield the numbers, with times since a log time [ns]."""
        if not self._rows or self.is_large:
            return
        stamps = np.array([row[:2] for row in self._rows], dtype=np.int64)
        has_stamps = bool(np.all(stamps[:, 0] > 0))
        time = (stamps[:, 0 if has_stamps else 1] - first_ns) / NS_PER_S
        order = np.argsort(time, kind='stable')
        values = np.array([row[2] for row in self._rows], dtype=np.float64).reshape(len(self._rows), -1)
        for place, path in enumerate(self._paths):
            column = values[order, place]
            known = np.isfinite(column)
            if np.any(column[known] != 0.0):
                where = self.topic, self._type, '.'.join(map(str, path))
                yield NumberSeries(*where, time[order][known], column[known], has_stamps, self._whole[place])


def _leaves(part: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], bool]]:
    """Yield the paths to the numbers of a message, each with whether it is a whole one."""
    if isinstance(part, np.ndarray):
        if part.size <= _LONGEST_ARRAY and part.dtype.kind in 'iuf':
            yield from (((*path, k), part.dtype.kind != 'f') for k in range(part.size))
    elif is_dataclass(part):
        for item in fields(part):
            if item.name not in {'header', 'stamp', WIDE_CHARACTERS} and 'covariance' not in item.name:
                yield from _leaves(getattr(part, item.name), (*path, item.name))
    elif isinstance(part, int | float):
        yield path, isinstance(part, int)


def _number(message: Any, path: tuple[str | int, ...]) -> float:
    for step in path:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    return float(message)
