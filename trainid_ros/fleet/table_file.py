# SPDX-License-Identifier: Apache-2.0
"""The table of a fleet, one row per bag: its columns, and its file as Parquet, with units, or as CSV."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import write_whole
from trainid_ros.interface.results import (
    BrakeRateEstimate,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
    parameters,
    quantities,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from trainid_ros.interface.results import Estimate

Row = dict[str, Any]
"""Values by name of the column; None where a value is not known. Times are in seconds since 1970 (UTC)."""

SPEEDS: Final = (10, 15, 20)
"""Speeds at which the resistance is stated [m/s]."""


class Column(NamedTuple):
    """One column."""

    name: str  # Name
    kind: str  # 'text', 'float', 'int' or 'time'
    unit: str  # Unit, '' for text; '1' for ratios and counts
    text: str  # What it is


def reason_column(reason: Reason) -> str:
    """Return the column with the number of rejections for a reason."""
    return f'rejected_{reason.name.lower()}'


def share_column(status: Status) -> str:
    """Return the column with the share of outputs that had a status."""
    return f'share_{status.name.lower()}'


_REASONS: Final = tuple(reason for reason in Reason if reason not in (Reason.NONE, Reason.THINNED))


def _field(kind: type[Estimate], *names: str) -> Iterator[Column]:
    """Yield columns that hold fields of an estimate."""
    known = quantities(kind)
    return (Column(name, 'float', known[name].unit, known[name].text) for name in names)


def _with_std(name: str, unit: str, text: str) -> tuple[Column, Column]:
    return Column(name, 'float', unit, text), Column(f'{name}_std', 'float', unit, f'standard deviation of {name}')


_DAVIS: Final = tuple(_field(ResistanceEstimate, *parameters(ResistanceEstimate)))
COLUMNS: Final = (
    Column('bag', 'text', '', 'absolute path of the bag'),
    Column('train', 'text', '', 'train, from --label, --namespace or the custom data of the bag'),
    Column('line', 'text', '', 'line, from --label or the custom data of the bag'),
    Column('day', 'text', '', 'day, YYYY-MM-DD: as line, or that of the start in UTC'),
    Column('weather', 'text', '', 'weather, as line'),
    Column('start', 'time', 's', 'log time of the first message'),
    Column('duration_s', 'float', 's', 'time covered by the samples'),
    Column('status', 'text', '', 'status of the resistance at the end; empty if the bag was not replayed'),
    Column('error', 'text', '', 'why there is no estimate'),
    *_DAVIS,
    *(column._replace(name=f'{column.name}_std', text=f'standard deviation of {column.name}') for column in _DAVIS),
    *(column for speed in SPEEDS for column in _with_std(f'w{speed}', 'N/kN', f'running resistance at {speed} m/s')),
    *_field(ResistanceEstimate, 'speed_min', 'speed_max'),
    *_field(BrakeRateEstimate, 'brake_rate', 'brake_rate_std'),
    Column('brake_status', 'text', '', 'status of the brake rate at the end'),
    *_with_std('dead_time', 's', 'dead time of the brake; empty where none was learned'),
    *_field(ResistanceEstimate, 'force_scale', 'force_scale_std', 'force_delay', 'force_delay_std'),
    *_with_std('wheel_ratio', '1', 'distance by the speed over that by the position, from stop to stop'),
    *_field(SpeedModelEstimate, 'mass_factor'),
    Column('used', 'int', '1', 'samples that the resistance was learned from'),
    Column('brake_used', 'int', '1', 'samples that the brake rate was learned from'),
    Column('rejected', 'int', '1', 'records and samples that the resistance was not learned from'),
    *(Column(reason_column(reason), 'int', '1', f'of these: {reason.name}') for reason in _REASONS),
    *(Column(share_column(status), 'float', '1', f'share of outputs that were {status.name}') for status in Status),
    Column('contradiction', 'text', '', 'last contradiction between the inputs: no estimate of this run is compared'),
    Column('finding', 'text', '', 'errors of the force and of the brake that were found'),
    Column('warnings', 'text', '', 'faults of the bag that do not prevent reading'),
    Column('revision', 'text', '', 'version of trainid_ros and digest of the modules that compute'),
)
NAMES: Final = tuple(column.name for column in COLUMNS)


def empty_row() -> Row:
    """Return a row without values."""
    return dict.fromkeys(NAMES)


_META: Final = b'trainid_fleet'  # Key of the metadata that hold the plan


def check_table(path: Path) -> None:
    """Raise InputError if a table cannot be written to a path: its type is not known, or pyarrow is missing."""
    if path.suffix not in ('.parquet', '.csv'):
        raise InputError(f'{path}: a table ends with .parquet or .csv')
    if path.suffix == '.parquet':
        import pyarrow.parquet  # noqa: F401, PLC0415 - optional


def write_table(rows: Sequence[Row], path: Path, about: Mapping[str, Any]) -> None:
    """Write a table; ``about`` goes to the metadata of a Parquet file. InputError if it cannot be written."""
    if path.suffix == '.csv':
        write_whole(path, lambda part: _write_csv(rows, part))
    else:
        write_whole(path, lambda part: _write_parquet(rows, part, about))


def read_table(path: Path) -> tuple[list[Row], dict[str, Any]]:
    """Return the rows of a table and what its metadata say of the plan; missing columns are None.

    Raises:
        InputError: It cannot be read, or lacks the columns that every table has.
    """
    try:
        path.open('rb').close()  # pyarrow does not say why it cannot
        rows, about = _read_csv(path) if path.suffix == '.csv' else _read_parquet(path)
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({error.strerror})') from None
    except ValueError as error:  # of pyarrow and csv
        raise InputError(f'{path}: is not a table of trainid fleet ({" ".join(str(error).split())[:200]})') from None
    return [empty_row() | row for row in rows], about


def _require(names: Sequence[str]) -> None:
    for name in ('bag', 'train', 'day', 'w15', 'w15_std'):
        if name not in names:
            raise ValueError(f'column {name} is missing')


def _write_csv(rows: Sequence[Row], path: Path) -> None:
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, NAMES)
        writer.writeheader()
        for row in rows:
            start = None if row['start'] is None else datetime.fromtimestamp(row['start'], UTC).isoformat()
            writer.writerow(row | {'start': start})


def _read_csv(path: Path) -> tuple[list[Row], dict[str, Any]]:
    convert: dict[str, Callable[[str], Any]] = {
        'text': str,
        'float': float,
        'int': int,
        'time': lambda text: datetime.fromisoformat(text).timestamp(),
    }
    kinds = {column.name: convert[column.kind] for column in COLUMNS}
    with path.open(encoding='utf-8', newline='') as file:
        reader = csv.DictReader(file)
        _require(reader.fieldnames or ())
        rows = [{name: kinds[name](text) for name, text in row.items() if name in kinds and text} for row in reader]
    return rows, {}


def _write_parquet(rows: Sequence[Row], path: Path, about: Mapping[str, Any]) -> None:
    import pyarrow as pa  # noqa: PLC0415 - optional
    from pyarrow import parquet  # noqa: PLC0415

    kinds = {'text': pa.string(), 'float': pa.float64(), 'int': pa.int64(), 'time': pa.timestamp('us', tz='UTC')}
    fields = [
        pa.field(column.name, kinds[column.kind], metadata={'unit': column.unit, 'description': column.text})
        for column in COLUMNS
    ]
    schema = pa.schema(fields, metadata={_META: json.dumps(about).encode()})
    columns = {column.name: [_stored(column, row[column.name]) for row in rows] for column in COLUMNS}
    parquet.write_table(pa.table(columns, schema=schema), path, compression='zstd')


def _stored(column: Column, value: Any) -> Any:
    return round(1e6 * value) if column.kind == 'time' and value is not None else value


def _read_parquet(path: Path) -> tuple[list[Row], dict[str, Any]]:
    import pyarrow as pa  # noqa: PLC0415 - optional
    from pyarrow import parquet  # noqa: PLC0415

    table = parquet.read_table(path)
    _require(table.column_names)
    kept = table.select([name for name in NAMES if name in table.column_names])
    if 'start' in kept.column_names:
        at = kept.column_names.index('start')
        kept = kept.set_column(at, 'start', kept['start'].cast(pa.timestamp('us', tz='UTC')).cast(pa.int64()))
    rows = kept.to_pylist()
    for row in rows:
        if row.get('start') is not None:
            row['start'] /= 1e6
    return rows, json.loads((table.schema.metadata or {}).get(_META, b'{}'))
