# SPDX-License-Identifier: Apache-2.0
"""CSV files as loggers write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.mapping import CsvFormat
from trainid_ros.tables.columns import ROWS_AT_ONCE, joined
from trainid_ros.tables.csv_table import CsvTable

NAN = float('nan')
NUMBERS = {'t': [0.0, 0.5, 1.0], 'v': [36.5, NAN, -1.25]}


def table(tmp_path: Path, content: str | bytes, **form: str | int) -> CsvTable:
    path = tmp_path / 'log.csv'
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return CsvTable(path, CsvFormat(**form))  # type: ignore[arg-type]


def read(source: CsvTable, *names: str) -> dict[str, list[float]]:
    return {name: column.tolist() for name, column in joined(source.blocks(names), names).items()}


def test_a_row_with_more_cells_than_names_is_an_error(tmp_path: Path) -> None:
    """A comma as decimal sign between commas: every cell after it would be that of another column."""
    with pytest.raises(InputError, match=r'log.csv: line 3 has 3 cells, 2 columns have names'):
        read(table(tmp_path, 't,v\n0,36\n1,36,5\n'), 't', 'v')


def test_names_and_units_alone_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no numbers below the names of its columns 't', 'v'"):
        read(table(tmp_path, 't;v\ns;km/h\n'), 't', 'v')


@pytest.mark.parametrize(
    'content',
    [
        't,v\n0,36.5\n0.5,\n1,-1.25\n',
        't;v\r\n0;36,5\r\n0,5;\r\n1,0;-1,25\r\n',
        't\tother\tv\n0\tx\t36.5\n.5\ty\tNaN\n1\tz\t-1.25\n',
        '"t","v"\n"0","36,5"\n"0,5","-"\n"1,0","-1,25"\n',
        'Train 7\nsecond line; of a preamble\n\nt;v\ns;km/h\n0;36.5\n0.5;n/a\n1;-1.25\n',
        '# t,v\n# a comment\n0,36.5\n0.5,\n# another, one\n1,-1.25\n',
        't , v\nfloat,float\n[s],[km/h]\n0, 36.5\n0.5, \n1, -1.25\n',
        't|v|\n0|36.5|\n0.5||\n1|-1.25|\n',
        't;v\n0;36,5\n0,5\n1;-1,25',  # a row that ends early
    ],
)
def test_separator_decimal_sign_header_and_comments_are_found_out(tmp_path: Path, content: str) -> None:
    assert read(table(tmp_path, content), 't', 'v') == {
        name: pytest.approx(x, nan_ok=True) for name, x in NUMBERS.items()
    }


@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig', 'latin-1', 'utf-16'])
def test_the_encoding_is_found_out(tmp_path: Path, encoding: str) -> None:
    content = 't;Steigung [°]\n1;0,5\n'.encode(encoding)
    assert read(table(tmp_path, content), 't', 'Steigung [°]') == {'t': [1], 'Steigung [°]': [0.5]}


def test_what_is_stated_is_not_found_out(tmp_path: Path) -> None:
    content = 't:v\n1:1\n0:1'
    assert read(table(tmp_path, content, separator=':', header_rows=2), 't', 'v') == {'t': [0], 'v': [1]}
    source = table(tmp_path, 't;v\n0;1\n1;1,5\n', decimal='.')
    with pytest.raises(InputError, match=r"log\.csv: line 3: column 'v' = '1,5' is not a number .*csv: {separator"):
        read(source, 't', 'v')
    assert read(table(tmp_path, 't;°v\n0;1\n', encoding='utf-8'), 't', '°v') == {'t': [0], '°v': [1]}


@pytest.mark.parametrize(
    ('content', 'values'),
    [
        ('t;v\n0,5;1.234,5\n1,0;-2.345.678,25\n', [1234.5, -2345678.25]),
        ('t;v\n0,5;12,5\n1,0;1.234\n', [12.5, 1234.0]),
        ('t;v\n0.5;1,234.5\n1.0;-2,345,678.25\n', [1234.5, -2345678.25]),
        ('t;v\n0.5;12.5\n1.0;1.234\n', [12.5, 1.234]),
        ("t;v\n0.5;1'234.5\n1.0;12\n", [1234.5, 12.0]),
        ('t;v\n0,5;1\u202f234,5\n1,0;12\n', [1234.5, 12.0]),
        ('t;v\n0,500;1,234\n1,000;12\n', [1.234, 12.0]),
    ],
)
def test_thousands_marks_are_no_decimal_signs(tmp_path: Path, content: str, values: list[float]) -> None:
    assert read(table(tmp_path, content), 't', 'v') == {'t': [0.5, 1.0], 'v': values}


def test_times_of_day_are_times_since_midnight(tmp_path: Path) -> None:
    source = table(tmp_path, 't;v\n08:15:03.2;1\n;2\n8:15:04,000000001;3\n')
    found = joined(source.blocks(('t',)), ('t',))['t']
    assert found.dtype == np.dtype('timedelta64[ns]')
    assert found.astype(np.int64)[[0, 2]].tolist() == [29_703_200_000_000, 29_704_000_000_001]
    assert np.isnat(found[1])


def test_times_are_read_to_the_nanosecond(tmp_path: Path) -> None:
    content = 't,n,ok\n2024-03-08T12:00:00.000000001Z,1700000000123456789,true\n,1700000000123456790,False\n'
    source = table(tmp_path, content)
    found = joined(source.blocks(('t', 'n', 'ok')), ('t', 'n', 'ok'))
    assert found['t'].dtype == np.dtype('datetime64[ns]')
    assert found['t'].astype(np.int64)[0] == 1_709_899_200 * 10**9 + 1
    assert np.isnat(found['t'][1])
    assert found['n'].tolist() == [1700000000123456789, 1700000000123456790]
    assert found['ok'].tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ('content', 'error'),
    [
        ('t;vel\n0;1\n', r"log\.csv: no column 'v'.* \(columns: 't', 'vel'\)"),
        ('t;v\n12:00;1\n', r"log\.csv: line 2: column 't' = '12:00' is no time like"),
        ('t;v\n12:00:00;1\nEnd\n', r"log\.csv: line 3: column 't' = 'End' is not a time of day; lines of text below"),
        ('t;v\n0;1\n1;1\nEnd of log\n', r"log\.csv: line 4: column 't' = 'End of log' is not a number .* below"),
        ('t;v\n0;1,5\n1;2,5\n2;1.5\n', r"log\.csv: line 4: column 'v' = '1.5' is not a number .* sign ','"),
        ('t;v\n0;12,5\n1;1.23,5\n', r"log\.csv: line 3: column 'v' = '1.23,5' is not a number"),
        ('t;v\ns;kN\n03/08/2024 12:00:00;1\n', r"log\.csv: line 3: column 't' = '03/08/2024 12:00:00' is no time like"),
        ('t;v\n0;1_000\n', r"log\.csv: line 2: column 'v' = '1_000' is not a number"),
        ('t;v\n0;1,234\n1;-22,500\n', r"log\.csv: '1,234' may be 1\.234 or 1234\.0: .* csv: {decimal: "),
        ('t;v;v\n0;1;1\n', r"log\.csv: column 'v' is there 2 times"),
        ('', r"log\.csv: no column 't' \(columns: none\)"),
        ('t;v\n0;1\n1;x\n', r"log\.csv: line 3: column 'v' = 'x' is not a number"),
        ('t;v\n2024-03-08;1\nx;1\n', r"log\.csv: line 3: column 't' = 'x' is not a date with time"),
        ('t;v\n0;"1\n' + 'x' * 200_000, r'log\.csv: line \d+: field larger than field limit'),
    ],
)
def test_an_error_names_line_and_column(tmp_path: Path, content: str, error: str) -> None:
    with pytest.raises(InputError, match=error):
        read(table(tmp_path, content), 't', 'v')


def test_a_long_file_is_read_in_blocks(tmp_path: Path) -> None:
    count = 2 * ROWS_AT_ONCE + 1
    source = table(tmp_path, 't,v\n' + ''.join(f'{k},0.5\n' for k in range(count)))
    blocks = list(source.blocks(('t', 'v')))
    assert [len(block.columns['v']) for block in blocks] == [ROWS_AT_ONCE, ROWS_AT_ONCE, 1]
    assert sum(block.share for block in blocks) == pytest.approx(1.0)
    assert blocks[1].columns['t'][0] == ROWS_AT_ONCE
