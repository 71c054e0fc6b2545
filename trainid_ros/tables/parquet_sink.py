# SPDX-License-Identifier: Apache-2.0
"""Estimates as a Parquet file, with units in the metadata of the fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import pyarrow as pa
from pyarrow import parquet

from trainid_ros.tables.estimate_table import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from trainid_ros.tables.estimate_table import Row, TableColumn

_TYPES: Final = {
    'covariance': pa.list_(pa.float64()),
    'status': pa.dictionary(pa.int8(), pa.string()),
    'last_reject_reason': pa.dictionary(pa.int8(), pa.string()),
    'used': pa.uint64(),
    'rejected': pa.uint64(),
    'observable': pa.bool_(),
}


def _field(column: TableColumn) -> pa.Field:
    metadata = {'unit': column.unit} if column.unit else None
    return pa.field(column.name, _TYPES.get(column.field, pa.float64()), metadata=metadata)


SCHEMA: Final = pa.schema([pa.field('time', pa.timestamp('ns', tz='UTC')), *map(_field, COLUMNS)])


class ParquetSink:
    """A Parquet file."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        self._writer = parquet.ParquetWriter(path, SCHEMA)

    def write(self, rows: Sequence[Row]) -> None:
        """Write rows as one row group."""
        if rows:
            cells = zip(*rows, strict=True)
            arrays = [pa.array(column, field.type) for column, field in zip(cells, SCHEMA, strict=True)]
            self._writer.write_table(pa.Table.from_arrays(arrays, schema=SCHEMA))

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()
