# SPDX-License-Identifier: Apache-2.0
"""All numbers in the messages of a bag over time, whatever their topics and types, and what they may be.

Names of topics, fields and columns say something of the quantity in them, and of its unit.

The balance of forces tells which number is what, and in which unit:

    (1 + gamma) M dv/dt = F - M g (w(v) + i) / 1000

The slope of the acceleration over a force is 1 / ((1 + gamma) M) in its unit, over a gradient -g / (1 + gamma) / 1000.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from trainid_ros.bag.reader import BagReader, in_two
from trainid_ros.bag.types import PACKAGE, WIDE_CHARACTERS, StoredType, full_type
from trainid_ros.inputs.mapping import RAW, Mapping, Signal, Source
from trainid_ros.inputs.table_files import bare
from trainid_ros.inputs.units import written_unit
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, stamp_of
from trainid_ros.stream.alignment import AlignmentConfig

Array: TypeAlias = NDArray[np.float64]
MAX_S: Final = 3600.0  # part of a bag that is read [s]
_MAX_SAMPLES: Final = 20_000  # of a topic with more messages, each k-th is read


@dataclass(frozen=True, slots=True)
class NumberSeries:
    """One number of the messages of one topic over time."""

    topic: str  # Name of the topic, relative in a namespace; '' for a column of a table
    type: str  # Message type, or the unit that a table states
    field: str  # Path to the number, as in a mapping, or name of the column
    time: NDArray[np.float64]  # Stamps, from the first log time of the bag on [s], shape (n,)
    value: NDArray[np.float64]  # The numbers, shape (n,)
    has_stamps: bool  # Whether the stamps are of headers; if not, they are log times
    is_whole: bool  # Whether the type of the field is that of whole numbers

    @property
    def name(self) -> str:
        """Topic and field."""
        return f'{self.topic} {self.field}'.lstrip()

    @property
    def source(self) -> str:
        """Topic, or the column of a table."""
        return self.topic or self.field

    @property
    def rate(self) -> float:
        """Median rate [Hz], NaN for a single message."""
        steps = np.diff(np.unique(self.time))
        return 1.0 / float(np.median(steps)) if steps.size else math.nan


@dataclass(frozen=True, slots=True)
class BagNumbers:
    """The numbers of a bag or a table."""

    # All numbers that are not zero throughout; values that are not finite are left out
    series: tuple[NumberSeries, ...]
    own: frozenset[str]  # Names of our input topics that are there, with our types; their numbers are among the series
    trains: tuple[str, ...]  # Other namespaces that hold our topics with our types
    left_out: tuple[tuple[str, str], ...]  # Topics that are not read, with the reason
    duration_s: float  # Length of the part that was read [s]


def read_numbers(
    path: Path, namespace: str, max_chunk: int, advance: Callable[[float], None] = lambda _: None
) -> BagNumbers:
    """Read the first hour of a bag; InputError if it cannot be read.

    Arguments are those of :class:`BagReader`; without a namespace all topics are read. ``advance`` is called with the
    share that was read since its last call [1].
    """
    opening, reading = in_two(advance)
    with BagReader(path, namespace, max_chunk, mapping=_naming(()), opening=opening) as reader:
        topics, span = reader.topics(), reader.time_range() or (0, 0)
    ours = {topic.name: full_type(topic.message) for topic in INPUT_TOPICS}
    is_root = not namespace.strip('/')
    own, wanted, left_out = set(), {}, []
    images = {'Image', 'CompressedImage', 'PointCloud2', 'LaserScan', 'OccupancyGrid', 'CompressedVideo'}
    trains = {  # namespaces of our topics outside the given one
        f'/{topic.name.removesuffix(name).strip("/")}'
        for topic in topics
        for name, kind in ours.items()
        if topic.count and topic.type == kind and topic.name.endswith(f'/{name}')
    }
    for topic in topics:
        is_own, name = topic.type == ours.get(topic.name), f'/{topic.name}' if is_root else topic.name
        is_elsewhere = topic.name[0] == '/' and not is_root
        if not topic.count or is_elsewhere or (topic.type.startswith(f'{PACKAGE}/') and not is_own):
            continue
        if is_own:
            own.add(name)
        is_message = re.fullmatch(r'[a-z][a-z0-9_]*/msg/[A-Za-z0-9]+', topic.type)
        if not is_message or topic.type.rpartition('/')[2] in images:
            left_out.append((name, topic.type or 'no type'))
        else:
            wanted[name] = topic.count
    readable = _readable(path, namespace, max_chunk, [*wanted])
    left_out += [(name, 'its definition cannot be read') for name in wanted if name not in readable]
    collectors = {name: _Collector(name, max(1, wanted[name] // _MAX_SAMPLES)) for name in readable}
    end_ns = min(span[1], span[0] + round(MAX_S * NS_PER_S))
    with BagReader(path, namespace, max_chunk, mapping=_naming(readable)) as reader:
        _collect(reader, collectors, span[0], end_ns, reading)
    left_out += [(item.topic, 'large messages') for item in collectors.values() if item.is_large]
    series = tuple(item for collector in collectors.values() for item in collector.series(span[0]))
    return BagNumbers(series, frozenset(own), tuple(sorted(trains)), tuple(left_out), (end_ns - span[0]) / NS_PER_S)


def _naming(topics: Iterable[str]) -> Mapping:
    """Return a mapping that names topics; our own are not read, and their types not checked."""
    none, named = Signal(()), Signal(tuple(Source(name, ('data',), RAW) for name in topics))
    return Mapping(speed=named, force=none, gradient=none, brake_command=none, mass=none)


def _readable(path: Path, namespace: str, max_chunk: int, topics: list[str]) -> list[str]:
    try:
        with BagReader(path, namespace, max_chunk, mapping=_naming(topics)) as reader:
            reader.mapped_types()
    except InputError:
        one_by_one = [[name] for name in topics] if len(topics) > 1 else []
        return [name for one in one_by_one for name in _readable(path, namespace, max_chunk, one)]
    return topics


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
    def __init__(self, topic: str, every: int) -> None:
        self.topic = topic
        self.is_large = False
        self._every = every
        self._count = 0
        self._type = ''
        self._sources: list[tuple[Source, bool]] = []  # each with whether its numbers are whole
        self._rows: list[tuple[int, int, list[float]]] = []

    def add(self, log_ns: int, payload: bytes, kind: StoredType) -> None:
        from rosbags.serde import SerdeError  # noqa: PLC0415 - rarely needed

        self._count += 1
        if self.is_large or (self._count - 1) % self._every:
            return
        if len(payload) > 4096:  # images and the like
            self.is_large = True
            return
        try:
            message = kind.decode(payload)
        except SerdeError:
            return
        if not self._rows:
            self._type = kind.name
            leaves = islice(_leaves(message), 64)
            self._sources = [(Source(self.topic, path, RAW), is_whole) for path, is_whole in leaves]
        stamp_ns = stamp_of(message) if hasattr(message, 'header') else 0
        with suppress(InputError):  # of an array that has become shorter
            self._rows.append((stamp_ns, log_ns, [source.raw(message) for source, _ in self._sources]))

    def series(self, first_ns: int) -> Iterator[NumberSeries]:
        """Yield the numbers, with times since a log time [ns]."""
        if not self._rows or self.is_large:
            return
        stamps = np.array([row[:2] for row in self._rows], dtype=np.int64)
        has_stamps = bool(np.all(stamps[:, 0] > 0))
        time = (stamps[:, 0 if has_stamps else 1] - first_ns) / NS_PER_S
        order = np.argsort(time, kind='stable')
        values = np.array([row[2] for row in self._rows], dtype=np.float64).reshape(len(self._rows), -1)
        for place, (source, is_whole) in enumerate(self._sources):
            column = values[order, place]
            known = np.isfinite(column)
            if np.any(column[known] != 0.0):
                times, numbers = time[order][known], column[known]
                yield NumberSeries(self.topic, self._type, source.field, times, numbers, has_stamps, is_whole)


def _leaves(part: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], bool]]:
    """Yield the paths to the numbers of a message, each with whether it is a whole one."""
    if isinstance(part, np.ndarray):
        if part.size <= 8 and part.dtype.kind in 'iuf':
            yield from (((*path, k), part.dtype.kind != 'f') for k in range(part.size))
    elif is_dataclass(part):
        for item in fields(part):
            if item.name not in {'header', 'stamp', WIDE_CHARACTERS} and 'covariance' not in item.name:
                yield from _leaves(getattr(part, item.name), (*path, item.name))
    elif isinstance(part, int | float):
        yield path, isinstance(part, int)


USUAL_ROTARY: Final = 0.08
"""Share by which rotating masses raise the inertia of a usual train [1]."""
PER_MILLE: Final = {'per_mille': 1.0, 'percent': 10.0, 'deg': 1000.0 * math.pi / 180.0, 'rad': 1000.0}
"""Per mille in each unit of a gradient."""
STEP_S: Final = 0.2
"""Interval of the common times [s]."""
_HALF: Final = 5  # half of the time over which a derivative is taken [steps]
_MAX_GAP_S: Final = 1.5  # values farther apart are not interpolated [s], and slower series are held
MIN_NUMBERS: Final = 50
"""Fewest numbers that show anything."""
# Changes of a position are compared with the distance over so much time, at least [s], and at most.
_SPAN_S: Final = (8.0, 900.0)
_BEFORE: Final = 10  # positions that show the direction of travel


def common_times(speed: NumberSeries) -> Array:
    """Return the times at which all series are compared with a speed [s], shape (n,)."""
    return np.arange(speed.time[0], speed.time[-1], STEP_S)


def at_times(series: NumberSeries, times: Array) -> Array:
    """Return the numbers at times [s], shape (n,): interpolated, NaN in gaps; whole and rare ones are held."""
    after = np.searchsorted(series.time, times, side='right')
    before = np.clip(after - 1, 0, series.time.size - 1)
    if series.is_whole or not series.rate > 1.0 / _MAX_GAP_S:
        return np.where(after > 0, series.value[before], math.nan)
    values = np.interp(times, series.time, series.value, left=math.nan, right=math.nan)
    gap = series.time[np.clip(after, 0, series.time.size - 1)] - series.time[before]
    return np.where(gap > _MAX_GAP_S, math.nan, values)


def derivative(values: Array) -> Array:
    """Return the change per second of values at common times, shape (n,); NaN at the ends."""
    slope = np.full_like(values, math.nan)
    slope[_HALF:-_HALF] = (values[2 * _HALF :] - values[: -2 * _HALF]) / (2 * _HALF * STEP_S)
    return slope


def correlation(x: Array, y: Array) -> float:
    """Return the correlation of two series where both are known [1]; 0 for too few numbers."""
    known = np.isfinite(x) & np.isfinite(y)
    if np.count_nonzero(known) < MIN_NUMBERS or np.ptp(x[known]) == 0.0 or np.ptp(y[known]) == 0.0:
        return 0.0
    return float(np.corrcoef(x[known], y[known])[0, 1])


def comes_on_change(time: Array, command: Array) -> bool:
    """Return whether commands at times [s] are published on change: most differ from the one before, after pauses."""
    changes = np.mean(np.diff(command) != 0.0) >= 0.9
    return bool(changes and np.diff(time).max() > AlignmentConfig().command_timeout)


class Travel(NamedTuple):
    """A position compared with the integral of a speed."""

    correlation: float  # Correlation of their changes [1]
    ratio: float  # Change of the position for each unit of the speed and second


def compare_travel(speed: NumberSeries, position: NumberSeries) -> Travel:
    """Compare changes of a position with the integral of a speed, between its stamps."""
    distance = _travelled(speed)
    inside = (position.time >= speed.time[0]) & (position.time <= speed.time[-1]) & np.isfinite(position.value)
    time, value = position.time[inside], position.value[inside]
    none = Travel(0.0, math.nan)
    if time.size == 0:
        return none
    bins = np.floor((time - time[0]) / _SPAN_S[0])
    first = np.concatenate(([True], np.diff(bins) > 0.0))
    time, value = time[first], value[first]
    gone, elapsed = np.diff(np.interp(time, speed.time, distance)), np.diff(time)
    change = np.abs(np.diff(value))
    usable = (elapsed < _SPAN_S[1]) & (gone > 0.0)
    if np.count_nonzero(usable) < _HALF or not change[usable].any():
        return none
    # Positions are set anew now and then.
    usual = float(np.median(change[usable] / gone[usable]))
    usable &= np.abs(change - usual * gone) <= 0.3 * usual * gone + 1e-3 * float(change[usable].max())
    if np.count_nonzero(usable) < _HALF or np.ptp(gone[usable]) == 0.0 or np.ptp(change[usable]) == 0.0:
        return none
    share = float(np.mean(usable[gone > 0.0]))
    ratio = float(change[usable] @ gone[usable]) / float(gone[usable] @ gone[usable])
    return Travel(float(np.corrcoef(gone[usable], change[usable])[0, 1]) * share, ratio)


def _travelled(speed: NumberSeries) -> Array:
    """Return the integral of a speed at its stamps, in its unit times s, shape (n,)."""
    steps = np.diff(speed.time)
    mean = 0.5 * (np.abs(speed.value[1:]) + np.abs(speed.value[:-1]))
    return np.concatenate(([0.0], np.cumsum(np.where(steps < _SPAN_S[0], mean * steps, 0.0))))


def jumps(speed: NumberSeries, position: NumberSeries, ratio: float, least: float) -> list[tuple[float, float]]:
    """Return where a position jumps by ``least`` or more while the train runs, and by how much, as kilometre posts do.

    All are in its unit, ``ratio`` of it for each unit of the speed and second. As in a mapping, they are those of a
    train on which positions rise; what is passed several times counts once.
    """
    run, elapsed = np.diff(np.interp(position.time, speed.time, _travelled(speed))), np.diff(position.time)
    change, found = np.diff(position.value), list[tuple[float, float]]()
    is_far = np.abs(np.abs(change) - ratio * run) >= least
    for k in np.flatnonzero(is_far & (run > 0.0) & (elapsed < _SPAN_S[0])).tolist():
        is_rising = float(np.sum(np.sign(change[max(0, k - _BEFORE) : k]))) >= 0.0
        at = float(position.value[k] if is_rising else position.value[k + 1])
        by = float(change[k] if is_rising else -change[k]) - ratio * float(run[k])
        if abs(by) >= least and not any(abs(at - known) < abs(by) for known, _ in found):
            found.append((at, by))
    return sorted(found)


class Fit(NamedTuple):
    """A regression."""

    slopes: tuple[float, ...]  # Coefficients of the regressors
    share: float  # Explained share of the variance [1]


def regress(y: Array, columns: Sequence[Array], moving: NDArray[np.bool_]) -> Fit | None:
    """Return the regression of y on columns and a constant, where all are known and the train moves; None if nowhere.

    All are of shape (n,).
    """
    known = np.isfinite(y) & moving
    for column in columns:
        known &= np.isfinite(column)
    if np.count_nonzero(known) < MIN_NUMBERS:
        return None
    design = np.column_stack([*(column[known] for column in columns), np.ones(np.count_nonzero(known))])
    scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
    slopes, *_ = np.linalg.lstsq(design / scale, y[known], rcond=1e-9)
    variance = float(np.var(y[known]))
    rest = float(np.mean((y[known] - design / scale @ slopes) ** 2))
    return Fit(tuple((slopes / scale)[:-1].tolist()), 1.0 - rest / variance if variance > 0.0 else 0.0)


class Slope(NamedTuple):
    """How one series follows another one apart from further series."""

    value: float  # Slope
    std: float  # Its standard deviation
    spread: float  # Standard deviation of the other series that the further ones do not explain
    share: float  # Share of the variance beside the further ones that the slope explains [1]


def partial_slope(y: Array, x: Array, others: Sequence[Array], time: Array) -> Slope | None:
    """Return the slope of y over x beside others and a constant; None where x does not change apart from them.

    All are of shape (n,). Residuals that are near in ``time`` [s], which does not fall, are not independent.
    """
    design = np.column_stack([*others, np.ones(y.size)])
    design /= np.maximum(np.abs(design).max(axis=0), 1e-300)
    both = np.column_stack([y, x])
    rest_y, rest_x = (both - design @ np.linalg.lstsq(design, both, rcond=1e-9)[0]).T
    square = float(rest_x @ rest_x)
    if square <= 1e-9 * float(x @ x):
        return None
    slope = float(rest_x @ rest_y) / square
    rest = rest_y - slope * rest_x
    # Residuals over 20 s may be alike, as in a gust.
    sums = np.bincount(np.floor(time / 20.0).astype(np.intp), weights=rest_x * rest)
    std = math.sqrt(float(sums @ sums) * sums.size / max(sums.size - 1, 1)) / square
    explained = slope * slope * square
    share = explained / total if (total := explained + float(rest @ rest)) > 0.0 else 0.0
    return Slope(slope, std, math.sqrt(square / y.size), share)


def is_near(size: float, expected: float) -> bool:
    """Return whether a slope may be another one, as slopes of regressions are exact: to a factor of 1.6."""
    return abs(math.log(size / expected)) < math.log(1.6)


def nearest_unit(size: float, units: dict[str, float]) -> str:
    """Return the unit with a factor near a slope, '' if none is."""
    name = min(units, key=lambda item: abs(math.log(size / units[item])))
    return name if is_near(size, units[name]) else ''


# Words in names that speak for a quantity.
_WORDS: Final = {quantity: frozenset(words.split()) for quantity, words in {
    'speed': 'speed velocity vel twist odo odom tacho kmh kph mph geschwindigkeit vitesse v 速度 车速',
    'position': 'position pos distance dist odometer chainage location where mileage milepost kilometer km weg strecke'
    ' kilometrierung pk 里程 位置 公里标 距离',
    'force': 'force effort traction tractive wrench thrust kn te zugkraft bremskraft kraft 牵引力 制动力',
    'gradient': 'gradient grade slope incline inclination permille steigung neigung pente déclivité rampe 坡度',
    'brake_command': 'brake braking notch decel deceleration handle bremse bremsstufe bremsvorgabe'
    ' bremsanforderung bremsstellung frein freinage 制动 制动级位',
    'mass': 'mass load weight payload masse zugmasse fahrzeugmasse gewicht charge 质量 载重 重量',
    'acceleration': 'acceleration accel acc beschleunigung accélération 加速度',
    'time': 'time timestamp stamp utc t zeit uhrzeit zeitstempel temps heure horodatage date datum 时间 时刻',
}.items()}  # fmt: skip
_LETTERS: Final = {'s': 'position', 'x': 'position', 'f': 'force', 'i': 'gradient', 'm': 'mass', 'a': 'acceleration'}
"""Symbols that are the whole name of a column."""
# Words of other measurements.
_OTHER: Final = frozenset(
    {'temperature', 'temp', 'voltage', 'volt', 'current', 'ampere', 'pressure', 'humidity', 'battery', 'fuel'}
    | {'angular', 'orientation', 'latitude', 'longitude', 'altitude', 'heading', 'yaw', 'roll', 'rpm', 'torque'}
    | {'lat', 'lon', 'long', 'height', 'bearing', 'sats', 'engine', 'throttle'}
)
# Words of a speed that is demanded or allowed, or of statistics.
_DEMANDS: Final = frozenset(
    {'target', 'limit', 'permitted', 'setpoint', 'soll', 'sollgeschwindigkeit', 'consigne', 'average', 'mean', 'max'}
    | {'目标速度', '目标', '限速', '限制速度'}
)
# Words that are parts of longer ones, the longest first.
_PARTS: Final = re.compile(
    '|'.join(sorted((word for word in _DEMANDS.union(*_WORDS.values()) if len(word) > 5 or ord(word[0]) > 0x2E80),
                    key=len, reverse=True))
)  # fmt: skip
_NUMBERS: Final = re.compile(r'\d+|(?<![a-z])(?:front|rear|left|right|leading|trailing|[a-f])(?![a-z])')


def words_of(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case: ``/car1/tractionForce_kN`` has car, 1, traction, force and kn."""
    text = re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', name.replace('kN', 'kn').replace('km/h', 'kmh')).lower()
    text = re.sub(r'km_?(?:per_?)?h(?![a-z])', 'kmh', text).replace('per_mille', 'permille')
    words = re.findall(r'[^\W\d_]+|\d+', text)
    return tuple(dict.fromkeys((*(word for word in words if ord(word[0]) < 0x2E80), *_PARTS.findall(text))))


