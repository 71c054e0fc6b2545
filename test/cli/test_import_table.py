# SPDX-License-Identifier: Apache-2.0
"""``trainid import``: from a table to a bag."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord

ROOT = Path(__file__).parents[2]
MAPPING = """
time:          {field: Zeit, start: 2023-11-14T22:13:20Z}
speed:         {field: v, unit: km/h}
position:      {field: Weg, unit: km}
force:         {field: F, unit: kN}
gradient:      {field: Steigung, unit: deg}
brake_command: {field: Bremse, unit: percent_of 1.2 m/s^2, sign: -1}
"""


@pytest.fixture(scope='module')
def driven(driven_bag: Path) -> list[tuple[Record, ...]]:
    """Return what a bag holds at each of its speeds."""
    found: dict[type[Record], list[Record]] = {}
    with BagReader(driven_bag) as reader:
        for record in reader.records():
            found.setdefault(type(record), []).append(record)
    return list(zip(*(found[kind] for kind in (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord)), strict=True))


def write(folder: Path, driven: list[tuple[Record, ...]]) -> Path:
    """Write a CSV file as a German logger does, and its mapping; return the file."""
    start_ns = 1_700_000_000 * NS_PER_S
    lines = ['Fahrzeug;4711', 'Zeit;v;Weg;F;Steigung;Bremse', 's;km/h;km;kN;°;%']
    for speed, force, gradient, brake in driven:
        assert isinstance(speed, SpeedRecord)
        assert isinstance(force, ForceRecord)
        assert isinstance(gradient, GradientRecord)
        assert isinstance(brake, BrakeRecord)
        row = (
            (speed.stamp_ns - start_ns) / NS_PER_S,
            3.6 * speed.speed,
            speed.position / 1e3,
            force.force / 1e3,
            math.degrees(math.asin(gradient.gradient / 1e3)),
            -brake.target_acceleration / 0.012,
        )
        lines.append(';'.join(f'{number:.9g}'.replace('.', ',') for number in row))
    path = folder / 'log.csv'
    path.write_text('\r\n'.join(lines), encoding='latin-1', newline='')
    (folder / 'map.yaml').write_text(MAPPING, encoding='utf-8')
    return path


def call(path: Path, *arguments: str) -> int:
    return main(['import', str(path), str(path.parent / 'bag'), '--map', str(path.parent / 'map.yaml'), *arguments])


def test_a_csv_file_becomes_the_bag_that_it_was_made_of(
    tmp_path: Path, driven: list[tuple[Record, ...]], driven_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, driven)
    assert call(path, '--json') == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown['rows'] == len(driven)
    assert shown['blank'] == {}
    assert set(shown['messages'].values()) == {len(driven)}
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.warnings == []
        found = sorted(reader.records(), key=lambda record: (record.stamp_ns, record.row()[0]))
    for record, (stamp_ns, other) in zip(found, ((row[0].stamp_ns, x) for row in driven for x in row), strict=True):
        assert type(record) is type(other)
        assert record.stamp_ns == pytest.approx(stamp_ns, abs=1e3)
        assert record.row()[2:4] == pytest.approx(other.row()[2:4], rel=1e-6, abs=1e-6)
    assert main(['replay', str(tmp_path / 'bag'), '--train', str(driven_bag / 'train.yaml')]) == 0
    assert sorted(item.name for item in tmp_path.iterdir()) == ['bag', 'log.csv', 'map.yaml']


def test_the_line_of_a_train_file_gives_the_gradient(tmp_path: Path) -> None:
    columns = (ROOT / 'config' / 'mappings' / 'logger.yaml').read_text(encoding='utf-8')
    from_line = re.sub(r'(?m)^gradient:.*$', 'gradient: {from: line}', columns)
    found = []
    for name, text in (('column', columns), ('line', from_line)):
        (tmp_path / 'map.yaml').write_text(text, encoding='utf-8')
        train = str(ROOT / 'bags' / 'tiny' / 'train.yaml')
        bag, mapping = str(tmp_path / name), str(tmp_path / 'map.yaml')
        assert main(['import', str(ROOT / 'bags' / 'logger.csv'), bag, '--map', mapping, '--train', train]) == 0
        with BagReader(bag) as reader:
            found.append([record.gradient for record in reader.records() if isinstance(record, GradientRecord)])
    column, line = found
    # The logger saw the map of the line with errors of .05 per mille.
    assert line == pytest.approx(column, abs=0.5)
    assert max(map(abs, line)) > 1.0


def test_an_error_is_one_line_and_leaves_nothing_behind(
    tmp_path: Path, driven: list[tuple[Record, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, driven)
    with path.open('a', encoding='latin-1') as file:
        file.write('\r\n400,0;zwei;1;1;1;1')
    assert call(path) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert f"{path}: line {len(driven) + 4}: column 'v' = 'zwei' is not a number" in error
    assert not (tmp_path / 'bag').exists()
    assert sorted(item.name for item in tmp_path.iterdir()) == ['log.csv', 'map.yaml']


def test_a_unit_that_is_not_the_one_in_the_file_is_a_warning(
    tmp_path: Path, driven: list[tuple[Record, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, driven)
    (tmp_path / 'map.yaml').write_text(MAPPING.replace('{field: v, unit: km/h}', '{field: v}'), encoding='utf-8')
    assert call(path) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"trainid: warning: {path}: column 'v': the file says km/h, the mapping m/s"


def test_a_notch_that_is_not_in_the_table_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / 'log.csv'
    rows = [f'{0.2 * k:.1f},{10.0},{0.0},{k // 10}' for k in range(40)]
    log.write_text('\n'.join(('t,v,F,notch', *rows)), encoding='utf-8')
    (tmp_path / 'map.yaml').write_text(
        'time: {field: t}\nspeed: {field: v}\nforce: {field: F}\ngradient: {value: 0.0}\n'
        'brake_command: {field: notch, table: {0: 0.0, 2: -0.5}}\n',
        encoding='utf-8',
    )
    assert main(['import', str(log), str(tmp_path / 'bag'), '--map', str(tmp_path / 'map.yaml')]) == 0
    out, err = capsys.readouterr()
    assert f"{log}: column 'notch': 1 is not in table of the mapping (10 rows)" in err
    assert f"{log}: column 'notch': 3 is not in table of the mapping (10 rows)" in err
    assert 'rows without a value: brake_command 20' in out


def test_nothing_is_written_over(
    tmp_path: Path, driven: list[tuple[Record, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, driven)
    before = path.read_bytes()
    assert main(['import', str(path), str(path), '--map', str(tmp_path / 'map.yaml')]) == 2
    assert capsys.readouterr().err == f'trainid: error: {path}: exists already and is not overwritten\n'
    assert path.read_bytes() == before


def test_what_is_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'log.csv'
    path.write_text('t,v\n0,1\n0.2,\n0.1,2\n', encoding='utf-8')
    (tmp_path / 'map.yaml').write_text('{time: {field: t}, speed: {field: v}}', encoding='utf-8')
    assert call(path) == 0
    out, err = capsys.readouterr()
    assert 'rows without a value: speed 1' in out
    assert '1 row earlier than one before' in err
    assert 'no messages on ato/force, ato/gradient, ato/brake_command' in err
    path.write_text('t,v\n0,\n', encoding='utf-8')
    assert main(['import', str(path), str(tmp_path / 'bag2'), '--map', str(tmp_path / 'map.yaml')]) == 2
    assert 'log.csv: nothing in 1 row has a time and a value' in capsys.readouterr().err
    (tmp_path / 'map.yaml').write_text(
        '{time: {field: t}, speed: {field: v}, gradient: {from: line}}', encoding='utf-8'
    )
    assert main(['import', str(path), str(tmp_path / 'bag2'), '--map', str(tmp_path / 'map.yaml')]) == 2
    assert 'no train file is given (--train)' in capsys.readouterr().err
