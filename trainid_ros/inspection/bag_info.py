# SPDX-License-Identifier: Apache-2.0
"""Inspect the contents of a bag, and check that the estimators can use it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.bag.reader import BagReader, in_namespaces, in_two, missing_topics
from trainid_ros.bag.record_file import MAX_CHUNK
from trainid_ros.bag.record_table import EMPTY, joined
from trainid_ros.inspection.input_check import Findings, check_inputs
from trainid_ros.interface.records import (
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    MASS_TOPIC,
    NS_PER_S,
    REQUIRED_TOPICS,
    SPEED_TOPIC,
)
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.topic_track import ONE_LOST

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from trainid_ros.bag.record_table import RecordTable
    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.inputs.mapping import Mapping
    from trainid_ros.interface.records import InputTopic
    from trainid_ros.train.train_file import TrainFile

GAP_S: Final = 1.0
MOVING_SPEED: Final = 0.1  # m/s
_INT64_MAX: Final = 2**63 - 1  # log times are unsigned
# Brake commands of which so many differ from the one before are published on change.
_CHANGING: Final = 0.9
_FEWEST_CHANGES: Final = 3
# Distances by speed and by position are compared from this distance on [m], and may differ by this share [1]. A larger
# step of the position is a correction [m].
_MIN_DISTANCE_M: Final = 500.0
_DISTANCE_ERROR: Final = 0.05
_CORRECTION_M: Final = 100.0
_KMH: Final = 3.6
_SLOWEST_S: Final = AlignmentConfig().max_interval
_REQUIRED: Final = tuple(topic.name for topic in REQUIRED_TOPICS)


class _Quantity(NamedTuple):
    """A field of an input topic whose range is reported."""

    topic: str
    field: str
    unit: str


_QUANTITIES: Final = (
    _Quantity(SPEED_TOPIC.name, 'speed', 'm/s'),
    _Quantity(SPEED_TOPIC.name, 'position', 'm'),
    _Quantity(FORCE_TOPIC.name, 'force', 'N'),
    _Quantity(GRADIENT_TOPIC.name, 'gradient', 'per mille'),
    _Quantity(GRADIENT_TOPIC.name, 'curve_radius', 'm'),
    _Quantity(BRAKE_TOPIC.name, 'target_acceleration', 'm/s^2'),
    _Quantity(MASS_TOPIC.name, 'mass', 'kg'),
)
# By the interface an unknown position is NaN, which is not a fault.
_MAY_BE_NAN: Final = frozenset({(SPEED_TOPIC.name, 'position')})


@dataclass(frozen=True, slots=True)
class StampInfo:
    """The stamps of one input topic."""

    rate: float  # Median rate [Hz], NaN below two messages
    first_ns: int  # Smallest stamp that is not zero [ns]
    last_ns: int  # Largest stamp [ns]
    gaps: int  # Number of pauses longer than one second, 2.5 intervals, and the time that a value holds
    longest_gap_s: float  # Longest pause [s]
    out_of_order: int  # Messages older than one before them
    duplicates: int  # Messages that repeat an earlier stamp
    zero: int  # Messages with a zero stamp
    log_offset_s: float  # Median of log time minus stamp [s]


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic; ``stamps`` is None for topics that are not an input or have no messages."""

    name: str
    type: str
    count: int
    not_finite: int
    stamps: StampInfo | None


@dataclass(frozen=True, slots=True)
class ValueRange:
    """Smallest and largest finite value of a field in its unit, NaN if there is none."""

    topic: str
    field: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class BagInfo:
    """Contents of a bag."""

    path: str  # The bag
    duration_s: float  # From the first to the last log time [s]
    messages: int  # Number of messages on all topics
    topics: tuple[TopicInfo, ...]  # All topics by name
    ranges: tuple[ValueRange, ...]  # Ranges of the input values
    moving_share: float  # Share of the time with the train moving [1], NaN if unknown
    braking_share: float  # Share of the time with a brake command [1], NaN if unknown
    missing: tuple[str, ...]  # Required topics without messages
    problems: tuple[str, ...]  # Why the bag cannot be used; empty if it can
    warnings: tuple[str, ...]  # Faults that the estimators will reject or bridge

    @property
    def usable(self) -> bool:
        """True if the estimators can use the bag."""
        return not self.problems


