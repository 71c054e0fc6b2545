# SPDX-License-Identifier: Apache-2.0
"""Tables of a fleet as files: Parquet with units in the metadata of the columns, or CSV."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.errors import InputError
from trainid_ros.fleet.columns import COLUMNS, NAMES, Column, Row, empty_row
from trainid_ros.fleet.files import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

META: Final = b'trainid_fleet'
_WRITTEN: Final = 'table of trainid fleet'


def check_table(path: Path) -> None:
    """Raise InputError if a table cannot be written to a path: its type is not known, or pyarrow is missing."""
    if path.suffix not in ('.parquet', '.csv'):
        msg = f'{path}: a table ends with .parquet or .csv'
        raise InputError(msg)
    if path.suffix == '.parquet':
        import pyarrow.parquet  # noqa: F401, PLC0415 - optional


def write_table(rows: Sequence[Row], path: Path, about: Mapping[str, Any]) -> None:
    """Write a table; ``about`` goes to the metadata of a Parquet file.

    Raises:
        InputError: It cannot be written.

    """
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
        msg = f'{path}: cannot be read ({error.strerror})'
        raise InputError(msg) from None
    except ValueError as error:  # of pyarrow and csv
        msg = f'{path}: is not a {_WRITTEN} ({" ".join(str(error).split())[:200]})'
        raise InputError(msg) from None
    return [empty_row() | row for row in rows], about


def _require(names: Sequence[str]) -> None:
    for name in ('bag', 'train', 'day', 'w15', 'w15_std'):
        if name not in names:
            msg = f'column {name} is missing'
            raise ValueError(msg)


def _write_csv(rows: Sequence[Row], path: Path) -> None:
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, NAMES)
        writer.writeheader()
        for row in rows:
            writer.writerow(row | {'start': _iso(row['start'])})


def _iso(start_s: float | None) -> str | None:
    return None if start_s is None else datetime.fromtimestamp(start_s, UTC).isoformat()


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
    schema = pa.schema(fields, metadata={META: json.dumps(about).encode()})
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
    return rows, json.loads((table.schema.metadata or {}).get(META, b'{}'))
