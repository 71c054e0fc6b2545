# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from trainid_ros.fleet.table_file import COLUMNS, Row, check_table, empty_row, read_table, write_table
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

ABOUT = {'setup': {'train': 'T.yaml'}}


@pytest.fixture
def rows() -> list[Row]:
    full = {'text': 'Ä, "x"', 'float': 0.1 + 0.2, 'int': 3, 'time': 1.7e9 + 0.25}
    return [{column.name: full[column.kind] for column in COLUMNS}, empty_row()]


@pytest.mark.parametrize('name', ['t.parquet', 't.csv'])
def test_a_table_is_read_as_written(name: str, rows: list[Row], tmp_path: Path) -> None:
    write_table(rows, tmp_path / name, ABOUT)
    found, about = read_table(tmp_path / name)
    assert found == rows
    assert about == (ABOUT if name == 't.parquet' else {})
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_columns_state_their_units(rows: list[Row], tmp_path: Path) -> None:
    parquet = pytest.importorskip('pyarrow.parquet')
    write_table(rows, tmp_path / 't.parquet', ABOUT)
    schema = parquet.read_schema(tmp_path / 't.parquet')
    assert schema.field('w15').metadata[b'unit'] == b'N/kN'
    assert str(schema.field('start').type) == 'timestamp[us, tz=UTC]'


def test_other_files_are_no_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'ends with \.parquet or \.csv'):
        check_table(tmp_path / 't.xlsx')
    for name in ('t.csv', 't.parquet'):
        (tmp_path / name).write_text('a,b\n1,2\n', encoding='utf-8')
        with pytest.raises(InputError, match=f'{name}: is not a table'):
            read_table(tmp_path / name)
    with pytest.raises(InputError, match='cannot be read'):
        read_table(tmp_path / 'none.csv')