class _Column:
    """Stamps, log times and values of one input topic, and how long a value holds [s]."""

    def __init__(self, topic: InputTopic, table: RecordTable, hold_s: float, end_ns: int) -> None:
        self.hold_s = hold_s
        self.end_ns = end_ns
        numbers = [item.name for item in fields(topic.record) if item.type in {'float', float}]
        self.stamps = table.stamp_ns
        self.logs = np.minimum(table.log_ns, _INT64_MAX).astype(np.int64)
        self._values = dict(zip(numbers, (table.x, table.y), strict=False))

    def values(self, name: str) -> NDArray[np.float64]:
        return self._values[name]

    def not_finite(self, topic: str) -> int:
        """Return the number of messages with a value that is not finite although it must be."""
        names = [name for name in self._values if (topic, name) not in _MAY_BE_NAN]
        columns = [~np.isfinite(self.values(name)) for name in names]
        return int(np.count_nonzero(np.logical_or.reduce(columns)))


def inspect(
    path: str | Path,
    namespace: str = '/',
    max_chunk: int = MAX_CHUNK,
    inputs: Callable[[], MappedInputs] | None = None,
    train_file: TrainFile | None = None,
    advance: Callable[[float], None] = lambda _: None,
) -> BagInfo:
    """Read a bag once and summarise its contents.

    Args:
        path: Rosbag2 directory, ``.mcap`` or ``.db3`` file.
        namespace: Namespace of the topics.
        max_chunk: Largest chunk to unpack [bytes].
        inputs: Makes what turns messages of other topics into records; they are then summarised as our own topics.
        train_file: The train, if it is known: units, signs and gradients are then checked as in a replay.
        advance: Called with the share that was read since its last call [1].

    Raises:
        InputError: If the bag cannot be read.
    """
    opening, reading = in_two(advance)
    with BagReader(path, namespace, max_chunk, inputs, opening=opening) as reader:
        table = joined(tuple(_read(reader, reading)) or (EMPTY,))
        alignment = reader.mapping.alignment(AlignmentConfig())
        columns = _columns(table, alignment)
        missing = missing_topics(reader)
        topics = (*_topics(reader, columns), *_mapped(reader.mapping, columns))
        first, last = reader.time_range() or (0, 0)
        moving = _share(columns, SPEED_TOPIC.name, 'speed')
        problems = _problems(topics, missing, moving)
        findings = Findings((), ()) if problems else check_inputs(table.rows(), alignment, train_file)
        return BagInfo(
            path=str(path),
            duration_s=(last - first) / NS_PER_S,
            messages=reader.message_count,
            topics=topics,
            ranges=tuple(_range(columns, item) for item in _QUANTITIES if item.topic in columns),
            moving_share=moving,
            braking_share=_share(columns, BRAKE_TOPIC.name, 'target_acceleration'),
            missing=missing,
            problems=(*problems, *map(reader.mapping.named, findings.problems)),
            warnings=(
                *reader.warnings,
                *(line for topic in topics for line in _topic_warnings(topic)),
                *_distance_warnings(columns.get(SPEED_TOPIC.name)),
                *_command_warnings(columns.get(BRAKE_TOPIC.name)),
                *map(reader.mapping.named, findings.warnings),
            ),
        )


def _read(reader: BagReader, advance: Callable[[float], None]) -> Iterator[RecordTable]:
    """Yield the tables of a bag; a mapping may make more or fewer records than there are messages."""
    left, count = 1.0, max(reader.input_count, 1)
    for table in reader.tables():
        share = min(left, len(table) / count)
        left -= share
        advance(share)
        yield table
    advance(left)


