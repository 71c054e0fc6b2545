# SPDX-License-Identifier: Apache-2.0
"""Functions of a mapping; contents of mapping files, and errors that name the field."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from trainid_ros.inputs.mapping import (
    OWN,
    UNKNOWN_EFFORT,
    Constant,
    CsvFormat,
    LineLookup,
    Signal,
    SpeedIntegral,
    UserFunction,
    load_mapping,
    load_table_mapping,
    parse_mapping,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.stream.alignment import AlignmentConfig

CODE = """
import numpy as np
def double(x, y): return 2.0 * x + y
def short(x): return x[1:]
def words(x): return ['a'] * len(x)
def broken(x): raise RuntimeError('no\\nway')
def gone(x): raise SystemExit(0)
number = 3
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / 'code.py').write_text(CODE, encoding='utf-8')
    (tmp_path / 'bad.py').write_text('1 +', encoding='utf-8')
    (tmp_path / 'sub').mkdir()
    (tmp_path / 'sub' / 'other.py').write_text(CODE, encoding='utf-8')
    return tmp_path


def function(folder: Path, text: str, unit: str = 'kN') -> UserFunction:
    top = f'force: {{function: "{text}", of: [{{topic: a, field: x}}], unit: {unit}}}'
    signal = parse_mapping(top, str(folder / 'map.yaml')).force
    assert signal is not None
    assert signal.function is not None
    return signal.function


def test_columns_and_single_numbers_give_the_same_in_the_unit_of_the_interface(folder: Path) -> None:
    double = function(folder, 'code.py:double')
    assert double.of_columns([np.array([1.0, np.nan]), np.array([3.0, 4.0])]).tolist() == pytest.approx(
        [5000.0, np.nan], nan_ok=True
    )
    assert double.of_numbers([1.0, 3.0]) == 5000.0
    assert not (folder / '__pycache__').exists()


@pytest.mark.parametrize(
    ('text', 'error'),
    [
        ('code.py', 'must be a Python file and a function in it'),
        ('code.txt:double', 'must be a Python file and a function in it'),
        ('code.py:a.b', 'must be a Python file and a function in it'),
        ('none.py:double', 'is not there'),
        ('sub/other.py:double', 'must lie in the folder'),
        ('../code.py:double', 'must lie in the folder'),
        ('/tmp/code.py:double', 'must lie in the folder'),
    ],
)
def test_only_files_of_the_folder_are_taken(folder: Path, text: str, error: str) -> None:
    with pytest.raises(InputError, match=error):
        function(folder, text)


def test_a_link_out_of_the_folder_is_refused(folder: Path) -> None:
    (folder / 'link.py').symlink_to(folder / 'sub' / 'other.py')
    with pytest.raises(InputError, match='must lie in the folder'):
        function(folder, 'link.py:double')


@pytest.mark.parametrize(
    ('text', 'error'),
    [
        ('bad.py:double', r'bad\.py: cannot be run: SyntaxError'),
        ('code.py:none', r'code\.py: has no function none'),
        ('code.py:number', r'code\.py: has no function number'),
        ('code.py:gone', r'code\.py:gone failed in line 7: SystemExit: 0'),
        ('code.py:broken', r'code\.py:broken failed in line 6: RuntimeError: no'),
        ('code.py:words', r'code\.py:words failed: ValueError'),
        ('code.py:short', r'code\.py:short returned shape \(2,\), \(3,\) expected'),
        ('code.py:double', r'code\.py:double failed: TypeError'),
    ],
)
def test_what_a_function_does_wrong_is_said(folder: Path, text: str, error: str) -> None:
    with pytest.raises(InputError, match=error):
        function(folder, text).of_columns([np.zeros(3)])


