# SPDX-License-Identifier: Apache-2.0
"""The estimators over a bag: records in the order of the log go into the pipelines of the live nodes.

Nothing is computed here; a replay is deterministic and equals what nodes that miss no message publish. Its estimates
may become a table: one row for each sample, with those of all three estimators.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Protocol, TypeAlias

import numpy as np

from trainid_ros.bag.reader import PROGRESS_EVERY, BagReader, LoggedRecord, require_topics
from trainid_ros.estimators.pipeline import Consistency, EstimatorPipeline, PipelineGroup
from trainid_ros.interface.files import new_place
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    NS_PER_S,
    OUTPUT_TOPICS,
    SPEED,
    SPEED_TOPIC,
    OutputTopic,
    Row,
    output_topic,
    output_values,
    record_of,
)
from trainid_ros.interface.results import (
    AdhesionEstimate,
    BrakeRateEstimate,
    EstimateT,
    Output,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
    counters,
    deviations,
    parameters,
    quantities,
)
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings, brake_findings, force_findings, wheel_findings
from trainid_ros.train.effects import effect_value

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from trainid_ros.bag.types import RecordTable
    from trainid_ros.inputs.mapping import Mapping
    from trainid_ros.setup.params_file import Setup
    from trainid_ros.stream.sample_stream import Contradiction
    from trainid_ros.train.train_file import TrainFile

AnyOutput = (
    Output[ResistanceEstimate] | Output[SpeedModelEstimate] | Output[BrakeRateEstimate] | Output[AdhesionEstimate]
)


class Observer(Protocol):
    """Receives all inputs and outputs of a replay, in order."""

    def on_record(self, entry: LoggedRecord) -> None:
        """Receive an input before the estimators do."""

    def on_output(self, output: AnyOutput, log_ns: int) -> None:
        """Receive an output and the log time [ns] of the input that completed its sample."""


@dataclass(frozen=True, slots=True)
class Result(Generic[EstimateT]):
    """State of one estimator at the end of a replay."""

    prior: EstimateT  # Estimate before the first record
    output: Output[EstimateT]  # Last output
    samples: int  # Aligned samples since the last reset
    # Why records and samples were not used, with their counts, the most frequent reason first
    rejections: tuple[tuple[Reason, int], ...]
    statuses: tuple[int, ...]  # Number of outputs by status since the last reset
    resets: int  # Number of resets after a backward jump of the stamps
    consistency: Consistency  # Whether errors agree with the stated uncertainty, over the last samples used
    # Why the estimate is CONVERGING although its standard deviation is small enough, else empty
    why_converging: str = ''


@dataclass(frozen=True, slots=True)
class Replay:
    """The outcome of a replay."""

    records: int  # Number of inputs read
    duration_s: float  # Time covered by the samples
    resistance: Result[ResistanceEstimate]
    speed_model: Result[SpeedModelEstimate]
    brake_rate: Result[BrakeRateEstimate]
    adhesion: Output[AdhesionEstimate]  # Last output
    contradiction: Contradiction  # The last contradiction between the inputs, if there was one
    brake_findings: tuple[str, ...] = ()  # What is wrong with the brake of the train file
    # Measured over true speed by distances from stop to stop, and its standard deviation [1]; None if there was none
    wheel_ratio: tuple[float, float] | None = None
    stated_ratio: float = 1.0  # The same as the effect ``wheel_diameter`` of the train file states it [1]

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong with the wheels, the force, its stamps and the brake of the train file."""
        # Distances by a speed that was wrong for a part of the drive say nothing of the wheels.
        was_wrong = SPEED_TOPIC.name in self.contradiction.inputs and not math.isnan(self.contradiction.end_s)
        ratio = None if was_wrong else self.wheel_ratio
        of_wheels = wheel_findings(*ratio, self.stated_ratio) if ratio else ()
        return (*of_wheels, *force_findings(self.resistance.output.estimate), *self.brake_findings)

    def why_no_resistance(self) -> str:
        """Return why nothing was learned of the resistance, with the most frequent rejection; '' if it was."""
        result = self.resistance
        output = result.output
        if output.used and output.estimate.speed_max > 0.0:
            return ''
        text = f'nothing was learned of the resistance: {result.samples} samples, {output.used} used'
        if self.contradiction.finding:
            return f'{text}; {self.contradiction.text}'
        if result.rejections:
            reason, count = result.rejections[0]
            text += f', most often rejected: {reason.name} ({count} times), last: {output.last_rejection}'
        return text


