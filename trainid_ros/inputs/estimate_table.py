# SPDX-License-Identifier: Apache-2.0
"""Estimates of a replay as a table: one row for each sample, with the estimates of all three estimators."""

from __future__ import annotations

import csv
import math
import os
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, OUTPUT_TOPICS, OutputTopic, output_topic, output_values
from trainid_ros.interface.results import Output, Reason, Status, deviations, parameters, quantities

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path


TABLE_SUFFIXES: Final = ('.parquet', '.csv')
Row: TypeAlias = 'list[Any]'
"""Stamp [ns], then the cells of the other columns; None where an estimator has no estimate at this stamp."""
_COVARIANCE: Final = 'covariance'


@dataclass(frozen=True, slots=True)
class TableColumn:
    """A column: topic and field it holds, and its unit, '' without."""

    topic: str
    field: str
    unit: str

    @property
    def name(self) -> str:
        """Name of the estimator and the field, such as ``resistance_a``."""
        return f'{self.topic.rpartition("/")[2]}_{self.field}'


def _columns(topic: OutputTopic) -> Iterator[TableColumn]:
    """Yield the fields of an estimate, with the standard deviations before their covariance, and the counters."""
    known = quantities(topic.estimate)
    for name, quantity in known.items():
        if name == _COVARIANCE:
            for parameter in parameters(topic.estimate):
                yield TableColumn(topic.name, f'{parameter}_std', known[parameter].unit)
        yield TableColumn(topic.name, name, quantity.unit)
    for name in ('status', 'used', 'rejected', 'last_reject_reason'):
        yield TableColumn(topic.name, name, '')


COLUMNS: Final = tuple(column for topic in OUTPUT_TOPICS for column in _columns(topic))
"""All columns but the time."""


class _Sink(Protocol):
    def write(self, rows: Sequence[Row]) -> None: ...

    def close(self) -> None: ...


class EstimateTable:
    """Observer of a replay that writes a row for each stamp."""

    def __init__(self, sink: _Sink) -> None:
        self._sink = sink
        self._open: dict[int, dict[str, dict[str, Any]]] = {}
        self._rows: list[Row] = []

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
        self._sink.write(self._rows)

    def _close_row(self, stamp_ns: int) -> None:
        estimates = self._open.pop(stamp_ns)
        self._rows.append([stamp_ns, *(estimates.get(column.topic, {}).get(column.field) for column in COLUMNS)])
        if len(self._rows) >= 5000:
            self._sink.write(self._rows)
            self._rows = []


def _values(output: Output[Any]) -> dict[str, Any]:
    """Return the fields of an estimate with standard deviations; status and reason as words."""
    values: dict[str, Any] = output_values(output)
    values['status'] = Status(values['status']).name
    values['last_reject_reason'] = Reason(values['last_reject_reason']).name
    if names := parameters(type(output.estimate)):
        stds = deviations(values[_COVARIANCE])
        values |= {f'{name}_std': std for name, std in zip(names, stds, strict=True)}
    return values


class _CsvSink:
    """A CSV file: dates and times in ISO 8601, units in the names; covariances are left out."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('w', encoding='utf-8', newline='')
        self._writer = csv.writer(self._file, lineterminator='\n')
        self._places = [place for place, column in enumerate(COLUMNS, 1) if column.field != _COVARIANCE]
        named = (COLUMNS[place - 1] for place in self._places)
        self._writer.writerow(['time', *(f'{item.name} [{item.unit}]' if item.unit else item.name for item in named)])

    def write(self, rows: Sequence[Row]) -> None:
        for row in rows:
            seconds, rest = divmod(row[0], NS_PER_S)
            time = f'{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z'
            self._writer.writerow([time, *(_cell(row[place]) for place in self._places)])

    def close(self) -> None:
        self._file.close()


def _cell(value: Any) -> Any:
    return '' if value is None or (isinstance(value, float) and math.isnan(value)) else value


class _ParquetSink:
    """A Parquet file, with units in the metadata of the fields and a group of rows for each call."""

    def __init__(self, path: Path) -> None:
        import pyarrow as pa  # noqa: PLC0415 - an optional package
        from pyarrow import parquet  # noqa: PLC0415

        words, count = pa.dictionary(pa.int8(), pa.string()), pa.uint64()
        types = {_COVARIANCE: pa.list_(pa.float64()), 'status': words, 'last_reject_reason': words}
        types |= {'used': count, 'rejected': count, 'observable': pa.bool_()}
        columns = [
            pa.field(
                item.name, types.get(item.field, pa.float64()), metadata={'unit': item.unit} if item.unit else None
            )
            for item in COLUMNS
        ]
        self._schema = pa.schema([pa.field('time', pa.timestamp('ns', tz='UTC')), *columns])
        self._writer = parquet.ParquetWriter(path, self._schema)

    def write(self, rows: Sequence[Row]) -> None:
        if rows:
            import pyarrow as pa  # noqa: PLC0415

            cells = zip(*rows, strict=True)
            arrays = [pa.array(column, field.type) for column, field in zip(cells, self._schema, strict=True)]
            self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        self._writer.close()


@contextmanager
def estimate_table(path: Path) -> Iterator[EstimateTable]:
    """Write a table, Parquet or CSV by the suffix of its path, which is there once the block ends without an error.

    InputError if the file exists already.
    """
    if path.exists() or path.is_symlink():
        raise InputError(f'{path}: exists already and is not overwritten')
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        sink: _Sink = _CsvSink(part) if path.suffix == '.csv' else _ParquetSink(part)
        try:
            table = EstimateTable(sink)
            yield table
            table.finish()
        finally:
            sink.close()
        part.rename(path)
    finally:
        part.unlink(missing_ok=True)