def score(quantity: str, topic: str, field: str) -> float:
    """Return how much a name says for a quantity [1]: up to 1 for the topic and for the field, less for other words."""
    known, topic_words, field_words = _WORDS[quantity], words_of(topic), words_of(field)
    points = float(not known.isdisjoint(topic_words)) + float(not known.isdisjoint(field_words))
    if not topic and _LETTERS.get(bare(field).rstrip('0123456789').lower()) == quantity:
        points += 1.0
    words = {*topic_words, *field_words}
    is_across = not words.isdisjoint({'y', 'z', 'w', 'lateral', 'vertical', 'vert'})  # a component across the train
    is_demand = quantity != 'brake_command' and not words.isdisjoint(_DEMANDS)
    return points - 2.0 * (not _OTHER.isdisjoint(words)) - 0.5 * is_across - 0.5 * is_demand


def is_nameless(series: NumberSeries) -> bool:
    """Return whether a name speaks for no quantity."""
    return all(score(quantity, series.topic, series.field) == 0.0 for quantity in _WORDS)


def unit_in(series: NumberSeries, quantity: str) -> str:
    """Return the unit of a quantity that the file or the name states; '' if they state none."""
    texts = (series.type, *reversed(words_of(series.name)))
    return next((unit for text in texts if (unit := written_unit(text, quantity))), '')


def family(topic: str) -> str:
    """Return a topic without the marks of alike ones, such as the numbers of motor cars."""
    return _NUMBERS.sub('#', topic.lower())
