# SPDX-License-Identifier: Apache-2.0
"""Contents of a bag, and whether the estimators can use it: topics, stamps, ranges, units and signs.

Whether the inputs fit together shows in the samples that a replay makes of them. With a train file the checks are those
of a replay. Without one the mass, and so the unit of a force, is not known, but forces must still go with the
acceleration, and gradients slow the train as such in per mille do: while no brake acts, the mean acceleration over some
seconds is

    (1 + gamma) dv/dt = p F - g k i / 1000 - (a + b v + c v^2)

The regression leaves gain p of the force and resistance free, so that neither mass nor train file is needed. The slope
k is about 1 if the gradient i is in per mille, and 10 if it is in per cent. Nothing is said unless the gradient
explains a good part of what force and speed leave: on a flat line, or with much noise, its unit does not show.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_ros.bag.mcap_file import MAX_CHUNK
from trainid_ros.bag.reader import BagReader, in_namespaces, in_two, missing_topics
from trainid_ros.bag.types import EMPTY, RecordTable, joined
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inspection.number_series import (
    PER_MILLE,
    USUAL_ROTARY,
    comes_on_change,
    is_near,
    nearest_unit,
    partial_slope,
)
from trainid_ros.interface.records import (
    BRAKE,
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    KM_H,
    MASS_TOPIC,
    NS_PER_S,
    REQUIRED_TOPICS,
    SPEED_TOPIC,
    InputTopic,
    Row,
)
from trainid_ros.interface.results import Reason
from trainid_ros.interface.scalars import find_fault
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.sample_stream import Contradiction, SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.stream.topic_track import ONE_LOST
from trainid_ros.train.forces import G
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import Davis, Train, TrainFile

_GAP_S: Final = 1.0  # time that a value holds, unless it is known
_MAX_DISTANCE_ERROR: Final = 0.05  # share by which distances by speed and by position may differ [1]
_MAX_OPPOSITE: Final = -0.5  # correlation of a force whose sign is wrong [1]
_UNITS: Final = {
    'speed': 'm/s', 'position': 'm', 'force': 'N', 'gradient': 'per mille', 'curve_radius': 'm',
    'target_acceleration': 'm/s^2', 'mass': 'kg',
}  # fmt: skip
"""Units of the fields of the inputs."""


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
        numbers = [item.name for item in fields(topic.record) if item.name in _UNITS]
        self.stamps = table.stamp_ns
        self.logs = np.minimum(table.log_ns, 2**63 - 1).astype(np.int64)  # log times are unsigned
        self.values = dict(zip(numbers, (table.x, table.y), strict=False))

    def ordered(self, *names: str) -> tuple[NDArray[Any], ...]:
        """Return the stamps [ns] in their order and the values of some fields at them, each of shape (n,)."""
        order = np.argsort(self.stamps, kind='stable')
        return self.stamps[order], *(self.values[name][order] for name in names)

    def not_finite(self) -> int:
        """Return the number of messages with a value that is not finite; by the interface a position may be NaN."""
        columns = [~np.isfinite(values) for name, values in self.values.items() if name != 'position']
        return int(np.count_nonzero(np.logical_or.reduce(columns)))


def inspect(
    path: str | Path,
    namespace: str = '/',
    max_chunk: int = MAX_CHUNK,
    inputs: Callable[[], MappedInputs] | None = None,
    train_file: TrainFile | None = None,
    advance: Callable[[float], None] = lambda _: None,
) -> BagInfo:
    """Read a bag once and summarise its contents; InputError if it cannot be read.

    ``path``, ``namespace``, ``max_chunk`` and ``inputs`` are those of :class:`BagReader`; mapped inputs are summarised
    as our own topics. With a ``train_file`` units, signs and gradients are checked as in a replay. ``advance`` is
    called with the share that was read since its last call [1].
    """
    opening, reading = in_two(advance)
    with BagReader(path, namespace, max_chunk, inputs, opening=opening) as reader:
        table = joined(tuple(_read(reader, reading)) or (EMPTY,))
        alignment = reader.mapping.alignment(AlignmentConfig())
        columns = _columns(table, alignment)
        missing = missing_topics(reader)
        topics = tuple(_topics(reader, columns))
        first, last = reader.time_range() or (0, 0)
        moving = _share(columns, SPEED_TOPIC.name, 'speed')
        problems = _problems(topics, missing, moving)
        findings = Findings((), ()) if problems else check_inputs(table.rows(), alignment, train_file)
        return BagInfo(
            path=str(path),
            duration_s=(last - first) / NS_PER_S,
            messages=reader.message_count,
            topics=topics,
            ranges=tuple(_ranges(columns)),
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
    holds = {BRAKE_TOPIC: alignment.command_hold or _GAP_S, MASS_TOPIC: math.inf}
    end_ns = int(table.stamp_ns.max(initial=0))
    return {
        topic.name: _Column(topic, table[mine], holds.get(topic, _GAP_S), end_ns)
        for topic, mine in rows.items()
        if mine.size
    }


def _topics(reader: BagReader, columns: dict[str, _Column]) -> Iterator[TopicInfo]:
    """Yield the topics of a bag, and the inputs that a mapping makes of others."""
    details = {name: (column.not_finite(), _stamp_info(column)) for name, column in columns.items()}
    mapping, unknown = reader.mapping, (0, None)
    for topic in reader.topics():
        known = unknown if topic.name in mapping.replaced else details.get(topic.name, unknown)
        yield TopicInfo(topic.name, topic.type, topic.count, *known)
    for name in (topic.name for topic in INPUT_TOPICS if topic.name in mapping.replaced):
        count = columns[name].stamps.size if name in columns else 0
        yield TopicInfo(name, f'from {mapping.origin(name)}', count, *details.get(name, unknown))


def _stamp_info(column: _Column) -> StampInfo:
    stamps, logs = column.stamps, column.logs
    stamped = stamps[stamps != 0]
    ordered = np.sort(stamped)
    steps = np.diff(ordered)
    steps = steps[steps > 0] / NS_PER_S
    newest = np.maximum.accumulate(stamped)
    usual_s = _median(steps) if steps.size else 0.0
    return StampInfo(
        rate=1.0 / usual_s if steps.size else math.nan,
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


def _ranges(columns: dict[str, _Column]) -> Iterator[ValueRange]:
    for topic, column in columns.items():
        for field, values in column.values.items():
            finite = values[np.isfinite(values)]
            low, high = (float(finite.min()), float(finite.max())) if finite.size else (math.nan, math.nan)
            yield ValueRange(topic, field, _UNITS[field], low, high)


def _share(columns: dict[str, _Column], topic: str, name: str) -> float:
    """Return the share of time in which a value is not zero; a message holds until the next, for a time at most."""
    if topic not in columns:
        return math.nan
    column = columns[topic]
    stamps, values = column.ordered(name)
    if column.hold_s > _GAP_S:  # declared, so it is known of the last message too
        stamps = np.append(stamps, column.end_ns)
    held = np.clip(np.diff(stamps) / NS_PER_S, 0.0, column.hold_s)
    active = np.abs(values[: held.size]) > (0.1 if name == 'speed' else 0.0)  # m/s, so that noise is no motion
    total = float(held.sum())
    return float(held[active].sum()) / total if total > 0.0 else math.nan


def _problems(topics: tuple[TopicInfo, ...], missing: tuple[str, ...], moving: float) -> list[str]:
    if missing:
        where = in_namespaces(topic.name for topic in topics if topic.count)
        return [f'no messages on {", ".join(missing)}{f" ({where})" if where else ""}']
    names = {topic.name for topic in REQUIRED_TOPICS}
    required = {topic.name: topic for topic in topics if topic.name in names}
    problems = [f'{name}: no message can be used' for name, topic in required.items() if not _has_usable(topic)]
    spans = [topic.stamps for topic in required.values() if topic.stamps is not None and _has_usable(topic)]
    if not problems and max(span.first_ns for span in spans) > min(span.last_ns for span in spans):
        problems.append('the stamps of the required topics do not overlap')
    if not moving > 0.0:
        problems.append('the train does not move')
    slowest_s = AlignmentConfig().max_interval
    problems += [
        f'{name}: comes every {1.0 / topic.stamps.rate:.3g} s, and slower than {slowest_s:g} s is not used'
        for name, topic in required.items()
        if name != BRAKE_TOPIC.name and topic.stamps is not None and topic.stamps.rate * slowest_s < 1.0
    ]
    return problems


def _has_usable(topic: TopicInfo) -> bool:
    return topic.stamps is not None and topic.not_finite < topic.count and topic.stamps.zero < topic.count


def _command_warnings(column: _Column | None) -> list[str]:
    if column is None or column.hold_s > _GAP_S or column.stamps.size < 3:
        return []
    stamps, command = column.ordered('target_acceleration')
    time = (stamps - stamps[0]) / NS_PER_S
    if not comes_on_change(time, command):
        return []
    longest_s = float(np.diff(time).max())
    return [
        f'{BRAKE_TOPIC.name}: published only on change: set alignment.command_hold to the longest time that a command '
        f'holds, here {longest_s:.0f} s or more'
    ]


def _distance_warnings(column: _Column | None) -> list[str]:
    """Say so where distances by the speed are not those of the positions: another unit, or another wheel diameter."""
    if column is None:
        return []
    stamps, speed, position = column.ordered('speed', 'position')
    elapsed = np.diff(stamps) / NS_PER_S
    by_speed, by_position = 0.5 * (speed[:-1] + speed[1:]) * elapsed, np.abs(np.diff(position))
    # Positions are unknown, or corrected at a balise by 100 m or more.
    known = (elapsed > 0.0) & (elapsed < _GAP_S) & np.isfinite(by_speed + by_position) & (by_position < 100.0)
    distance = float(by_position[known].sum())
    if distance < 500.0 or abs(ratio := float(by_speed[known].sum()) / distance - 1.0) < _MAX_DISTANCE_ERROR:
        return []
    unit = ', so it looks like km/h' if abs(ratio + 1.0 - KM_H) < _MAX_DISTANCE_ERROR * KM_H else ''
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


# Units that a gradient may have instead of per mille, as people call them.
_OTHER_UNITS: Final = {'percent': 'per cent', 'deg': 'degrees', 'rad': 'a ratio or radians'}


class Findings(NamedTuple):
    """Faults of the inputs of a bag."""

    problems: tuple[str, ...]  # Why it cannot be used
    warnings: tuple[str, ...]  # What the estimators leave out


def check_inputs(rows: Iterable[Row], alignment: AlignmentConfig, train_file: TrainFile | None) -> Findings:
    """Return the faults of inputs, rows of numbers by log time; names of topics are our own."""
    check = _Check(alignment, train_file)
    for row in rows:
        check.take(row)
    problems = [*check.signs(), *check.unusable(), *filter(None, [check.gradient.finding()])]
    warnings = [*check.faults(), *check.off_the_line()]
    if (last := check.contradiction).finding:
        (problems if check.is_most(Reason.CONTRADICTION) else warnings).append(last.text)
    return Findings(tuple(problems), tuple(warnings))


def brake_sign(tables: Iterable[RecordTable]) -> str:
    """Say so if brake commands have the wrong sign, '' if they have not."""
    above = below = 0
    for table in tables:
        commands = table.x[table.topic == BRAKE]
        above, below = above + int(np.count_nonzero(commands > 0.0)), below + int(np.count_nonzero(commands < 0.0))
    return _wrong_brake(above) if above and not below else ''


def _wrong_brake(above: int) -> str:
    return (
        f'{BRAKE_TOPIC.name} looks as if it had the wrong sign: all {above} messages that are not 0 are above it, and '
        'target accelerations of a brake are not'
    )


class _GradientCheck:
    """Check of unit and sign of the gradient by the samples of a drive."""

    def __init__(self) -> None:
        # Means over some seconds without brake: time [s], acceleration [m/s^2], gradient as reported [per mille], force
        # by weight [N/kN], speed [m/s] and its square.
        self._blocks: list[list[float]] = []
        self._sums = [0.0] * 6
        self._released_s = 0.0

    def add(self, sample: Sample, before: float, traction: float) -> None:
        """Add a sample in motion that an estimator could use, speed before [m/s], and force by weight [N/kN]."""
        dt, speed = sample.dt, 0.5 * (before + sample.speed)
        self._released_s = 0.0 if sample.brake_command < 0.0 else self._released_s + dt
        values = (1.0, (sample.speed - before) / dt, sample.gradient_mean, traction, speed, speed * speed)
        if self._released_s < 4.0 or not math.isfinite(sum(values)):  # s; a brake acts for a while after its release
            self._sums = [0.0] * 6
            return
        self._sums = [total + dt * value for total, value in zip(self._sums, values, strict=True)]
        if (seconds := self._sums[0]) >= 2.0:  # s, so that noise of the speed matters little
            self._blocks.append([seconds, *(total / seconds for total in self._sums[1:])])
            self._sums = [0.0] * 6

    def interrupt(self) -> None:
        """Take note that samples are missing: a brake may have acted meanwhile."""
        self._released_s, self._sums = 0.0, [0.0] * 6

    def finding(self) -> str:
        """Return the fault of the gradient, '' if there is none, or if it does not show."""
        slope = None
        if len(self._blocks) >= 15:
            seconds, acceleration, gradient, *others = np.array(self._blocks).T
            slope = partial_slope(acceleration, gradient, others, np.cumsum(seconds))
        if slope is None:
            return ''
        scale = -1000.0 * (1.0 + USUAL_ROTARY) / G
        slowed, std = scale * slope.value, abs(scale) * slope.std
        size = abs(slowed)
        # The gradient must explain a good part of the variance, and vary by 1 per mille in its right unit.
        if size < 8.0 * std or slope.share < 0.2 or size * slope.spread < 1.0:
            return ''
        how = f'the train is slowed {slowed:.2g} times as much as by so many per mille'
        sign = ', with the wrong sign' if slowed < 0.0 else ''
        if size - 3.0 * std > 5.0:  # a speed in km/h gives 3.6
            unit = nearest_unit(size, {name: PER_MILLE[name] for name in _OTHER_UNITS})
            what = f'like {_OTHER_UNITS[unit]}' if unit else 'too small'
            return f'{GRADIENT_TOPIC.name} looks {what}{sign}: {how}'
        if is_near(size, 0.1) and slope.spread > 30.0:  # per mille; noise makes slopes small too, but is smaller
            return f'{GRADIENT_TOPIC.name} looks ten times too large{sign}: {how}'
        if sign and is_near(size, 1.0):
            return f'{GRADIENT_TOPIC.name} looks as if it had the wrong sign: the train gains speed uphill'
        return ''


class _Check:
    def __init__(self, alignment: AlignmentConfig, train_file: TrainFile | None) -> None:
        # With any train only checks that do not depend on the train file apply.
        given = train_file or TrainFile(Train(mass=1e9), Davis(0.0, 0.0, 0.0))
        self._known = KnownForce(given)
        self._stream = SampleStream(StreamConfig(given, alignment, rejects_faults=train_file is not None))
        self._line = None if train_file is None else profile_of(train_file)
        self._off_line = 0
        self.contradiction = Contradiction()
        self.gradient = _GradientCheck()
        self._out_of_range: Counter[int] = Counter()
        self._first_out: dict[int, float] = {}
        self._applied = 0
        self._reasons: Counter[Reason] = Counter()
        self._moving = 0
        self._first_ns, self._speed = 0, math.nan
        # Force and acceleration without brake, force and command while braking; one row each.
        self._released: list[tuple[float, float]] = []
        self._braked: list[tuple[float, float]] = []

    def take(self, row: Row) -> None:
        topic, stamp_ns, x, y, _ = row
        fault = find_fault(topic, stamp_ns, x, y)
        if fault is not None and fault.reason is Reason.OUT_OF_RANGE:
            self._out_of_range[topic] += 1
            self._first_out.setdefault(topic, fault.value)
        elif topic == BRAKE and x < 0.0:
            self._applied += 1
        for event in self._stream.push_row(*row):
            if isinstance(event, Sample):
                self._follow(event)

    def _follow(self, sample: Sample) -> None:
        self._first_ns = self._first_ns or sample.stamp_ns
        self.contradiction.follow(self._stream.faults, (sample.stamp_ns - self._first_ns) / NS_PER_S)
        before, self._speed = self._speed, sample.speed
        if sample.speed < 1.0:  # m/s; slower trains may stand or shunt
            self.gradient.interrupt()
            return
        self._moving += 1
        if self._line is not None and (sample.position < self._line.first or sample.position > self._line.last):
            self._off_line += 1
        self._reasons[reason := self._reason(sample)] += 1
        if reason not in {Reason.NONE, Reason.CONTRADICTION} or not math.isfinite(sample.dt + sample.force_mean):
            self.gradient.interrupt()
            return
        self.gradient.add(sample, before, self._known.traction(sample.force_mean, sample))
        if sample.brake_command < 0.0:
            self._braked.append((sample.force_mean, sample.brake_command))
        else:
            acceleration = (sample.speed - before) / sample.dt + G * sample.gradient_mean / 1000.0
            self._released.append((sample.force_mean, acceleration))

    def _reason(self, sample: Sample) -> Reason:
        """Return why no estimator can use a sample, NONE if one can."""
        if sample.rejection is not None:
            return sample.rejection.reason
        if math.isnan(sample.dt):
            return Reason.GAP
        if (rejection := self._known.reject(sample)) is not None:
            return rejection.reason
        return Reason.NONE if math.isfinite(sample.brake_command) else Reason.BRAKE_COMMAND_MISSING

    def is_most(self, reason: Reason) -> bool:
        """Return whether most samples in motion are rejected for a reason."""
        return self._reasons[reason] > 0.5 * self._moving

    def signs(self) -> list[str]:
        """Return which inputs have the wrong sign, by all that was seen."""
        found = []
        if self._first_out.get(BRAKE, 0.0) > 0.0 and not self._applied:
            found.append(_wrong_brake(self._out_of_range[BRAKE]))
        if self.is_most(Reason.CONTRADICTION):
            return found
        if _correlation(self._released) < _MAX_OPPOSITE:
            found.append(f'{FORCE_TOPIC.name} has the wrong sign: it is against the acceleration')
        elif _correlation(self._braked, about_zero=True) < _MAX_OPPOSITE:
            found.append(f'{FORCE_TOPIC.name} drives while {BRAKE_TOPIC.name} brakes: its sign is missing or wrong')
        return found

    def unusable(self) -> list[str]:
        # What is named as a contradiction is not named here.
        used = {Reason.NONE, Reason.CONTRADICTION}
        left_out = Counter({reason: count for reason, count in self._reasons.items() if reason not in used})
        if not left_out or self._reasons[Reason.NONE] >= 0.5 * self._moving:
            return []
        reason, count = left_out.most_common(1)[0]
        return [f'{count} of {self._moving} samples in motion cannot be used: {reason.name}']

    def faults(self) -> list[str]:
        return [
            f'{INPUT_TOPICS[topic].name}: {count} messages out of range, the first with {self._first_out[topic]:.4g}'
            for topic, count in sorted(self._out_of_range.items())
        ]

    def off_the_line(self) -> list[str]:
        """Say so if most positions are not on the line of the train file."""
        if self._line is None or self._off_line <= 0.5 * self._moving:
            return []
        return [
            f'{SPEED_TOPIC.name} has a position off the line of the train file, {self._line.first:.0f} to '
            f'{self._line.last:.0f} m, in {self._off_line} of {self._moving} samples in motion: check origin and unit'
        ]


def _correlation(pairs: list[tuple[float, float]], *, about_zero: bool = False) -> float:
    """Return the correlation of pairs about their means or 0 [1]; 0 where there are few, or one does not change."""
    if len(pairs) < 50:
        return 0.0
    x, y = (column if about_zero else column - column.mean() for column in np.array(pairs).T)
    scale = math.sqrt(float(x @ x) * float(y @ y))
    return float(x @ y) / scale if scale > 0.0 else 0.0
