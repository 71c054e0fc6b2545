# SPDX-License-Identifier: Apache-2.0
"""Parquet files as data frames are saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from trainid_ros.interface.errors import InputError
from trainid_ros.tables.columns import ROWS_AT_ONCE, joined
from trainid_ros.tables.parquet_table import ParquetTable


def table(tmp_path: Path, columns: dict[str, Any]) -> ParquetTable:
    path = tmp_path / 'log.parquet'
    parquet.write_table(pa.table(columns), path, row_group_size=7_000)
    return ParquetTable(path)


def test_columns_of_all_types_are_read(tmp_path: Path) -> None:
    columns = {
        't': pa.array([1, None], pa.timestamp('us', tz='Europe/Berlin')),
        'ns': pa.array([1_700_000_000_123_456_789, 2], pa.int64()),
        'v': pa.array([1.5, None], pa.float32()),
        'n': pa.array([3, None], pa.int16()),
        'ok': pa.array([True, False]),
    }
    found = joined(table(tmp_path, columns).blocks(tuple(columns)), columns)
    assert found['t'].dtype == np.dtype('datetime64[ns]')
    assert found['t'].astype(np.int64)[0] == 1000
    assert np.isnat(found['t'][1])
    assert found['ns'].tolist() == [1_700_000_000_123_456_789, 2]
    assert found['v'].tolist() == pytest.approx([1.5, np.nan], nan_ok=True)
    assert found['n'].tolist() == pytest.approx([3.0, np.nan], nan_ok=True)
    assert found['ok'].tolist() == [1.0, 0.0]


def test_units_in_the_metadata_are_known(tmp_path: Path) -> None:
    path = tmp_path / 'log.parquet'
    schema = pa.schema([pa.field('t', pa.float64()), pa.field('v', pa.float64(), metadata={'unit': 'km/h'})])
    parquet.write_table(pa.table({'t': [0.0], 'v': [1.0]}, schema=schema), path)
    source = ParquetTable(path)
    list(source.blocks(('t', 'v')))
    assert source.units == {'v': 'km/h'}


def test_a_long_file_is_read_in_blocks(tmp_path: Path) -> None:
    count = 2 * ROWS_AT_ONCE
    blocks = list(table(tmp_path, {'t': np.arange(count), 'v': np.zeros(count)}).blocks(('t', 'v')))
    assert max(len(block.columns['v']) for block in blocks) <= ROWS_AT_ONCE
    assert sum(block.share for block in blocks) == pytest.approx(1.0)
    assert np.concatenate([block.columns['t'] for block in blocks]).tolist() == list(range(count))


def test_an_error_names_file_and_column(tmp_path: Path) -> None:
    source = table(tmp_path, {'t': ['a', 'b'], 'v': [1.0, 2.0]})
    with pytest.raises(InputError, match=r"log\.parquet: column 't' of type string holds no numbers"):
        list(source.blocks(('t',)))
    with pytest.raises(InputError, match=r"log\.parquet: no column 'x' \(columns: 't', 'v'\)"):
        list(source.blocks(('x',)))
    source.path.write_bytes(b'PAR1 and no more')
    with pytest.raises(InputError, match=r'log\.parquet: is not a Parquet file'):
        list(source.blocks(('t',)))
