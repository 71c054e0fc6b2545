# SPDX-License-Identifier: Apache-2.0
"""The rows of tables as the records of a train."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from test.own_bag import at
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping import TimeColumn, parse_mapping
from trainid_ros.inputs.table_files import ROWS_AT_ONCE, Column
from trainid_ros.inputs.tables import Clock, TableRecords, numbers
from trainid_ros.inputs.units import find_unit
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)

SPEED = '{time: {field: t, unit: ns}, speed: {field: v}'


def mapped(tmp_path: Path, mapping: str, **columns: object) -> TableRecords:
    path = tmp_path / 'log.npz'
    np.savez(path, **columns)  # type: ignore[arg-type]
    return TableRecords(path, MappedInputs(parse_mapping(mapping, str(tmp_path / 'map.yaml')), None))


def records(source: TableRecords) -> list[Record]:
    return [record for _, some in source.blocks() for _, record in some]


def test_a_row_becomes_a_record_for_each_quantity(tmp_path: Path) -> None:
    mapping = """
        time: {field: t, unit: ns}
        speed: {field: v, unit: km/h}
        position: {field: x, unit: km}
        force: {sum: [{field: F1, unit: kN}, {field: F2, unit: kN, sign: -1}]}
        gradient: {field: i, unit: percent}
        brake_command: {field: notch, table: {0: 0.0, 1: -0.3}}
        mass: {field: m, unit: t}
    """
    columns = {'v': 36.0, 'x': 1.5, 'F1': 3.0, 'F2': 1.0, 'i': 0.5, 'notch': 1, 'm': 40.0}
    source = mapped(tmp_path, mapping, t=[at(0)], **{name: [value] for name, value in columns.items()})
    assert records(source) == [
        SpeedRecord(at(0), 10.0, 1500.0),
        ForceRecord(at(0), 2000.0),
        GradientRecord(at(0), 5.0, 0.0, tunnel=False),
        BrakeRecord(at(0), -0.3, emergency=False),
        MassRecord(at(0), 40e3),
    ]


def test_blank_cells_make_no_records_and_are_counted(tmp_path: Path) -> None:
    mapping = f'{SPEED}, force: {{field: F}}, brake_command: {{field: z, on_change: true}}}}'
    nan = np.nan
    source = mapped(
        tmp_path, mapping, t=[at(0), at(1), at(2)], v=[1.0, nan, 3.0], F=[nan, 5.0, nan], z=[nan, -0.5, nan]
    )
    found = records(source)
    assert [record.stamp_ns for record in found if isinstance(record, SpeedRecord)] == [at(0), at(2)]
    assert [record for record in found if isinstance(record, ForceRecord)] == [ForceRecord(at(1), 5.0)]
    # What is published on change only holds until it changes.
    assert [record for record in found if isinstance(record, BrakeRecord)] == [
        BrakeRecord(at(k), -0.5, emergency=False) for k in (1, 2)
    ]
    assert source.blank == {'time': 0, 'speed': 1, 'force': 2, 'brake_command': 1}


def test_a_part_of_a_sum_logged_less_often_is_interpolated(tmp_path: Path) -> None:
    mapping = f'{SPEED}, force: {{sum: [{{field: F}}, {{field: G}}]}}}}'
    source = mapped(tmp_path, mapping, t=[at(0), at(1), at(2)], v=[1.0] * 3, F=[1.0] * 3, G=[10.0, np.nan, 20.0])
    assert [record.force for record in records(source) if isinstance(record, ForceRecord)] == [11.0, 16.0, 21.0]
    columns = {'t': [at(0), at(1), at(20)], 'v': [1.0] * 3, 'F': [1.0] * 3, 'G': [10.0, np.nan, 20.0]}
    source = mapped(tmp_path, mapping, **columns)
    assert [record.force for record in records(source) if isinstance(record, ForceRecord)] == [11.0, 21.0]


def test_a_function_sees_whole_columns(tmp_path: Path) -> None:
    (tmp_path / 'code.py').write_text('import numpy as np\ndef total(x): return np.cumsum(x)\n', encoding='utf-8')
    mapping = """
        time: {function: code.py:total, of: [dt], unit: ms, start: 2024-03-08}
        speed: {function: code.py:total, of: [dv], unit: km/h}
    """
    count = ROWS_AT_ONCE + 2
    source = mapped(tmp_path, mapping, dt=np.full(count, 200), dv=np.full(count, 0.0036))
    shares, pieces = zip(*source.blocks(), strict=True)
    assert [len(piece) for piece in pieces] == [ROWS_AT_ONCE, 2]
    assert sum(shares) == pytest.approx(1.0)
    log_ns, last = pieces[-1][-1]
    assert isinstance(last, SpeedRecord)
    assert last.speed == pytest.approx(0.001 * count)
    assert log_ns == last.stamp_ns
    assert last.stamp_ns - pieces[0][0][1].stamp_ns == (count - 1) * NS_PER_S // 5


def test_a_function_is_not_asked_about_no_rows(tmp_path: Path) -> None:
    (tmp_path / 'code.py').write_text('def first(x): return 0.0 * x + x[0]\n', encoding='utf-8')
    mapping = '{time: {field: t}, speed: {function: code.py:first, of: [v]}}'
    assert records(mapped(tmp_path, mapping, t=np.empty(0), v=np.empty(0))) == []


def test_rows_are_logged_in_their_order(tmp_path: Path) -> None:
    source = mapped(tmp_path, f'{SPEED}}}', t=[at(5), at(1), at(6)], v=[1.0, 2.0, 3.0])
    ((_, found),) = source.blocks()
    assert [(log_ns, record.stamp_ns) for log_ns, record in found] == [(at(5), at(5)), (at(5), at(1)), (at(6), at(6))]
    assert source.steps_back == 1


def test_times_coarser_than_the_rows_are_an_error(tmp_path: Path) -> None:
    speeds = np.ones(100)
    source = mapped(tmp_path, f'{SPEED}}}', t=[at(5 * (k // 5)) for k in range(100)], v=speeds)
    error = r"log\.npz: row 2: column 't' has the time of the row before, as 80 of 100 rows have: its resolution"
    with pytest.raises(InputError, match=error):
        records(source)
    source = mapped(tmp_path, f'{SPEED}}}', t=[at(k - k % 2 * (k < 20)) for k in range(100)], v=speeds)
    assert len(records(source)) == 100
    assert source.repeated == 10


def test_rows_of_one_time_may_have_different_values(tmp_path: Path) -> None:
    nan = np.nan
    values: dict[str, object] = {'v': [1.0, nan, 2.0, nan], 'F': [nan, 5.0, nan, 6.0]}
    source = mapped(tmp_path, f'{SPEED}, force: {{field: F}}}}', t=[at(k // 2) for k in range(4)], **values)
    assert len(records(source)) == 4
    assert source.repeated == 0


@pytest.mark.parametrize(
    ('head', 'stated'),
    [
        ('t,v [km/h]\n', 'km/h'),
        ('t,v (kmh)\n', 'kmh'),
        ('t,v [KM/H]\n', 'KM/H'),
        ('t,v [Kmh]\n', 'Kmh'),
        ('t,v [mph]\n', 'mph'),
        ('t,v [m/s]\n', ''),
        ('t,v [x]\n', ''),
    ],
)
def test_a_unit_in_the_name_of_a_column_is_compared(tmp_path: Path, head: str, stated: str) -> None:
    path, name = tmp_path / 'log.csv', head.partition(',')[2].strip()
    path.write_text(f'{head}0,1\n', encoding='utf-8')
    mapping = parse_mapping(f"{{time: {{field: t}}, speed: {{field: '{name}'}}}}", 'map.yaml')
    source = TableRecords(path, MappedInputs(mapping, None))
    assert len(records(source)) == 1
    warning = f"{path}: column '{name}': the file says {stated}, the mapping m/s"
    assert source.warnings == ((warning,) if stated else ())


def test_a_file_that_is_no_table_is_named(tmp_path: Path) -> None:
    inputs = MappedInputs(parse_mapping(f'{SPEED}}}', 'map.yaml'), None)
    with pytest.raises(InputError, match='no such file'):
        TableRecords(tmp_path / 'none.csv', inputs)
    (tmp_path / 'log.xlsx').touch()
    with pytest.raises(InputError, match=r'log\.xlsx: not a table: \.csv, .*\.npz expected'):
        TableRecords(tmp_path / 'log.xlsx', inputs)


UNIX_2000 = 946_684_800
S = 10**9


def stamps(values: object, unit: str = 's', start_ns: int | None = None) -> list[int]:
    clock = Clock(TimeColumn(('t',), find_unit(unit, 'time'), start_ns))
    found, known = clock.stamps({'t': np.asarray(values)}, 'log.csv', 0)
    return [int(stamp) for stamp in found[known]]


@pytest.mark.parametrize(
    ('values', 'unit', 'expected'),
    [
        ([1_700_000_000.5], 's', [1_700_000_000 * S + S // 2]),
        ([1_700_000_000_123_456_789], 'ns', [1_700_000_000_123_456_789]),
        ([1_700_000_000_123_456], 'us', [1_700_000_000_123_456_000]),
        ([0, 250], 'ms', [UNIX_2000 * S, UNIX_2000 * S + S // 4]),
        ([0.0, np.nan, 1.5], 'min', [UNIX_2000 * S, (UNIX_2000 + 90) * S]),
        ([1], 'h', [(UNIX_2000 + 3600) * S]),
        (np.array(['2024-03-08T12:00', 'NaT'], dtype='datetime64[ns]'), 's', [1_709_899_200 * S]),
    ],
)
def test_times_are_stamps(values: object, unit: str, expected: list[int]) -> None:
    assert stamps(values, unit) == expected


def test_numbers_count_from_the_start_that_is_stated() -> None:
    assert stamps([0.0, 0.1], start_ns=5 * S) == [5 * S, 5 * S + S // 10]


def test_the_start_is_that_of_the_first_block() -> None:
    clock = Clock(TimeColumn(('t',), find_unit('s', 'time')))
    clock.stamps({'t': np.array([0.0])}, 'log.csv', 0)
    later, _ = clock.stamps({'t': np.array([4e7])}, 'log.csv', 1)
    assert later.tolist() == [(UNIX_2000 + 40_000_000) * S]


@pytest.mark.parametrize(('values', 'unit'), [([1.7e9], 'h'), ([-1.0], 'h'), ([10**18], 'ms'), ([1e300], 's')])
def test_a_time_that_ros_cannot_hold_names_row_and_column(values: list[float], unit: str) -> None:
    with pytest.raises(InputError, match=r"log\.csv: row 1: column 't' = .* is no time between 1970 and 2038"):
        stamps([*values], unit, 0)


@pytest.mark.parametrize(
    ('values', 'form', 'expected'),
    [
        ([45_244.5, np.nan], 'excel', [1_699_963_200 * S]),
        ([231320.25, 0.5, 100.0], 'HHMMSS', [UNIX_2000 * S + int(x * S) for x in (83_600.25, 86_400.5, 86_460)]),
        ([235959, 0], 'HHMMSS', [(UNIX_2000 + x) * S for x in (86_399, 86_400)]),
    ],
)
def test_numbers_of_a_form_are_times(values: list[float], form: str, expected: list[int]) -> None:
    clock = Clock(TimeColumn(('t',), find_unit('s', 'time'), format=form))
    found, known = clock.stamps({'t': np.array(values)}, 'log.csv', 0)
    assert found[known].tolist() == expected


@pytest.mark.parametrize(
    ('form', 'error'),
    [
        ('HHMMSS', r"log\.csv: column 't' holds numbers that are no times like HHMMSS"),
        ('%H:%M:%S', r"column 't' holds numbers, and time\.format = '%H:%M:%S' in the mapping is one of texts"),
    ],
)
def test_numbers_of_another_form_are_an_error(form: str, error: str) -> None:
    clock = Clock(TimeColumn(('t',), find_unit('s', 'time'), format=form))
    with pytest.raises(InputError, match=error):
        clock.stamps({'t': np.array([126_500.0])}, 'log.csv', 0)


def first_stamp(tmp_path: Path, text: str, time: str) -> int:
    path = tmp_path / 'log.csv'
    path.write_text(f't;v\n{text};1\n', encoding='utf-8')
    mapping = parse_mapping(f'{{time: {{field: t, {time}}}, speed: {{field: v}}}}', 'map.yaml')
    (record,) = records(TableRecords(path, MappedInputs(mapping, None)))
    return record.stamp_ns


@pytest.mark.parametrize(
    ('text', 'time'),
    [
        ('14/11/2023 23:13:20', 'zone: Europe/Berlin'),
        ('2023-11-14T22:13:20Z', 'zone: Europe/Berlin'),
        ('14.11.23 22-13-20', "format: '%d.%m.%y %H-%M-%S'"),
        ('23-11-14 10:13:20 PM', "format: '%y-%m-%d'"),
        ('45244.925925925926', 'format: excel'),
        ('45245.009259259259', "format: excel, zone: '+02:00'"),
        ('221320', 'format: HHMMSS, start: 2023-11-14T00:00:00'),
        ('231320', 'format: HHMMSS, start: 2023-11-14T00:00:00, zone: Europe/Berlin'),
        ('231320', "format: '%H%M%S', start: 2023-11-14T00:00:00, zone: Europe/Berlin"),
        ('1700000000000', 'unit: ms, zone: Europe/Berlin'),
    ],
)
def test_the_mapping_says_how_times_are_written(tmp_path: Path, text: str, time: str) -> None:
    assert first_stamp(tmp_path, text, time) == pytest.approx(1_700_000_000 * S, abs=1000)


def test_date_and_clock_may_be_two_columns(tmp_path: Path) -> None:
    path = tmp_path / 'log.csv'
    path.write_text('day;t;v\n03/04/2024;23:59:59;1\n04/04/2024;00:00:00;2\n', encoding='utf-8')
    mapping = '{time: {field: t, date: day, format: "%d/%m/%Y", zone: "+02:00"}, speed: {field: v}}'
    found = records(TableRecords(path, MappedInputs(parse_mapping(mapping, 'map.yaml'), None)))
    assert [record.stamp_ns - 1_712_181_600 * S for record in found] == [-S, 0]
    wrong = parse_mapping('{time: {field: t, date: v}, speed: {field: v}}', 'map.yaml')
    with pytest.raises(InputError, match='must be times of day and dates'):
        records(TableRecords(path, MappedInputs(wrong, None)))


def test_rows_without_a_date_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / 'log.csv'
    blank = ';12:00:00;1\n' * (ROWS_AT_ONCE + 1)
    path.write_text(f'day;t;v\n{blank}2024-04-03;12:00:00;2\n', encoding='utf-8')
    mapping = parse_mapping('{time: {field: t, date: day}, speed: {field: v}}', 'map.yaml')
    table = TableRecords(path, MappedInputs(mapping, None))
    assert [record.stamp_ns for record in records(table)] == [1_712_145_600 * S]
    assert table.blank['time'] == ROWS_AT_ONCE + 1


def test_codes_of_no_value_are_left_out_of_all_files(tmp_path: Path) -> None:
    source = mapped(tmp_path, f'{SPEED}, missing: [-999, off]}}', t=[at(0), at(1)], v=[-999.0, 2.0])
    assert [record.stamp_ns for record in records(source)] == [at(1)]
    assert source.blank['speed'] == 1


def test_times_of_day_go_on_through_midnight() -> None:
    hours = np.array([23, 'NaT', 1, 0.75, 23, 0], dtype=object)
    column = np.array([h if h == 'NaT' else int(h * 3600 * S) for h in hours], dtype='timedelta64[ns]')
    after = (23, 25, 24.75, 47, 48)  # a clock set back by a quarter of an hour is no midnight
    assert stamps(column) == [int((UNIX_2000 + h * 3600) * S) for h in after]
    assert stamps(column, start_ns=5 * S)[0] == (5 + 23 * 3600) * S
    clock = Clock(TimeColumn(('t',), find_unit('s', 'time')))
    found = [clock.stamps({'t': column[k : k + 1]}, 'log.csv', k)[0][0] for k in (0, 2)]
    assert found[1] - found[0] == 2 * 3600 * S  # also from block to block
    assert numbers(column[:1]).tolist() == [23 * 3600.0]


def test_times_are_numbers_for_functions() -> None:
    column: Column = np.array(['1970-01-01T00:00:01.5', 'NaT'], dtype='datetime64[ns]')
    assert numbers(column).tolist() == pytest.approx([1.5, np.nan], nan_ok=True)