WHOLE = """
speed: {topic: /odo/twist, field: twist.linear.x, unit: km/h, sign: -1, offset: 0.5, stamp: receive}
position: {from: speed, start: 1200.0, direction: -1}
force: {sum: [{topic: car1/force, field: 'data[0]', unit: kN}, {topic: car2/force, field: data.1, gain: 2.0}]}
gradient: {from: line}
brake_command: {topic: /notch, field: data, table: {0: 0.0, 1: -0.3, 2: -0.6}, on_change: true}
mass: {topic: /load, field: data, unit: t}
"""


def test_a_whole_mapping_is_read() -> None:
    mapping = parse_mapping(WHOLE, 'map.yaml')
    assert isinstance(mapping.speed, Signal)
    (speed,) = mapping.speed.sources
    assert (speed.topic, speed.path, speed.sign, speed.offset) == ('/odo/twist', ('twist', 'linear', 'x'), -1.0, 0.5)
    assert not speed.has_stamps
    assert mapping.position == SpeedIntegral(1200.0, -1)
    assert mapping.gradient == LineLookup()
    assert isinstance(mapping.force, Signal)
    assert [source.path for source in mapping.force.sources] == [('data', 0), ('data', 1)]
    assert [source.topic for source in mapping.sources] == ['/odo/twist', 'car1/force', 'car2/force', '/notch', '/load']
    assert mapping.replaced == {'ato/speed', 'ato/force', 'ato/gradient', 'ato/brake_command', 'ato/mass'}
    assert mapping.needed('ato/force') == ('car1/force', 'car2/force')
    assert mapping.needed('ato/gradient') == ()


def test_only_a_brake_may_be_unknown() -> None:
    text = '{topic: /brake, field: data, unit: percent_of 1.2 m/s^2, table: {0: 0.0, 1: unknown}}'
    signal = parse_mapping(f'brake_command: {text}', 'map.yaml').brake_command
    assert isinstance(signal, Signal)
    (source,) = signal.sources
    assert source.value(1) == replace(source, sign=-1.0).value(1) == UNKNOWN_EFFORT
    with pytest.raises(InputError, match='unknown'):
        parse_mapping('gradient: {topic: /g, field: data, table: {1: unknown}}', 'map.yaml')


TABLE = """
time: {field: 't [ms]', unit: ms, start: 2024-03-08T12:00:00Z}
csv: {separator: ';', decimal: ',', header_rows: 2, encoding: latin-1, comments: false}
speed: {field: v, unit: km/h}
force: {sum: [{field: F 1, unit: kN}, {field: F.2, unit: kN, sign: -1}]}
brake_command: {value: -10.0, unit: percent_of 1.2 m/s^2}
gradient: {value: 3.0}
"""


def test_a_whole_mapping_of_a_table_is_read(tmp_path: Path) -> None:
    path = tmp_path / 'map.yaml'
    path.write_text(TABLE, encoding='utf-8')
    mapping = load_table_mapping(path)
    assert mapping.time is not None
    assert mapping.time.columns == ('t [ms]',)
    assert (mapping.time.unit.factor, mapping.time.start_ns) == (1e-3, 1_709_899_200 * 10**9)
    assert mapping.csv == CsvFormat(';', ',', 2, 'latin-1', comments=False)
    assert [source.field for source in mapping.sources] == ['v', 'F 1', 'F.2']
    assert isinstance(mapping.brake_command, Constant)
    assert mapping.brake_command.value == pytest.approx(-0.12)
    assert mapping.gradient == Constant(3.0)
    with pytest.raises(InputError, match=r'map\.yaml: time is of the rows of a table'):
        load_mapping(path)


NEEDED = 'is missing: a table needs a column for it'


@pytest.mark.parametrize(
    ('text', 'error'),
    [
        ('speed: {topic: /v, field: data}', f'time {NEEDED}'),
        ('speed: {field: v}', f'time {NEEDED}'),
        ('time: {field: t}', f'speed {NEEDED}'),
        ('{time: {field: t}, sped: {field: v}}', 'sped is not a known field'),  # rather than the one that is missing
    ],
)
def test_what_a_table_needs_is_named(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / 'map.yaml'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match=rf'map\.yaml: {error}'):
        load_table_mapping(path)


