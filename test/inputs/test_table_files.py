# SPDX-License-Identifier: Apache-2.0
"""CSV, npz and Parquet files, read in blocks of columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from trainid_ros.inputs.mapping import CsvFormat, Mapping
from trainid_ros.inputs.table_files import (
    ROWS_AT_ONCE,
    Column,
    CsvTable,
    NpzTable,
    ParquetTable,
    Table,
    joined,
)
from trainid_ros.interface.errors import InputError

NAN = float('nan')
NUMBERS = {'t': [0.0, 0.5, 1.0], 'v': [36.5, NAN, -1.25]}


def table(tmp_path: Path, content: str | bytes, **form: str | int | bool) -> CsvTable:
    path = tmp_path / 'log.csv'
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return CsvTable(path, Mapping(csv=CsvFormat(**form)))  # type: ignore[arg-type]


def columns_of(source: Table, *names: str) -> dict[str, Column]:
    return joined(source.blocks(names), names)


def read(source: Table, *names: str) -> dict[str, list[float]]:
    return {name: column.tolist() for name, column in columns_of(source, *names).items()}


def near(values: dict[str, list[float]]) -> dict[str, object]:
    return {name: pytest.approx(column, nan_ok=True) for name, column in values.items()}


def test_a_row_with_more_cells_than_names_is_an_error(tmp_path: Path) -> None:
    """A comma as decimal sign between commas: every cell after it would be that of another column."""
    with pytest.raises(InputError, match=r'log.csv: line 3 has 3 cells, 2 columns have names'):
        read(table(tmp_path, 't,v\n0,36\n1,36,5\n'), 't', 'v')


@pytest.mark.parametrize('end', ['', 'closed"'])
def test_a_quote_that_is_not_closed_loses_no_rows_in_silence(tmp_path: Path, end: str) -> None:
    rows = [f'{k},{k},' for k in range(9)]
    rows[3] += '"door open'
    rows[6] += end
    with pytest.raises(InputError, match=r'log\.csv: lines 5 to \d+ are one row by their quotes: one is not closed'):
        read(table(tmp_path, '\n'.join(['t,v,note', *rows])), 't', 'v')


def test_a_text_of_several_lines_is_no_fault(tmp_path: Path) -> None:
    content = 't,v,note\n0,36.5,"one\ntwo, three"\n0.5,,\n1,-1.25,\n'
    assert read(table(tmp_path, content), 't', 'v') == near(NUMBERS)


def test_a_block_without_times_is_blank_among_times(tmp_path: Path) -> None:
    rows = ['2024-03-08T12:00:00,1'] * 2 + [',1'] * ROWS_AT_ONCE
    found = columns_of(table(tmp_path, '\n'.join(['t,v', *rows])), 't')['t']
    assert np.isnat(found).tolist() == [False] * 2 + [True] * ROWS_AT_ONCE


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
    assert read(table(tmp_path, content), 't', 'v') == near(NUMBERS)


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
        ('t;v\n0,5;102+300\n1,0;102+312,5\n', [102300.0, 102312.5]),
    ],
)
def test_thousands_marks_are_no_decimal_signs(tmp_path: Path, content: str, values: list[float]) -> None:
    assert read(table(tmp_path, content), 't', 'v') == {'t': [0.5, 1.0], 'v': values}


def test_times_of_day_are_times_since_midnight(tmp_path: Path) -> None:
    source = table(tmp_path, 't;v\n08:15:03.2;1\n;2\n8:15:04,000000001;3\n')
    found = columns_of(source, 't')['t']
    assert found.dtype == np.dtype('timedelta64[ns]')
    assert found.astype(np.int64)[[0, 2]].tolist() == [29_703_200_000_000, 29_704_000_000_001]
    assert np.isnat(found[1])


def test_times_are_read_to_the_nanosecond(tmp_path: Path) -> None:
    content = 't,n,ok\n2024-03-08T12:00:00.000000001Z,1700000000123456789,true\n,1700000000123456790,False\n'
    source = table(tmp_path, content)
    found = columns_of(source, 't', 'n', 'ok')
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
        ('t;v\ns;kN\n14/13/2024 12:00:00;1\n', r"log\.csv: line 3: column 't' = '14/13/2024 12:00:00' is no time like"),
        ('t;v\n03/08/2024 12:00:00;1\n', r"line 2: column 't' = '03/08/2024 12:00:00': day, month and year may have"),
        ('t;Speed [km/h]\n0;1\n', r"no column 'v' \(columns"),
        ('t;v [km/h];v [m/s]\n0;1;1\n', r"log\.csv: column 'v' is there 2 times"),
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


@pytest.mark.parametrize(
    ('rows', 'values'),
    [
        (['0,125', '120,500'], [0.125, 120.5]),  # no thousands stand after a 0
        (['1,234', '12,5'], [1.234, 12.5]),
        (['1,234', '0.5'], [1234.0, 0.5]),
    ],
)
def test_the_decimal_sign_is_that_of_the_whole_file(tmp_path: Path, rows: list[str], values: list[float]) -> None:
    """A train that stands still is logged as 0 for long, which shows no sign."""
    text = 't;v\n' + ''.join(f'{k};0\n' for k in range(ROWS_AT_ONCE + 1)) + ''.join(f'9;{cell}\n' for cell in rows)
    assert read(table(tmp_path, text), 'v')['v'][-2:] == values


@pytest.mark.parametrize('point', ['', '2;3.500\n'])
def test_a_sign_that_the_whole_file_does_not_show_is_asked_for(tmp_path: Path, point: str) -> None:
    text = 't;v\n' + ''.join(f'{k};0\n' for k in range(300)) + f'1;1,234\n{point}'
    with pytest.raises(InputError, match=r"log\.csv: '1,234' may be 1\.234 or 1234\.0: .* csv: {decimal: "):
        read(table(tmp_path, text), 't', 'v')
    assert read(table(tmp_path, text, decimal='.'), 'v')['v'][300] == 1234.0


def test_milliseconds_after_a_colon_are_read(tmp_path: Path) -> None:
    source = table(tmp_path, 't;v\n2024-03-08 12:00:00:900;1\n2024-03-08 12:00:01:100;2\n')
    times = columns_of(source, 't')['t']
    assert np.diff(times.astype(np.int64)).tolist() == [200_000_000]
    assert read(table(tmp_path, 't;v\n12:00:00:900;1\n'), 't')['t'] == [43_200_900_000_000]
    with pytest.raises(InputError, match=r"line 3: column 't' = '2024-03-08 12:00:01:1' is not a date with time"):
        read(table(tmp_path, 't;v\n2024-03-08 12:00:00:900;1\n2024-03-08 12:00:01:1;2\n'), 't')


HASHES = 'car;t;v\n#1;0;10\n#2;1;\n'


def test_a_row_that_starts_as_a_comment_is_never_lost_in_silence(tmp_path: Path) -> None:
    error = (
        r"log\.csv: line 2 starts with '#1' like a comment, but holds numbers; csv: {comments: true} .* {comments: f"
    )
    with pytest.raises(InputError, match=error):
        read(table(tmp_path, HASHES), 't', 'v')
    assert read(table(tmp_path, HASHES, comments=False), 't', 'v') == near({'t': [0, 1], 'v': [10, NAN]})
    commented = f'{HASHES}3;2;30\n'
    assert read(table(tmp_path, commented, comments=True), 't', 'v') == {'t': [2], 'v': [30]}


def test_a_blank_first_cell_is_no_comment(tmp_path: Path) -> None:
    found = read(table(tmp_path, 'v;t\n#N/A;0\n#NV;1\n#DIV/0!;2\n# a comment; 5\n#12;1\n2;3\n'), 't', 'v')
    assert found == near({'t': [0, 1, 2, 3], 'v': [NAN, NAN, NAN, 2]})


@pytest.mark.parametrize('units', ['', 's;km/h\n', ';1\n'])
def test_a_row_with_a_time_is_none_of_units(tmp_path: Path, units: str) -> None:
    line = 2 + units.count('\n')
    with pytest.raises(InputError, match=rf"line {line}: column 'v' = 'off' is not a number"):
        read(table(tmp_path, f't;v\n{units}0;off\n1;2\n'), 't', 'v')


def test_the_minus_sign_of_unicode_is_one(tmp_path: Path) -> None:
    assert read(table(tmp_path, 't;v\n0;\u22121,5\n1;2,5\n'), 't', 'v') == {'t': [0, 1], 'v': [-1.5, 2.5]}


@pytest.mark.parametrize('head', ['t;v [km/h]', 't;v(km/h)', 't;v_kmh', 't [s];v (kmh)'])
def test_a_column_is_named_with_or_without_its_unit(tmp_path: Path, head: str) -> None:
    source = table(tmp_path, f'{head}\n0;36.5\n0.5;\n1;-1.25\n')
    assert read(source, 't', 'v') == near(NUMBERS)


def test_a_column_counts_once(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"column 'v_kmh' has two names in the mapping"):
        read(table(tmp_path, 't;v_kmh\n0;1\n'), 'v', 'v_kmh')


@pytest.mark.parametrize('name', ['Spede', 'SPEED', 'speed [m/s]'])
def test_a_wrong_name_has_a_hint(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"; did you mean 'Speed \[km/h\]'\?"):
        read(table(tmp_path, 't;Speed [km/h];F\n0;1;2\n'), name)


def test_cells_without_a_value_are_stated(tmp_path: Path) -> None:
    path = tmp_path / 'log.csv'
    path.write_text('t;v\n0;36.5\n0.5;Ausfall\n1;-1.25\n2;---\n3;#NV\n4;-999\n', encoding='utf-8')
    source = CsvTable(path, Mapping(missing=frozenset({'ausfall', '-999'})))
    assert read(source, 'v')['v'] == pytest.approx([36.5, NAN, -1.25, NAN, NAN, NAN], nan_ok=True)


def test_repeated_names_are_no_row(tmp_path: Path) -> None:
    """Torque writes them again after each stop of the engine."""
    head = 'GPS Time, Device Time, Longitude,GPS Speed (Meters/second),Speed (OBD)(km/h)\n'
    row = 'Fri May 22 07:00:2{0} EDT 2015,22-May-2015 07:00:2{0}.730,-,0.5,{1}\n'
    source = table(tmp_path, head + row.format(5, 36) + row.format(6, '-') + head + row.format(7, 37))
    found = columns_of(source, 'Device Time', 'Speed (OBD)')
    assert found['Speed (OBD)'].tolist() == pytest.approx([36.0, NAN, 37.0], nan_ok=True)
    assert np.diff(found['Device Time']).astype(int).tolist() == [10**9, 10**9]
    assert source.units == {'Speed (OBD)': 'km/h'}


VBOX = """File created on 14/11/2023 @ 23:13:20

