# SPDX-License-Identifier: Apache-2.0
"""Files of NumPy with one array a column."""

from __future__ import annotations

from typing import TYPE_CHECKING
from zipfile import BadZipFile, is_zipfile

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.tables.columns import ROWS_AT_ONCE, Block, Column, check_columns
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

_KINDS = 'biufM'  # bool, whole numbers, numbers, times


class NpzTable:
    """An ``.npz`` file; arrays that are not used may have any shape."""

    def __init__(self, path: Path) -> None:
        """Name the file."""
        self.path = path
        self.units: dict[str, str] = {}

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`. They are read as a whole."""
        columns = self._columns(names)
        count = len(columns[names[0]])
        for start in range(0, count, ROWS_AT_ONCE):
            rows = {name: column[start : start + ROWS_AT_ONCE] for name, column in columns.items()}
            yield Block(rows, len(rows[names[0]]) / count)

    def _columns(self, names: Sequence[str]) -> dict[str, Column]:
        if not is_zipfile(self.path):
            raise InputError(f'{self.path}: is not an npz file')
        try:
            with np.load(self.path, allow_pickle=False) as file:
                check_columns(self.path, names, file.files)
                columns = {name: file[name] for name in names}
        except (OSError, ValueError, BadZipFile, EOFError) as error:
            raise InputError(f'{self.path}: cannot be read ({" ".join(str(error).split())})') from None
        first = columns[names[0]]
        for name, column in columns.items():
            if column.ndim != 1 or column.shape != first.shape or column.dtype.kind not in _KINDS:
                raise InputError(
                    f'{self.path}: column {shown(name)} of type {column.dtype} and shape {column.shape}; one number '
                    f'for each of {shown(names[0])} expected, which has shape {first.shape}'
                )
        return {name: _plain(column) for name, column in columns.items()}


def _plain(column: Column) -> Column:
    if column.dtype.kind == 'M':
        return column.astype('datetime64[ns]')
    return column.astype(np.int64 if column.dtype.kind in 'iu' else np.float64)