def _columns(table: RecordTable, alignment: AlignmentConfig) -> dict[str, _Column]:
    rows = {topic: np.flatnonzero(table.topic == number) for number, topic in enumerate(INPUT_TOPICS)}
    # A mass holds until the next one, whenever that comes.
    holds = {BRAKE_TOPIC: alignment.command_hold or GAP_S, MASS_TOPIC: math.inf}
    end_ns = int(table.stamp_ns.max(initial=0))
    return {
        topic.name: _Column(topic, table[mine], holds.get(topic, GAP_S), end_ns)
        for topic, mine in rows.items()
        if mine.size
    }


def _topics(reader: BagReader, columns: dict[str, _Column]) -> Iterator[TopicInfo]:
    """Yield the topics of a bag; those that a mapping replaces are not read."""
    for topic in reader.topics():
        details = (0, None) if topic.name in reader.mapping.replaced else _details(topic.name, columns)
        yield TopicInfo(topic.name, topic.type, topic.count, *details)


def _mapped(mapping: Mapping, columns: dict[str, _Column]) -> Iterator[TopicInfo]:
    """Yield the inputs that come from other topics."""
    for topic in INPUT_TOPICS:
        if topic.name in mapping.replaced:
            count = columns[topic.name].stamps.size if topic.name in columns else 0
            origin = ' + '.join(mapping.needed(topic.name)) or 'the line'
            yield TopicInfo(topic.name, f'from {origin}', count, *_details(topic.name, columns))


def _details(name: str, columns: dict[str, _Column]) -> tuple[int, StampInfo | None]:
    column = columns.get(name)
    return (0, None) if column is None else (column.not_finite(name), _stamp_info(column))


def _stamp_info(column: _Column) -> StampInfo:
    stamps, logs = column.stamps, column.logs
    stamped = stamps[stamps != 0]
    ordered = np.sort(stamped)
    steps = np.diff(ordered)
    steps = steps[steps > 0] / NS_PER_S
    newest = np.maximum.accumulate(stamped)
    usual_s = _median(steps) if steps.size else 0.0
    return StampInfo(
        rate=1.0 / usual_s if steps.size else float('nan'),
        first_ns=int(ordered[0]) if ordered.size else 0,
        last_ns=int(ordered[-1]) if ordered.size else 0,
        gaps=int(np.count_nonzero(steps > max(column.hold_s, ONE_LOST * usual_s))),
        longest_gap_s=float(steps.max()) if steps.size else 0.0,
        out_of_order=int(np.count_nonzero(stamped < newest)),
        duplicates=max(0, int(stamped.size - steps.size) - 1),
        zero=int(stamps.size - stamped.size),
        log_offset_s=_median(logs - stamps) / NS_PER_S,
    )