def test_a_function_is_named_with_what_it_gets(tmp_path: Path) -> None:
    (tmp_path / 'code.py').write_text('def force(x, y): return x + y', encoding='utf-8')
    of = '[{topic: /a, field: data}, {topic: /b, field: x.y, stamp: receive}]'
    text = f'force: {{function: code.py:force, of: {of}, unit: kN}}'
    force = parse_mapping(text, str(tmp_path / 'map.yaml')).force
    assert isinstance(force, Signal)
    assert force.function is not None
    assert (force.function.name, force.function.unit.name) == ('force', 'kN')
    found = [(source.topic, source.field, source.has_stamps) for source in force.sources]
    assert found == [('/a', 'data', True), ('/b', 'x.y', False)]


def test_texts_name_the_topics_that_are_read() -> None:
    mapping = parse_mapping(WHOLE, 'map.yaml')
    text = mapping.named('no ato/force at the stamps of ato/speed')
    assert text == 'no car1/force + car2/force at the stamps of /odo/twist'
    assert mapping.named('ato/gradient, not /t1/ato/speed') == 'the gradient of the mapping, not /t1/ato/speed'
    assert OWN.named('no ato/force') == 'no ato/force'


def test_what_is_missing_is_the_topic_of_our_own() -> None:
    mapping = parse_mapping('mass: {topic: /load, field: data}', 'map.yaml')
    assert mapping.replaced == {'ato/mass'}
    assert mapping.needed('ato/speed') == ('ato/speed',)
    assert parse_mapping('{}', 'map.yaml') == OWN


@pytest.mark.parametrize(('given', 'expected'), [(0.0, 3600.0), (600.0, 600.0)])
def test_commands_published_only_on_change_hold(given: float, expected: float) -> None:
    config = AlignmentConfig(command_hold=given)
    assert parse_mapping(WHOLE, 'map.yaml').alignment(config).command_hold == expected
    assert OWN.alignment(config) == config