class Pipelines(NamedTuple):
    """The three estimators, before the first record."""

    resistance: EstimatorPipeline[ResistanceEstimate]
    speed_model: EstimatorPipeline[SpeedModelEstimate]
    brake_rate: EstimatorPipeline[BrakeRateEstimate]

    @classmethod
    def of(cls, train_file: TrainFile, settings: EstimatorSettings) -> Pipelines:
        """Return those of a train file and settings."""
        return cls(*(kind.pipeline(train_file, settings) for kind in KINDS))

    @classmethod
    def of_nodes(cls, setups: Iterable[Setup], mapping: Mapping, states: Iterable[str] = ()) -> Pipelines:
        """Return those of nodes that read a mapping, from saved states; '' is the prior. InputError if one is unfit."""
        made: list[EstimatorPipeline[Any]] = [setup.pipeline(mapping.alignment) for setup in setups]
        for pipeline, state in zip(made, states, strict=False):
            if state:
                pipeline.restore(state)
        return cls(*made)


class Odometer:
    """Compares distances by the speed with those by the position, from stop to stop: the error of the wheel diameter.

    Positions corrected by balises or at platforms do not depend on the wheels. Where they are integrated from the same
    wheels, the ratio is one and says nothing. Tables of records come in the order of the log.
    """

    def __init__(self) -> None:
        self._rest = math.nan  # position at the last stop [m]
        self._driven = self._speed = 0.0
        self._stamp_ns = 0
        self._ratios: list[tuple[float, float]] = []

    def add(self, table: RecordTable) -> None:
        """Take in records; others than speeds do not count."""
        chosen = np.flatnonzero(table.topic == SPEED)
        if not chosen.size:
            return
        stamp_ns, speed, position = table.stamp_ns[chosen], np.abs(table.x[chosen]), table.y[chosen]
        gap = np.diff(stamp_ns, prepend=self._stamp_ns or stamp_ns[0]) / NS_PER_S
        before = np.concatenate(([self._speed], speed[:-1]))
        # A leg with a gap of two seconds has no known distance.
        steps = np.where((gap >= 0.0) & (gap < 2.0), 0.5 * (before + speed) * gap, math.nan)
        self._stamp_ns, self._speed = int(stamp_ns[-1]), float(speed[-1])
        standing = speed < 0.05  # m/s
        # Pieces that start where the train stops or departs.
        edges = np.flatnonzero(np.diff(standing)) + 1
        for first, end in zip([0, *edges.tolist()], [*edges.tolist(), speed.size], strict=True):
            if standing[first]:
                self._driven += float(steps[first])  # the last step before the stop
                self._arrive(float(position[end - 1]))
            else:
                self._driven += float(steps[first:end].sum())

    def _arrive(self, position: float) -> None:
        """Close a leg at a stop; positions are corrected while the train stands, so the last one counts."""
        leg = abs(position - self._rest)
        # From 200 m the error of a stop is below 1 %. Beyond a ratio of 20 % a unit is wrong, or the positions are not
        # those of the train.
        if self._driven > 0.0 and leg > 200.0 and abs(self._driven / leg - 1.0) < 0.2:
            self._ratios.append((self._driven / leg, leg))
        self._rest, self._driven = position, 0.0

    @property
    def ratio(self) -> tuple[float, float] | None:
        """Mean ratio and its standard deviation, None if there was no leg."""
        if not self._ratios:
            return None
        ratio, leg = np.array(self._ratios).T
        weight = leg * leg
        mean = float(np.average(ratio, weights=weight))
        # Std of the distance between two stops, by balises, overshoot and slip: 1 m.
        stated = 1.0 / math.sqrt(float(weight.sum()))
        scatter = float(np.average((ratio - mean) ** 2, weights=weight)) / max(1, ratio.size - 1)
        return mean, math.hypot(stated, math.sqrt(scatter))