def _median(values: NDArray[np.float64] | NDArray[np.int64]) -> float:
    """Return the median; that of NumPy takes 20 ms to load."""
    ordered = np.sort(values)
    return 0.5 * (float(ordered[(ordered.size - 1) // 2]) + float(ordered[ordered.size // 2]))


def _range(columns: dict[str, _Column], item: _Quantity) -> ValueRange:
    values = columns[item.topic].values(item.field)
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (float('nan'),) * 2
    return ValueRange(item.topic, item.field, item.unit, low, high)


def _share(columns: dict[str, _Column], topic: str, name: str) -> float:
    """Return the share of time in which a value is not zero; a message holds until the next, for a time at most."""
    if topic not in columns:
        return float('nan')
    column = columns[topic]
    order = np.argsort(column.stamps, kind='stable')
    stamps, values = column.stamps[order], np.abs(column.values(name)[order])
    if column.hold_s > GAP_S:  # declared, so it is known of the last message too
        stamps = np.append(stamps, column.end_ns)
    held = np.clip(np.diff(stamps) / NS_PER_S, 0.0, column.hold_s)
    active = values[: held.size] > (MOVING_SPEED if name == 'speed' else 0.0)
    total = float(held.sum())
    return float(held[active].sum()) / total if total > 0.0 else float('nan')


def _problems(topics: tuple[TopicInfo, ...], missing: tuple[str, ...], moving: float) -> list[str]:
    if missing:
        where = in_namespaces(topic.name for topic in topics if topic.count)
        return [f'no messages on {", ".join(missing)}{f" ({where})" if where else ""}']
    required = {topic.name: topic for topic in topics if topic.name in _REQUIRED}
    problems = [f'{name}: no message can be used' for name, topic in required.items() if not _has_usable(topic)]
    spans = [topic.stamps for topic in required.values() if topic.stamps is not None and _has_usable(topic)]
    if not problems and max(span.first_ns for span in spans) > min(span.last_ns for span in spans):
        problems.append('the stamps of the required topics do not overlap')
    if not moving > 0.0:
        problems.append('the train does not move')
    problems += [
        f'{name}: comes every {1.0 / topic.stamps.rate:.3g} s, and slower than {_SLOWEST_S:g} s is not used'
        for name, topic in required.items()
        if name != BRAKE_TOPIC.name and topic.stamps is not None and topic.stamps.rate * _SLOWEST_S < 1.0
    ]
    return problems


def _has_usable(topic: TopicInfo) -> bool:
    return topic.stamps is not None and topic.not_finite < topic.count and topic.stamps.zero < topic.count


def _command_warnings(column: _Column | None) -> list[str]:
    """Say so where brake commands come only when they change."""
    if column is None or column.hold_s > GAP_S or column.stamps.size < _FEWEST_CHANGES:
        return []
    order = np.argsort(column.stamps, kind='stable')
    changes = np.diff(column.values('target_acceleration')[order]) != 0.0
    longest_s = float(np.diff(column.stamps[order]).max()) / NS_PER_S
    if np.mean(changes) < _CHANGING or longest_s <= AlignmentConfig().command_timeout:
        return []
    return [
        f'{BRAKE_TOPIC.name}: published only on change: set alignment.command_hold to the longest time that a command '
        f'holds, here {longest_s:.0f} s or more'
    ]


def _distance_warnings(column: _Column | None) -> list[str]:
    """Say so where distances by the speed are not those of the positions: another unit, or another wheel diameter."""
    if column is None:
        return []
    order = np.argsort(column.stamps, kind='stable')
    speed, position = column.values('speed')[order], column.values('position')[order]
    elapsed = np.diff(column.stamps[order]) / NS_PER_S
    by_speed, by_position = 0.5 * (speed[:-1] + speed[1:]) * elapsed, np.abs(np.diff(position))
    # Positions are unknown, or corrected at a balise.
    known = (elapsed > 0.0) & (elapsed < GAP_S) & np.isfinite(by_speed + by_position) & (by_position < _CORRECTION_M)
    distance = float(by_position[known].sum())
    if distance < _MIN_DISTANCE_M or abs(ratio := float(by_speed[known].sum()) / distance - 1.0) < _DISTANCE_ERROR:
        return []
    unit = ', so it looks like km/h' if abs(ratio + 1.0 - _KMH) < _DISTANCE_ERROR * _KMH else ''
    return [f'{SPEED_TOPIC.name}: {ratio + 1.0:.2f} times as fast as its positions change{unit}']


def _topic_warnings(topic: TopicInfo) -> list[str]:
    if (stamps := topic.stamps) is None:
        return []
    found = (
        (topic.not_finite, 'messages with a value that is not finite'),
        (stamps.gaps, f'gaps, the longest {stamps.longest_gap_s:.1f} s'),
        (stamps.out_of_order, 'messages out of order'),
        (stamps.duplicates, 'messages with a repeated stamp'),
        (stamps.zero, 'messages with a zero stamp'),
    )
    return [f'{topic.name}: {count} {what}' for count, what in found if count]