[header]
satellites
time
latitude
longitude
velocity kmh
heading

[comments]
Log rate (Hz) : 10.00

[column names]
sats time lat long velocity heading

[data]
009 231320.20 +3119.09973 -00058.51111 000.028 359.10
009 231320.30 +3119.09973 -00058.51111 000.036 359.10
"""


@pytest.mark.parametrize('end', ['', ' '])
def test_a_file_of_vbox_is_read(tmp_path: Path, end: str) -> None:
    path = tmp_path / 'log.vbo'
    path.write_text(VBOX.replace('velocity heading', f'velocity heading{end}'), encoding='utf-8')
    source = CsvTable(path)
    assert source.names() == ('sats', 'time', 'lat', 'long', 'velocity', 'heading')
    assert read(source, 'time', 'velocity', 'lat') == near(
        {'time': [231320.2, 231320.3], 'velocity': [0.028, 0.036], 'lat': [3119.09973] * 2}
    )
    assert source.units['velocity'] == 'velocity kmh'


def test_chinese_text_is_decoded(tmp_path: Path) -> None:
    source = table(tmp_path, '时间,速度(km/h)\n0,36.5\n'.encode('gb18030'))
    assert read(source, '时间', '速度') == {'时间': [0], '速度': [36.5]}


def npz_table(tmp_path: Path, **columns: Any) -> NpzTable:
    path = tmp_path / 'log.npz'
    np.savez(path, **columns)
    return NpzTable(path)


def test_npz_columns_of_all_types_are_read(tmp_path: Path) -> None:
    times = np.array(['2024-03-08'], dtype='datetime64[s]')
    v, n = np.array([1.5], dtype=np.float32), np.array([3], dtype=np.uint8)
    source = npz_table(tmp_path, t=times, v=v, n=n, ok=np.array([True]), note=np.zeros((2, 2)))
    found = columns_of(source, 't', 'v', 'n', 'ok')
    assert found['t'].dtype == np.dtype('datetime64[ns]')
    assert [found[name].tolist() for name in ('v', 'n', 'ok')] == [[1.5], [3], [1.0]]


@pytest.mark.parametrize(
    ('columns', 'error'),
    [
        ({'t': np.zeros(3)}, r"log\.npz: no column 'v' \(columns: 't'\)"),
        ({'t': np.zeros(3), 'v': np.zeros(2)}, r"log\.npz: column 'v' of type float64 and shape \(2,\)"),
        ({'t': np.zeros(3), 'v': np.zeros((3, 2))}, r"log\.npz: column 'v' of type float64 and shape \(3, 2\)"),
        ({'t': np.zeros(3), 'v': np.zeros((2, 1))}, r"log\.npz: column 'v' of type float64 and shape \(2,\)"),
        ({'t': np.array(['12:00:00', 'x']), 'v': np.zeros(2)}, r"npz: row 2: column 't' = 'x' is not a time of day"),
        ({'t': np.zeros(3), 'v': np.array(['a', 'b', 'c'])}, r"log\.npz: column 'v' of type <U1"),
        ({'t': np.array([2**64 - 1], dtype='uint64'), 'v': np.zeros(1)}, r"log\.npz: column 't': 18446744073709551615"),
        ({'t': np.zeros(3), 'v': np.array([None] * 3)}, r'log\.npz: cannot be read \(Object arrays'),
    ],
)
def test_an_error_names_npz_file_and_column(tmp_path: Path, columns: dict[str, Any], error: str) -> None:
    with pytest.raises(InputError, match=error):
        list(npz_table(tmp_path, **columns).blocks(('t', 'v')))


@pytest.mark.parametrize('shape', [(3, 1), (1, 3)])
def test_a_matrix_of_one_column_or_row_is_a_column(tmp_path: Path, shape: tuple[int, int]) -> None:
    source = npz_table(tmp_path, t=np.arange(3), v=np.array([1.0, 2.0, 3.0]).reshape(shape))
    assert columns_of(source, 't', 'v')['v'].tolist() == [1.0, 2.0, 3.0]


def test_npz_times_are_durations_or_texts(tmp_path: Path) -> None:
    durations = np.array([0, 1500], dtype='timedelta64[ms]')
    source = npz_table(tmp_path, t=np.array(['2024-03-08', '2024-03-08T00:00:01.5']), d=durations)
    found = columns_of(source, 't', 'd')
    assert (found['t'] - found['t'][0]).tolist() == found['d'].tolist() == [0, 1_500_000_000]


@pytest.mark.parametrize('content', [b'', b'PK\x03\x04', b'text'])
def test_what_is_not_npz_is_rejected(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'log.npz'
    path.write_bytes(content)
    with pytest.raises(InputError, match=r'log\.npz: is not an npz file'):
        list(NpzTable(path).blocks(('t',)))


def parquet_table(tmp_path: Path, columns: dict[str, Any]) -> ParquetTable:
    path = tmp_path / 'log.parquet'
    parquet.write_table(pa.table(columns), path, row_group_size=7_000)
    return ParquetTable(path)


def test_parquet_columns_of_all_types_are_read(tmp_path: Path) -> None:
    columns = {
        't': pa.array([1, None], pa.timestamp('us', tz='Europe/Berlin')),
        'ns': pa.array([1_700_000_000_123_456_789, 2], pa.int64()),
        'v': pa.array([1.5, None], pa.float32()),
        'n': pa.array([3, None], pa.int16()),
        'ns_blank': pa.array([1_700_000_000_123_456_789, None], pa.int64()),
        'ok': pa.array([True, False]),
    }
    found = columns_of(parquet_table(tmp_path, columns), *columns)
    assert found['t'].dtype == np.dtype('datetime64[ns]')
    assert found['t'].astype(np.int64)[0] == 1000
    assert np.isnat(found['t'][1])
    assert found['ns'].tolist() == [1_700_000_000_123_456_789, 2]
    assert found['v'].tolist() == pytest.approx([1.5, np.nan], nan_ok=True)
    assert found['ns_blank'].tolist() == pytest.approx([1_700_000_000_123_456_789, np.nan], abs=128, rel=0, nan_ok=True)
    assert found['n'].tolist() == pytest.approx([3.0, np.nan], nan_ok=True)
    assert found['ok'].tolist() == [1.0, 0.0]


def test_parquet_times_and_durations_are_read(tmp_path: Path) -> None:
    columns = {
        'duration': pa.array([1500, None], pa.duration('ms')),
        'time32': pa.array([1500, None], pa.time32('ms')),
        'time64': pa.array([1_500_000_000, None], pa.time64('ns')),
        'text': pa.array(['00:00:01.5', None]),
        'large': pa.array(['00:00:01:500', ''], pa.large_string()),
        'view': pa.array(['00:00:01:500', ''], pa.string_view()),
        'word': pa.array(['00:00:01,5', None]).dictionary_encode(),
    }
    for name, column in columns_of(parquet_table(tmp_path, columns), *columns).items():
        assert column.dtype == np.dtype('timedelta64[ns]'), name
        assert (column[0].astype(np.int64), np.isnat(column[1])) == (1_500_000_000, True), name
    dates = pa.array(['2024-03-08T12:00:00.000000001Z', None])
    found = columns_of(parquet_table(tmp_path, {'t': dates}), 't')['t']
    assert found.astype('datetime64[ns]').astype(np.int64)[0] == 1_709_899_200 * 10**9 + 1


def test_a_parquet_text_that_is_no_time_names_its_row(tmp_path: Path) -> None:
    texts = ['12:00:00'] * (ROWS_AT_ONCE + 1) + ['noon']
    with pytest.raises(InputError, match=r"log\.parquet: row 10002: column 't' = 'noon' is not a time of day"):
        list(parquet_table(tmp_path, {'t': texts}).blocks(('t',)))


def test_units_in_the_metadata_are_known(tmp_path: Path) -> None:
    path = tmp_path / 'log.parquet'
    schema = pa.schema([pa.field('t', pa.float64()), pa.field('v', pa.float64(), metadata={'unit': 'km/h'})])
    parquet.write_table(pa.table({'t': [0.0], 'v': [1.0]}, schema=schema), path)
    source = ParquetTable(path)
    list(source.blocks(('t', 'v')))
    assert source.units == {'v': 'km/h'}


@pytest.mark.parametrize('suffix', ['csv', 'npz', 'parquet'])
def test_a_long_file_is_read_in_blocks(tmp_path: Path, suffix: str) -> None:
    t = np.arange(2 * ROWS_AT_ONCE + 1)
    source: Table
    if suffix == 'csv':
        source = table(tmp_path, 't,v\n' + ''.join(f'{k},0.5\n' for k in t))
    elif suffix == 'npz':
        source = npz_table(tmp_path, t=t, v=0.5 + 0.0 * t)
    else:
        source = parquet_table(tmp_path, {'t': t, 'v': 0.5 + 0.0 * t})
    blocks = list(source.blocks(('t', 'v')))
    assert len(blocks) >= 3
    assert max(len(block.columns['v']) for block in blocks) <= ROWS_AT_ONCE
    assert sum(block.share for block in blocks) == pytest.approx(1.0)
    assert np.concatenate([block.columns['t'] for block in blocks]).tolist() == t.tolist()


def test_an_error_names_parquet_file_and_column(tmp_path: Path) -> None:
    source = parquet_table(tmp_path, {'t': ['a', 'b'], 'v': [1.0, 2.0]})
    with pytest.raises(InputError, match=r"log\.parquet: column 't' of type string holds no numbers"):
        list(source.blocks(('t',)))
    with pytest.raises(InputError, match=r"log\.parquet: no column 'x' \(columns: 't', 'v'\)"):
        list(source.blocks(('x',)))
    source.path.write_bytes(b'PAR1 and no more')
    with pytest.raises(InputError, match=r'log\.parquet: is not a Parquet file'):
        list(source.blocks(('t',)))