def replay_through(
    pipelines: Pipelines,
    reader: BagReader,
    progress: Callable[[float], None] | None = None,
    observers: Sequence[Observer] = (),
    duration_s: float = math.inf,
) -> Replay:
    """Run the three estimators over an open bag, or the first ``duration_s`` of it by log time [s].

    ``progress`` is called with the number of inputs read since its last call. Observers receive inputs and outputs;
    nothing else is kept, so memory does not grow with the bag. InputError if a required topic has no messages, or the
    bag cannot be read.
    """
    require_topics(reader)
    group, records, log_ns = PipelineGroup(pipelines), 0, 0
    start_ns, _ = reader.time_range() or (0, 0)
    end_ns = math.inf if math.isinf(duration_s) else start_ns + round(duration_s * NS_PER_S)
    odometer, named = Odometer(), reader.mapping.named

    def observed(table: RecordTable) -> Iterator[Row]:
        """Yield the rows, each after the observers have received it."""
        nonlocal log_ns
        for log_ns, row in zip(table.log_ns.tolist(), table.rows(), strict=True):
            entry = LoggedRecord(log_ns, INPUT_TOPICS[row[0]].name, record_of(*row))
            for observer in observers:
                observer.on_record(entry)
            yield row

    def rows_of(table: RecordTable) -> Iterator[Row]:
        odometer.add(table)
        return observed(table) if observers else table.rows()

    def publish(output: AnyOutput) -> None:
        for observer in observers:
            observer.on_output(output, log_ns)

    rows = chain.from_iterable(map(rows_of, reader.tables(end_ns)))
    while count := group.push_rows(islice(rows, PROGRESS_EVERY), publish if observers else None):
        records += count
        if progress is not None:
            progress(count)
    last = group.contradiction
    last.finding, last.inputs = named(last.finding), tuple(map(named, last.inputs))
    resistance, speed_model, brake = pipelines
    results = (_result(resistance, named), _result(speed_model, named), _result(brake, named))
    findings = tuple(map(named, brake_findings(brake)))
    stated = effect_value(resistance.stream.config.train_file.effects, 'wheel_diameter', 'ratio', 1.0)
    return Replay(records, group.covered_s, *results, brake.adhesion(), last, findings, odometer.ratio, stated)


def _result(of: EstimatorPipeline[EstimateT], named: Callable[[str], str]) -> Result[EstimateT]:
    rejections, statuses = tuple(of.rejections.most_common()), tuple(of.statuses)
    why_converging = named(of.why_converging)
    return Result(of.prior, of.current(), of.samples, rejections, statuses, of.resets, of.consistency, why_converging)


TABLE_SUFFIXES: Final = ('.parquet', '.csv')
TableRow: TypeAlias = list[Any]
"""Stamp [ns], then the cells of the other columns; None where an estimator has no estimate at this stamp."""
_COVARIANCE: Final = 'covariance'


class TableColumn(NamedTuple):
    """A column."""

    topic: str  # Topic that it holds
    field: str  # Field of its messages
    unit: str  # Unit, '' without

    @property
    def name(self) -> str:
        """Name of the estimator and the field, such as ``resistance_a``."""
        return f'{self.topic.rpartition("/")[2]}_{self.field}'


def _columns(topic: OutputTopic) -> Iterator[TableColumn]:
    """Yield the fields of an estimate, with the standard deviations before their covariance, and the counters."""
    units: dict[str, str] = {}
    for name, quantity in quantities(topic.estimate).items():
        if name == _COVARIANCE:
            units |= {f'{parameter}_std': units[parameter] for parameter in parameters(topic.estimate)}
        units[name] = quantity.unit
    units |= dict.fromkeys(('status', *counters(topic.estimate), 'last_reject_reason'), '')
    return (TableColumn(topic.name, name, unit) for name, unit in units.items())


COLUMNS: Final = tuple(column for topic in OUTPUT_TOPICS for column in _columns(topic))
"""All columns but the time."""


