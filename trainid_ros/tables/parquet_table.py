# SPDX-License-Identifier: Apache-2.0
"""Parquet files, read by row groups."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from trainid_ros.interface.errors import InputError
from trainid_ros.tables.columns import ROWS_AT_ONCE, Block, Column, check_columns
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path


class ParquetTable:
    """A Parquet file."""

    def __init__(self, path: Path) -> None:
        """Name the file."""
        self.path = path
        self.units: dict[str, str] = {}

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`."""
        try:
            with parquet.ParquetFile(self.path) as file:
                check_columns(self.path, names, file.schema_arrow.names)
                stated = ((name, (file.schema_arrow.field(name).metadata or {}).get(b'unit', b'')) for name in names)
                self.units = {name: unit.decode(errors='replace') for name, unit in stated if unit}
                count = max(1, file.metadata.num_rows)
                for batch in file.iter_batches(batch_size=ROWS_AT_ONCE, columns=list(names)):
                    columns = {name: self._column(name, batch.column(name)) for name in names}
                    yield Block(columns, batch.num_rows / count)
        except (pa.ArrowException, OSError) as error:
            raise InputError(
                f'{self.path}: is not a Parquet file that can be read ({" ".join(str(error).split())})'
            ) from None

    def _column(self, name: str, cells: pa.Array) -> Column:
        if pa.types.is_dictionary(cells.type):
            cells = cells.dictionary_decode()
        kind = cells.type
        try:
            if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
                return np.asarray(cells.cast(pa.timestamp('ns')).to_numpy(zero_copy_only=False))
            if pa.types.is_integer(kind) and not cells.null_count:
                return np.asarray(cells.cast(pa.int64()).to_numpy())
            return np.asarray(cells.cast(pa.float64()).to_numpy(zero_copy_only=False))
        except pa.ArrowException:
            raise InputError(f'{self.path}: column {shown(name)} of type {kind} holds no numbers') from None