def test_a_value_passes_sign_gain_offset_table_and_unit() -> None:
    mapping = parse_mapping(WHOLE, 'map.yaml')
    assert isinstance(mapping.speed, Signal)
    assert isinstance(mapping.brake_command, Signal)
    twist = SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=-35.5)))
    speed = mapping.speed.sources[0]
    assert speed.value(speed.raw(twist)) == pytest.approx(10.0)
    notch = mapping.brake_command.sources[0]
    assert notch.value(notch.raw(SimpleNamespace(data=2))) == -0.6
    assert np.isnan(notch.value(7))  # no such notch
    for message in (SimpleNamespace(), SimpleNamespace(data='x'), SimpleNamespace(data=[1.0])):
        with pytest.raises(InputError, match='topic /notch: field data is not a number'):
            notch.raw(message)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('speeed: {}', "speeed is not a known field; did you mean 'speed'"),
        ('speed: 3', 'speed = 3 must be a mapping'),
        ('speed: {field: data}', 'speed.topic is missing; where the field is a column of a table, time: '),
        ('speed: {topic: /x}', 'speed.field is missing'),
        ('speed: {topic: /x, field: a b}', 'speed.field'),
        ('speed: {topic: /x, field: x..y}', 'speed.field'),
        ('speed: {topic: /x, field: x.²}', "speed.field = 'x.²' must be names of fields"),
        ('speed: {topic: /x, field: x, unit: kN}', "speed.unit = 'kN' is not a unit of speed"),
        ('speed: {topic: /x, field: x, sign: 2}', 'speed.sign = 2 must be 1 or -1'),
        ('speed: {topic: /x, field: x, stamp: now}', 'speed.stamp'),
        ('speed: {topic: /x, field: x, on_change: true}', 'speed.on_change is not a known field'),
        ('position: {from: force}', 'position.from'),
        ('position: {from: speed, direction: 0}', 'position.direction'),
        ('gradient: {from: speed}', 'gradient.from'),
        ('force: {sum: []}', 'force.sum'),
        ('force: {sum: [{topic: /x}]}', r'force.sum\[0\].field is missing'),
        (
            'force: {sum: [{topic: /x, field: y}, {topic: /z, field: y}, {topic: /x, field: y, gain: 2}]}',
            r"force.sum\[2\].field = 'y' is in the sum already",
        ),
        ('{time: {field: t}, force: {sum: [f, f]}}', r"force.sum\[1\].field = 'f' is in the sum already"),
        ('brake_command: {topic: /x, field: x, table: {}}', 'brake_command.table'),
        ('brake_command: {topic: /x, field: x, table: {a: 1.0}}', 'brake_command.table'),
        ('brake_command: {topic: /x, field: x, table: {0: 0, 1: 0.3}}', r'brake_command.table.1 gives 0.3 m/s\^2'),
        ('brake_command: {topic: /x, field: x, sign: -1, table: {1: -0.3}}', 'brake_command.table.1 gives 0.3'),
        ('brake_command: {value: 0.3}', 'brake_command.value gives 0.3'),
        ('brake_command: {topic: /x, field: x, on_change: 1}', 'brake_command.on_change'),
        ('brake_command: {value: x}', "brake_command.value = 'x' must be a number"),
        ('brake_command: {value: 0, topic: /x}', 'brake_command.topic is not a known field'),
        ('force: {function: none.py:f, of: [{topic: /x, field: x}]}', "force.function = 'none.py:f' is not there"),
        ('{time: {field: t}, force: {topic: /x, field: x}}', 'force.topic is not a known field'),
        ('{time: {field: t, unit: km}}', "time.unit = 'km' is not a unit of time"),
        ('{time: {field: t, start: now}}', "time.start = 'now' must be a date and time"),
        ('time: {unit: s}', 'time.field is missing'),
        ('csv: {separator: ab}', "csv.separator = 'ab' must be one character"),
        ('csv: {comments: x}', "csv.comments = 'x' must be true or false"),
        ('csv: {decimal: x}', "csv.decimal = 'x' must be . or ,"),
        ('csv: {encoding: none}', "csv.encoding = 'none' is not known"),
        ('csv: {header_rows: 0}', 'csv.header_rows = 0 must be >= 1'),
        (
            '{time: {field: t, zone: Europe/Berlim}}',
            "time.zone = 'Europe/Berlim' is no zone .* did you mean 'Europe/Berlin'",
        ),
        ('{time: {field: t, zone: UTC, start: 2024-03-08T12:00:00Z}}', 'time.zone is of a start without a zone'),
        ('{time: {field: t, format: DD/MM/YYYY}}', "time.format = 'DD/MM/YYYY' must be like '%d/%m/%Y'"),
        ('missing: none', 'missing'),
        ('chainage: [[1.0, 2.0]]', 'chainage is of measured positions'),
        ('{position: {from: speed}, chainage: [[1.0, 2.0]]}', 'chainage is of measured positions'),
        ('position: {topic: /x, field: x, chainage: [[1.0, 2.0]]}', r'position\.chainage stands beside position'),
        ('{position: {topic: /x, field: x}, chainage: [[1.0, 0.0]]}', r'chainage\[0\] = \[1, 0\] must jump'),
        ('{position: {topic: /x, field: x}, chainage: [[9.0, 2.0], [11.0, 2.0]]}', r'chainage\[1\] = \[11, 2\] must'),
        ('{position: {topic: /x, field: x}, chainage: [[9.0]]}', r'chainage\[0\] = \[9.0\] must be \[m, m\]'),
    ],
)
def test_an_impossible_mapping_is_rejected_by_field(text: str, message: str) -> None:
    with pytest.raises(InputError, match=f'map.yaml: {message}'):
        parse_mapping(text, 'map.yaml')