class EstimateTable:
    """Observer of a replay that writes a row for each stamp."""

    def __init__(self, write: Callable[[Sequence[TableRow]], None]) -> None:
        self._write = write
        self._open: dict[int, dict[str, dict[str, Any]]] = {}
        self._rows: list[TableRow] = []

    def on_record(self, entry: object) -> None:
        """Receive an input, which the table does not hold."""

    def on_output(self, output: Output[Any], log_ns: int) -> None:  # noqa: ARG002 - rows have stamps
        """Take an estimate."""
        topic = output_topic(output.estimate).name
        self._open.setdefault(output.stamp_ns, {})[topic] = _values(output)
        while self._open:
            stamp_ns, estimates = next(iter(self._open.items()))
            # Estimators whose settings differ may give their estimates of one sample some messages apart.
            if len(estimates) < len(OUTPUT_TOPICS) and len(self._open) <= 200:
                return
            self._close_row(stamp_ns)

    def finish(self) -> None:
        """Write what is left."""
        for stamp_ns in list(self._open):
            self._close_row(stamp_ns)
        self._write(self._rows)

    def _close_row(self, stamp_ns: int) -> None:
        estimates = self._open.pop(stamp_ns)
        self._rows.append([stamp_ns, *(estimates.get(column.topic, {}).get(column.field) for column in COLUMNS)])
        if len(self._rows) >= 5000:
            self._write(self._rows)
            self._rows = []


def _values(output: Output[Any]) -> dict[str, Any]:
    """Return the fields of an estimate with standard deviations; status and reason as words."""
    values: dict[str, Any] = output_values(output)
    values['status'] = Status(values['status']).name
    values['last_reject_reason'] = Reason(values['last_reject_reason']).name
    stds = zip(parameters(type(output.estimate)), deviations(values.get(_COVARIANCE, ())), strict=True)
    return values | {f'{name}_std': std for name, std in stds}


@contextmanager
def _csv_file(path: Path) -> Iterator[Callable[[Sequence[TableRow]], None]]:
    """Open a CSV file: dates and times in ISO 8601, units in the names; covariances are left out."""
    places = [place for place, column in enumerate(COLUMNS, 1) if column.field != _COVARIANCE]
    named = (COLUMNS[place - 1] for place in places)

    def write(rows: Sequence[TableRow]) -> None:
        for row in rows:
            writer.writerow([f'{np.datetime64(row[0], "ns")}Z', *(_cell(row[place]) for place in places)])

    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(['time', *(f'{item.name} [{item.unit}]' if item.unit else item.name for item in named)])
        yield write


def _cell(value: Any) -> Any:
    return '' if value is None or (isinstance(value, float) and math.isnan(value)) else value


@contextmanager
def _parquet_file(path: Path) -> Iterator[Callable[[Sequence[TableRow]], None]]:
    """Open a Parquet file, with units in the metadata of the fields and a group of rows for each call."""
    import pyarrow as pa  # noqa: PLC0415 - an optional package
    from pyarrow import parquet  # noqa: PLC0415

    words, count = pa.dictionary(pa.int8(), pa.string()), pa.uint64()
    types = {_COVARIANCE: pa.list_(pa.float64()), 'status': words, 'last_reject_reason': words}
    types |= {'observable': pa.bool_(), 'slipping': pa.bool_()}
    types |= {name: count for topic in OUTPUT_TOPICS for name in counters(topic.estimate)}
    columns = [
        pa.field(item.name, types.get(item.field, pa.float64()), metadata={'unit': item.unit} if item.unit else None)
        for item in COLUMNS
    ]
    schema = pa.schema([pa.field('time', pa.timestamp('ns', tz='UTC')), *columns])

    def write(rows: Sequence[TableRow]) -> None:
        if rows:
            cells = zip(*rows, strict=True)
            arrays = [pa.array(column, field.type) for column, field in zip(cells, schema, strict=True)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))

    with parquet.ParquetWriter(path, schema) as writer:
        yield write


@contextmanager
def estimate_table(path: Path) -> Iterator[EstimateTable]:
    """Write a table, Parquet or CSV by its suffix, there once the block ends without error; InputError if it exists."""
    opened = _csv_file if path.suffix == '.csv' else _parquet_file
    with new_place(path) as part, opened(part) as write:
        table = EstimateTable(write)
        yield table
        table.finish()
