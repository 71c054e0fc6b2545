# SPDX-License-Identifier: Apache-2.0
"""Suggested mappings of tables: which column is the time, and names and units of several languages."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping import load_table_mapping
from trainid_ros.inputs.tables import TableRecords
from trainid_ros.inspection.choice import Suggestion
from trainid_ros.inspection.suggest import suggest
from trainid_ros.inspection.table_numbers import read_table
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, SpeedRecord
from trainid_ros.train.train_file import TrainFile

START = datetime(2023, 11, 14, 23, 13, 20, tzinfo=UTC)
START_NS = 1_700_003_600 * NS_PER_S
HZ = 5
COUNT = 80 * HZ
Row = tuple[float, float, float, float, float, float]


def driven() -> list[Row]:
    """Return rows of 300 t on a line with a slope: time, speed, position, force, gradient, brake, in SI units."""
    rows, speed, position = [], 0.0, 100.0
    for k in range(COUNT):
        t = k / HZ
        gradient = 12.0 if 300.0 < position < 500.0 else 0.0
        brake = 0.0 if t < 45.0 else 0.3 if t < 55.0 else 0.8 if t < 62.0 else 0.0
        force = 250e3 if t < 25.0 else 20e3 if t < 45.0 else -324e3 * brake
        rows.append((t, speed, position, force, gradient, brake))
        slope = force / 324e3 - 0.0091 * gradient - 0.02 - 0.00003 * speed**2
        position += speed / HZ
        speed = max(0.0, speed + slope / HZ)
    return rows


@pytest.fixture(scope='module')
def rows() -> list[Row]:
    return driven()


def write(path: Path, head: str, rows: list[Row], line: Callable[..., str], encoding: str = 'utf-8') -> Path:
    path.write_bytes('\n'.join((head, *(line(*row) for row in rows))).encode(encoding))
    return path


def text_of(path: Path, train_file: TrainFile | None = None) -> Suggestion:
    numbers, choices = read_table(path)
    return suggest(numbers, path.name, train_file, choices)


def lines_of(suggestion: Suggestion) -> list[str]:
    """Return the lines of a mapping without comments."""
    return [line for line in suggestion.text().splitlines() if line and not line.startswith('#')]


def clock(t: float, form: str) -> str:
    return (START + timedelta(seconds=t)).strftime(form)


def english(t: float, v: float, x: float, f: float, i: float, b: float) -> str:
    return f'{t:.1f},{2.23694 * v:.3f},{x / 1609.344:.5f},{f / 1e3:.1f},{i / 10.0:.2f},{b:.2f}'


def american(t: float, v: float, x: float, f: float, i: float, b: float) -> str:
    when, rest = clock(t, '%m/%d/%Y,%I:%M:%S.%f %p'), f'{x / 1609.344:.5f},{f / 4448.2216:.4f},{0.1 * i:.2f},{-b:.2f}'
    return f'{when},{v / 0.44704:.4f},{rest}'


def german(t: float, v: float, x: float, f: float, i: float, b: float) -> str:
    numbers = f'{3.6 * v + 1.0:.2f};{3.6 * v:.2f};{x:.1f};{f / 1e3:.1f};{i:.2f};{b / 0.01:.1f}'.replace('.', ',')
    return f'{clock(t, "%d.%m.%y %H:%M:%S.%f")};{numbers}'


def french(t: float, v: float, x: float, f: float, i: float, b: float) -> str:
    return f'{clock(t, "%d/%m/%Y %H:%M:%S.%f")};{3.6 * v:.2f};{x / 1e3:.5f};{f / 2e3:.1f};{f / 2e3:.1f};{i:.2f};{b:.2f}'


def chinese(t: float, v: float, x: float, f: float, i: float, b: float) -> str:
    notch = 0 if b == 0.0 else 1 if b < 0.5 else 2
    return f'{clock(t, "%Y/%m/%d %H:%M:%S.%f")},{3.6 * v:.2f},80,{0.1 * v:.2f},{x:.1f},{f / 1e3:.1f},{i:.2f},{notch}'


@pytest.mark.parametrize(
    ('head', 'line', 'encoding', 'expected'),
    [
        (
            'Time (s),Speed (mph),Distance (mi),Tractive effort (kN),Grade (%),Brake demand (m/s²)',
            english,
            'utf-8',
            [
                'time: {field: "Time (s)", unit: s}',
                'speed: {field: "Speed (mph)", unit: mph}',
                'position: {field: "Distance (mi)", unit: mi}',
                'force: {field: "Tractive effort (kN)", unit: kN}',
                'gradient: {field: "Grade (%)", unit: percent}',
                'brake_command: {field: "Brake demand (m/s²)", unit: "m/s^2", sign: -1}',
            ],
        ),
        (
            'Date,Clock,Speed (mph),Milepost,Tractive Effort (klbf),Grade (%),Brake (m/s²)',
            american,
            'utf-8',
            [
                'time: {field: Clock, date: Date}',
                'speed: {field: "Speed (mph)", unit: mph}',
                'position: {field: Milepost, unit: mi}',
                'force: {field: "Tractive Effort (klbf)", unit: klbf}',
            ],
        ),
        (
            'Zeit;Sollgeschwindigkeit;Istgeschwindigkeit;Weg;Zugkraft;Längsneigung;Bremse\n;km/h;km/h;m;kN;‰;%',
            german,
            'cp1252',
            [
                'time: {field: Zeit}',
                'speed: {field: Istgeschwindigkeit, unit: km/h}',
                'position: {field: Weg, unit: m}',
                'force: {field: Zugkraft, unit: kN}',
                'gradient: {field: "Längsneigung", unit: per_mille}',
                'brake_command: {field: Bremse, unit: "percent_of 1 m/s^2", sign: -1}',
            ],
        ),
        (
            'Horodatage;Vitesse;PK;Effort 1;Effort 2;Déclivité;Freinage',
            french,
            'utf-8-sig',
            [
                'time: {field: Horodatage}',
                'speed: {field: Vitesse, unit: km/h}',
                'position: {field: PK, unit: km}',
                'force:',
                '    - {field: "Effort 1", unit: kN}',
                '    - {field: "Effort 2", unit: kN}',
                'gradient: {field: "Déclivité", unit: per_mille}',
                'brake_command: {field: Freinage, unit: "m/s^2", sign: -1}',
            ],
        ),
        (
            '时间,速度,限速,加速度,里程(米),牵引力(千牛),坡度(‰),制动级位',
            chinese,
            'gb18030',
            [
                'time: {field: "时间"}',
                'speed: {field: "速度", unit: km/h}',
                'position: {field: "里程(米)", unit: m}',
                'force: {field: "牵引力(千牛)", unit: kN}',
                'gradient: {field: "坡度(‰)", unit: per_mille}',
                'brake_command: {field: "制动级位", table: {0: 0, 1: -0.3, 2: -0.8}}',
            ],
        ),
    ],
)
def test_a_table_is_mapped_by_names_units_and_numbers(
    tmp_path: Path, rows: list[Row], metro: TrainFile, head: str, line: Callable[..., str], encoding: str,
    expected: list[str],
) -> None:  # fmt: skip
    path = write(tmp_path / 'log.csv', head, rows, line, encoding)
    train = TrainFile(type(metro.train)(mass=300e3, rotary_mass=0.08), metro.resistance)
    suggestion = text_of(path, train)
    assert set(expected) <= set(lines_of(suggestion))
    assert not suggestion.missing
    (tmp_path / 'map.yaml').write_text(suggestion.text(), encoding='utf-8')
    records = TableRecords(path, MappedInputs(load_table_mapping(tmp_path / 'map.yaml'), train))
    speeds = [record for _, some in records.blocks() for _, record in some if isinstance(record, SpeedRecord)]
    assert [record.speed for record in speeds] == pytest.approx([row[1] for row in rows], abs=0.01)


TIMES = [
    ('t', lambda t: f'{1e3 * t:.0f}', 'unit: ms', 'only by its steps of 200'),
    ('stamp', lambda t: f'{1_700_000_000_000 + 1e3 * t:.0f}', 'unit: ms', 'since 1970'),
    ('t [us]', lambda t: f'{1e6 * t:.0f}', 'unit: us', 'stated'),
    ('utc', lambda t: clock(t, '%H%M%S.%f'), 'format: HHMMSS', 'start: 2024'),
    ('Datum', lambda t: f'{45_244 + t / 86_400.0:.9f}', 'format: excel', 'zone: Europe'),
    ('Date', lambda t: clock(t, '04/03/2023 %I:%M:%S.%f %p'), "format: '%m/%d/%Y'", 'several orders'),
    ('clock', lambda t: clock(t, '%H:%M:%S.%f'), '', 'start: 2024'),
    ('x', lambda t: clock(t, '%Y-%m-%dT%H:%M:%S.%fZ'), '', ''),
    ('when', lambda t: clock(t, '%a %b %d %H:%M:%S.%f %Y'), '', 'zone: Europe'),
    (
        'm',
        lambda t: f'{int(t + 3560.0) // 60 % 60:02}:{(t + 3560.0) % 60.0:04.1f}',
        "format: '%M:%S.%f'",
        'the hour is missing',
    ),
    ('at', lambda t: clock(t, '%Y/%m/%d-%H:%M:%S.%f'), '', 'zone: Europe'),
]


@pytest.mark.parametrize(('name', 'cell', 'form', 'said'), TIMES, ids=[entry[0] for entry in TIMES])
def test_the_time_is_found_with_its_form(
    tmp_path: Path, rows: list[Row], name: str, cell: Callable[[float], str], form: str, said: str
) -> None:
    path = write(tmp_path / 'log.csv', f'No,{name},v,note', rows, lambda t, v, *_: f'{HZ * t:.0f},{cell(t)},{v:.3f},ok')
    numbers, (time, *_) = read_table(path)
    field = f'"{name}"' if ' ' in name else name
    assert time.text == f'{{field: {field}{form and ", "}{form}}}'
    assert said in ' '.join((*time.reasons, *time.decisions))
    assert numbers.duration_s == pytest.approx((COUNT - 1) / HZ)
    assert numbers.left_out == (('note', 'no numbers or times'),)


def test_a_date_that_is_blank_at_first_is_found(tmp_path: Path, rows: list[Row]) -> None:
    def line(t: float, v: float, *_: float) -> str:
        return f'{"14.11.2023" if t > 50.0 else ""},{clock(t, "%H:%M:%S.%f")},{v:.3f}'

    numbers, (time, *_) = read_table(write(tmp_path / 'log.csv', 'Date,Clock,v', rows, line))
    assert time.text == '{field: Clock, date: Date}'
    assert f'251 of {COUNT} rows have no date' in time.decisions[0]
    assert numbers.duration_s == pytest.approx(80.0 - 50.2 - 0.2)


def test_a_file_without_a_time_is_refused(tmp_path: Path, rows: list[Row]) -> None:
    path = write(tmp_path / 'log.csv', 'v;F', rows, lambda _t, v, _x, f, *_: f'{v:.3f};{f:.1f}')
    with pytest.raises(InputError, match=r'log\.csv: no column is a time \(columns: v, F\)'):
        read_table(path)


@pytest.mark.parametrize(
    ('cell', 'why'),
    [
        (
            lambda t: clock(t, '%d %b %Y %H:%M:%S'),
            r"; no numbers .* 'Zeit' \(but '14 Nov 2023 23:13:59'\); time: \{format: '%d",
        ),
        (lambda t: clock(t, '%H:%M:%S'), '; column Zeit does not rise from row to row$'),
    ],
)
def test_a_time_that_is_refused_is_shown(
    tmp_path: Path, rows: list[Row], cell: Callable[[float], str], why: str
) -> None:
    path = write(tmp_path / 'log.csv', 'Zeit;v', rows, lambda t, v, *_: f'{cell(t)};{v:.3f}')
    with pytest.raises(InputError, match=rf'no column is a time \(columns: Zeit, v\){why}'):
        read_table(path)


@pytest.mark.parametrize(
    ('cell', 'said'),
    [('1.{:03d}', 'v: all numbers are like 1.250'), ('1,{:03d}', 'a comma before three digits')],
)
def test_numbers_that_may_be_others_are_a_doubt(tmp_path: Path, rows: list[Row], cell: str, said: str) -> None:
    path = write(tmp_path / 'log.csv', 't;v', rows, lambda t, *_: f'{HZ * t:.0f};{cell.format(round(HZ * t))}')
    _, (_, csv) = read_table(path)
    assert said in csv.decisions[0]
    assert csv.text == ('{decimal: ","}' if ',' in cell else '')


def test_a_sign_is_that_of_all_columns_beside_one_of_texts(tmp_path: Path, rows: list[Row]) -> None:
    def line(t: float, v: float, x: float, *_: float) -> str:
        return f'{t:.3f};{v:.2f};Nord;'.replace('.', ',') + f'{1000 + x:,.0f}'.replace(',', '.')

    path = write(tmp_path / 'log.csv', 't;v;Ort;Weg', rows, line)
    found = lines_of(text_of(path))
    position = 'position: {field: Weg, unit: m}'
    assert found == ['time: {field: t, unit: s}', 'csv: {decimal: ","}', 'speed: {field: v, unit: m/s}', position]
    assert not read_table(path)[1][1].decisions


def test_a_column_of_another_decimal_sign_is_left_out(tmp_path: Path, rows: list[Row]) -> None:
    path = write(tmp_path / 'log.csv', 't;v', rows, lambda t, v, *_: f'{t:.3f};' + f'{v:.2f}'.replace('.', ','))
    numbers, (_, csv) = read_table(path)
    assert numbers.left_out == (('v', 'another decimal sign'),)
    assert csv.text == '{decimal: "."}'


@pytest.mark.parametrize(
    ('cell', 'table'),
    [
        (lambda brake: {0.0: '4', 0.3: '2', 0.8: '0'}[brake], '{0: -0.8, 2: -0.3, 4: 0}'),
        (lambda brake: 'true' if brake > 0.5 else 'false', '{0: 0, 1: -0.8}'),
    ],
)
def test_notches_of_any_order_and_flags_get_a_table(
    tmp_path: Path, rows: list[Row], metro: TrainFile, cell: Callable[[float], str], table: str
) -> None:
    def line(t: float, v: float, _x: float, f: float, _i: float, brake: float) -> str:
        return f'{t:.3f},{v:.3f},{f / 1e3:.1f},{cell(brake)}'

    path = write(tmp_path / 'log.csv', 't,v,F,brake', rows, line)
    found = text_of(path, TrainFile(type(metro.train)(mass=300e3, rotary_mass=0.08), metro.resistance))
    assert lines_of(found)[-1] == f'brake_command: {{field: brake, table: {table}}}'
    assert 'the nominal deceleration of each notch' in found.choices[-1].decisions


@pytest.mark.parametrize(('name', 'scale'), [('F [kN]', 1e3), ('effort', 1e3), ('F [kN]', 1e5)])
def test_a_force_in_few_whole_units_is_no_notch(tmp_path: Path, rows: list[Row], name: str, scale: float) -> None:
    def line(t: float, v: float, _x: float, f: float, _i: float, brake: float) -> str:
        return f'{t:.1f},{v:.3f},{f / scale:.0f},{4 * (brake > 0.5):.0f}'

    found = lines_of(text_of(write(tmp_path / 'log.csv', f't [s],v [m/s],{name},brake', rows, line)))
    assert found[2].startswith('force: {field: ')
    assert 'table' in found[3]


def test_an_effort_of_few_small_whole_numbers_is_no_force(tmp_path: Path, rows: list[Row]) -> None:
    def line(t: float, v: float, _x: float, f: float, *_: float) -> str:
        return f'{t:.1f},{v:.3f},{f / 1e5:.0f},0'

    found = lines_of(text_of(write(tmp_path / 'lever.csv', 't [s],v [m/s],effort,brake', rows, line)))
    assert not any(line.startswith('force') for line in found)


def test_a_force_of_traction_alone_shows_no_brake(tmp_path: Path, rows: list[Row], metro: TrainFile) -> None:
    def line(t: float, v: float, _x: float, f: float, _i: float, brake: float) -> str:
        return f'{t:.3f},{v:.3f},{max(f, 0.0) / 1e3:.1f},{4 * (brake > 0.0):.0f}'

    path = write(tmp_path / 'log.csv', 't,v,F,brake', rows, line)
    found = text_of(path, TrainFile(type(metro.train)(mass=300e3, rotary_mass=0.08), metro.resistance))
    force, brake = found.choices[2:]
    assert 'it is never negative' in force.decisions[-1]
    assert dict(brake.parts[0].table)[4.0] == pytest.approx(-0.35, abs=0.1)
    assert 'd(speed)/dt while it holds' in brake.reasons[-1]


@pytest.mark.parametrize(('code', 'said'), [('-999', '-999'), ('6553.50', '6553.5'), ('0.00', '')])
def test_codes_of_no_value_are_left_out(tmp_path: Path, rows: list[Row], code: str, said: str) -> None:
    def line(t: float, v: float, x: float, *_: float) -> str:
        return f'{t:.3f},{code if round(HZ * t) % 50 == 0 else f"{3.6 * v:.2f}"},{x:.1f}'

    found = text_of(write(tmp_path / 'log.csv', 't,v,x', rows, line))
    missing = [f'missing: [{said}]'] if said else []
    speed = ['speed: {field: v, unit: km/h}', 'position: {field: x, unit: m}']
    assert lines_of(found) == ['time: {field: t, unit: s}', *missing, *speed]


def test_of_alike_speeds_the_nearest_to_the_position_is_taken(tmp_path: Path, rows: list[Row]) -> None:
    def line(t: float, v: float, x: float, *_: float) -> str:
        return f'{t:.3f},{3.72 * v:.3f},{3.6 * v:.3f},{x:.3f}'

    path = write(tmp_path / 'log.csv', 't,v_wheel [km/h],v [km/h],x', rows, line)
    assert lines_of(text_of(path))[1] == 'speed: {field: "v [km/h]", unit: km/h}'


def test_a_few_seconds_of_speed_have_a_unit_by_their_size(tmp_path: Path) -> None:
    path = write(
        tmp_path / 'short.csv', 't [ms],v', driven()[:50], lambda t, v, *_: f'{4.0 * HZ * t:.0f},{80.0 + v:.3f}'
    )
    text = text_of(path).text()
    assert '#   unit km/h: up to 8' in text
    assert 'a second' not in text


@pytest.mark.parametrize('unit', ['m/s', 'km/h'])
def test_a_speed_beyond_that_of_the_train_is_a_doubt(
    tmp_path: Path, rows: list[Row], metro: TrainFile, unit: str
) -> None:
    path = write(tmp_path / 'log.csv', f't,v [{unit}]', rows, lambda t, v, *_: f'{t:.3f},{3.6 * v:.3f}')
    (speed,) = (choice for choice in text_of(path, metro).choices if choice.quantity == 'speed')
    assert any('max_speed' in text for text in speed.decisions) == (unit == 'm/s')


@pytest.mark.parametrize('suffix', ['npz', 'parquet'])
def test_other_files_are_read_too(tmp_path: Path, rows: list[Row], suffix: str) -> None:
    t, v, x, f, *_ = np.array(rows).T
    columns = {'t': t, 'speed': v, 'x': x, 'F': f / 1e3}
    path = tmp_path / f'log.{suffix}'
    if suffix == 'npz':
        np.savez(path, note=np.zeros((2, 2)), **columns)
    else:
        parquet.write_table(pa.table({**columns, 'note': ['ok'] * len(t)}), path)
    expected = ['time: {field: t, unit: s}', 'speed: {field: speed, unit: m/s}', 'position: {field: x, unit: m}']
    found = lines_of(text_of(path))
    assert found == [*expected, 'force: {field: F, unit: kN}']
