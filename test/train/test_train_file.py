# SPDX-License-Identifier: Apache-2.0
"""The train file: what it holds, its errors, and properties of all files."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import (
    Brake,
    Davis,
    Effect,
    Line,
    Train,
    TrainFile,
    dump_train_file,
    load_train_file,
    parse_train_file,
)

MINIMAL = 'train: {mass: 194e3}\nresistance: {a: 1.0, b: 0.03, c: 0.003}\n'

FULL = TrainFile(
    Train(194e3, 0.08, 118.0, 6, 310e3, 3.1e6, 22.2),
    Davis(1.0 / 3.0, -1e-17, 0.1 + 0.2),
    Brake(0.93, 0.4, 0.0),
    Line((0.0, 1450.0), ((0.0, 0.0), (620.0, -12.5)), ((0.0, 0.0), (300.0, 400.0)), ((700.0, 1400.0),), ((0.0, 20.0),)),
    (
        Effect('tunnel_drag', (('factor', 1.7),), (('factor', 0.05),), 'run 3: "tunnels" — 1 of 4'),
        Effect('unknown_effect', (('x', 1e5),), runs=(3, 4)),
    ),
)


def test_a_minimal_file_uses_defaults_and_a_full_one_reads_back_exactly() -> None:
    assert parse_train_file(MINIMAL, 'T.yaml') == TrainFile(Train(194e3), Davis(1.0, 0.03, 0.003))
    assert parse_train_file(dump_train_file(FULL), 'T.yaml') == FULL


def test_the_interface_example_is_read(tmp_path: Path) -> None:
    path = tmp_path / 'T.yaml'
    path.write_text(
        MINIMAL + 'brake: {rate: 1.0, time_constant: 0.4, delay: 0.6}\n'
        'line:\n  stops: [0.0, 1450.0]\n  gradient: [[0.0, 0.0], [620.0, -12.5]]\n'
        '  curve: [[0.0, 0.0], [300.0, 400.0]]\n  tunnel: [[700.0, 1400.0]]\neffects: []\n',
        encoding='utf-8',
    )
    line = load_train_file(path).line
    assert line == Line((0.0, 1450.0), ((0.0, 0.0), (620.0, -12.5)), ((0.0, 0.0), (300.0, 400.0)), ((700.0, 1400.0),))


def test_a_brake_rate_table_is_interpolated_linearly_and_reads_back() -> None:
    brake = parse_train_file(MINIMAL + 'brake: {rate: [[5.0, 1.1], [15.0, 0.9]]}', 'T.yaml').brake
    assert (brake.rate, brake.rate_table) == (1.0, ((5.0, 1.1), (15.0, 0.9)))
    assert [brake.rate_at(v) for v in (0.0, 5.0, 10.0, 15.0, 40.0)] == pytest.approx([1.1, 1.1, 1.0, 0.9, 0.9])
    assert Brake(rate=0.8).rate_at(12.0) == 0.8
    longest = f'{MINIMAL}brake: {{rate: {[[v, 1] for v in range(100)]}}}'
    assert len(parse_train_file(longest, 'T.yaml').brake.rate_table) == 100
    file = replace(FULL, brake=brake)
    assert parse_train_file(dump_train_file(file), 'T.yaml') == file
    # A factor on the table is multiplied into its rows.
    scaled = parse_train_file(dump_train_file(replace(FULL, brake=replace(brake, rate=0.5))), 'T.yaml').brake
    assert scaled.rate_at(10.0) == pytest.approx(0.5)


# Further text of a minimal file, and the message about it.
INVALID = [
    ('line: {stops: [0, 1e300]}', 'line.stops[1] = 1e+300 m must be <= 1e+08'),
    ('line: {curve: [[0, 0.1]]}', 'line.curve[0][1] = 0.1 m radius must be >= 1'),
    ('line: {gradient: [[0, 501]]}', 'line.gradient[0][1] = 501 per mille must be <= 500'),
    ('line: {tunnel: [[0, 1e9]]}', 'line.tunnel[0][1] = 1e+09 m must be <= 1e+08'),
    ('zzz: 1', 'zzz is not a known field; known: brake, effects, line, resistance, train'),
    ('effects: [{name: headwind, runs: [2, 0]}]', 'effects[0].runs[1] = 0 must be a whole number from 1 on'),
    ('effects: [{name: headwind, runs: []}]', 'effects[0].runs = [] must have at least one number'),
    ('brake: {rate: 0}', 'brake.rate = 0 must be >= 0.01'),
    ('brake: {rate: []}', 'brake.rate = [] must be a number or have at least one row'),
    ('brake: {rate: }', 'brake.rate = None must be a number or a table [[speed m/s, rate], ...]'),
    ('brake: {rate: {0: 1}}', 'brake.rate = {0: 1} must be a number or a table [[speed m/s, rate], ...]'),
    (f'brake: {{rate: {[[v, 1] for v in range(101)]}}}', 'brake.rate has 101 rows; it may have at most 100'),
    ('brake: {rate: [[0, 1, 2]]}', 'brake.rate[0] = [0, 1, 2] must be [speed m/s, rate]'),
    ('brake: {rate: [[-1, 1]]}', 'brake.rate[0][0] = -1 m/s must be >= 0'),
    ('brake: {rate: [[0, 0]]}', 'brake.rate[0][1] = 0 is outside [0.01, 10]'),
    ('brake: {rate: [[5, 1], [5, 0.9]]}', 'brake.rate[1][0] = 5 m/s must be above 5 m/s: speeds must increase'),
    (
        'brake: {rate_table: [[5, 1]]}',
        'brake.rate_table is not a known field; known: delay, loss, loss_confidence, loss_per_hour, rate, '
        'time_constant, timing_std',
    ),
    ('line: {stops: 5}', 'line.stops = 5 must be a list'),
    ('line: {stops: [0, 5, 5]}', 'line.stops[2] = 5 m must be above 5 m: positions must increase'),
    ('line: {stops: [0, x]}', "line.stops[1] = 'x' must be a number in m"),
    ('line: {gradient: [[0, 1], [0, 2]]}', 'line.gradient[1] = 0 m must be above 0 m: positions must increase'),
    ('line: {gradient: [[0, 1, 2]]}', 'line.gradient[0] = [0, 1, 2] must be [m, per mille]'),
    ('line: {gradient: [[0, true]]}', 'line.gradient[0][1] = True must be a number in per mille'),
    ('line: {curve: [[0, -300]]}', 'line.curve[0][1] = -300 m radius must be >= 0'),
    ('line: {speed_limit: [[0, 0]]}', 'line.speed_limit[0][1] = 0 m/s must be > 0'),
    ('line: {tunnel: [[9, 4]]}', 'line.tunnel[0] = [9, 4] m must end beyond its start'),
    ('line: {tunnel: [[0, 9], [8, 20]]}', 'line.tunnel[1][0] = 8 m is before the end of the previous tunnel, 9 m'),
    ('effects: [{name: 3}]', 'effects[0].name = 3 must be a string'),
    ('effects: [{}]', 'effects[0].name is missing'),
    ('effects: [5]', 'effects[0] = 5 must be a mapping of fields'),
    ('effects: [{name: x, parameters: {k: fast}}]', "effects[0].parameters.k = 'fast' must be a number"),
    ('effects: [{name: x, std: {k: -1}}]', 'effects[0].std.k = -1 must be >= 0'),
    (
        'effects: [{name: x, parameters: {coefficient: 600}, std: {coef: 1}}]',
        'effects[0].std.coef has no parameter of that name',
    ),
    ('[3]: 4', 'line 3, column 1 is not valid YAML: found unhashable key'),
]


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('train: {mass: -1}\nresistance: {a: 1, b: 0, c: 0}', 'T.yaml: train.mass = -1 kg must be >= 1'),
        ('resistance: {a: 1, b: 0, c: 0}', 'T.yaml: train is missing'),
        ('train: {mass: 1}', 'T.yaml: resistance is missing'),
        ('train: {}\nresistance: {a: 1, b: 0, c: 0}', 'T.yaml: train.mass is missing'),
        ('train: {mass: 1}\nresistance: {a: 1, b: 0}', 'T.yaml: resistance.c is missing'),
        ('train: {mass: yes}\nresistance: {}', 'T.yaml: train.mass = True must be a number in kg'),
        ('train: {mass: heavy}\nresistance: {}', "T.yaml: train.mass = 'heavy' must be a number in kg"),
        ('train: {mass: 1:30:00}\nresistance: {}', "T.yaml: train.mass = '1:30:00' must be a number in kg"),
        ('train: {mass: 1, cars: 0777}\nresistance: {}', "T.yaml: train.cars = '0777' must be a whole number"),
        ('train: {mass: 1, cars: 1001}\nresistance: {}', 'T.yaml: train.cars = 1001 must be <= 1000'),
        ('train: {mass: 1e10}\nresistance: {}', 'T.yaml: train.mass = 1e+10 kg must be <= 1e+09'),
        ('train: {mass: .nan}\nresistance: {}', 'T.yaml: train.mass = nan must be finite'),
        ('train: {mass: .inf}\nresistance: {}', 'T.yaml: train.mass = inf must be finite'),
        ('train: 3\nresistance: {}', 'T.yaml: train = 3 must be a mapping of fields'),
        ('[1, 2]', 'T.yaml = [1, 2] must be a mapping of fields'),
        ('', 'T.yaml is empty, but must be a mapping of fields'),
        ('train: {mass: 1, mas: 2}\nresistance: {}', "T.yaml: train.mas is not a known field; did you mean 'mass'?"),
        (
            'train: {mass: 1}\nresistance: {a: 1, b: 0, c: 0, c_by_weight: 1}',
            'T.yaml: resistance.c_by_weight is not a known field; did you mean train.c_by_weight?',
        ),
        (
            'train: {mass: 1, mass: 2}\nresistance: {}',
            "T.yaml: line 1, column 18 is not valid YAML: key 'mass' is given twice",
        ),
        ('train: {mass: 1, cars: 0}\nresistance: {}', 'T.yaml: train.cars = 0 must be >= 1'),
        ('train: {cars: []}\nresistance: {}', 'T.yaml: train.cars has 0 cars; it must have 1 to 1000'),
        ('train: {cars: [4]}\nresistance: {}', 'T.yaml: train.cars[0] = 4 must be a mapping of fields'),
        ('train: {cars: [{mass: 1}]}\nresistance: {}', 'T.yaml: train.cars[0].length is missing'),
        (
            'train: {cars: [{mass: 1, length: 2, width: 3}]}\nresistance: {}',
            'T.yaml: train.cars[0].width is not a known field; known: length, mass',
        ),
        (
            'train: {mass: 7e4, cars: [{mass: 4e4, length: 20}, {mass: 3.1e4, length: 20}]}\nresistance: {}',
            'T.yaml: train.mass = 70000 kg contradicts cars, which add up to 71000 kg',
        ),
        (
            'train: {length: 30, cars: [{mass: 4e4, length: 20}]}\nresistance: {}',
            'T.yaml: train.length = 30 m contradicts cars, which add up to 20 m',
        ),
        ('train: {mass: 1, cars: 2.5}\nresistance: {}', 'T.yaml: train.cars = 2.5 must be a whole number'),
        (MINIMAL + '3: 4', 'T.yaml has the key 3, which is not a field name'),
        *((MINIMAL + text, f'T.yaml: {message}') for text, message in INVALID),
    ],
)
def test_each_invalid_field_is_named_in_one_line(text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_train_file(text, 'T.yaml')
    assert str(caught.value) == message


@pytest.mark.parametrize(
    'text', ['train: {mass: 1', 'a: &x [*x', '\ttrain: 1', 'train: !!python/name:os.system x', '\x00']
)
def test_invalid_yaml_is_reported_in_one_line_with_the_file(text: str) -> None:
    with pytest.raises(InputError, match=r'^T\.yaml:.* is not valid YAML: ') as caught:
        parse_train_file(text, 'T.yaml')
    assert '\n' not in str(caught.value)


def test_cars_give_mass_and_length_and_are_read_back() -> None:
    cars = 'cars: [{mass: 60e3, length: 20.5}, {mass: 35e3, length: 25}]'
    resistance = 'resistance: {a: 1, b: 0, c: 0}'
    train = parse_train_file(f'train: {{{cars}}}\n{resistance}', 'T.yaml').train
    assert (train.mass, train.length, train.cars) == (95e3, 45.5, 2)
    assert train.consist == ((60e3, 20.5), (35e3, 25.0))
    rounded = parse_train_file(f'train: {{mass: 95.05e3, length: 45.5, {cars}}}\n{resistance}', 'T.yaml')
    assert rounded.train.mass == 95.05e3
    assert parse_train_file(dump_train_file(rounded), 'T.yaml') == rounded


# Field, lowest and highest value.
RANGES = {
    'train.mass': (1.0, 1e9),
    'train.rotary_mass': (0.0, 1.0),
    'train.length': (0.1, 1e4),
    'train.max_traction_force': (1.0, 1e9),
    'train.max_traction_power': (1.0, 1e12),
    'train.max_speed': (0.1, 1000.0),
    'train.mass_std': (0.0, 0.5),
    'train.force_std': (0.0, 0.5),
    'train.c_by_weight': (0.0, 1.0),
    'resistance.a': (0.0, 100.0),
    'resistance.b': (-10.0, 10.0),
    'resistance.c': (0.0, 1.0),
    'brake.rate': (0.01, 10.0),
    'brake.time_constant': (0.0, 60.0),
    'brake.delay': (0.0, 60.0),
    'brake.timing_std': (0.0, 1.0),
    'brake.loss_per_hour': (0.0, 100.0),
    'brake.loss': (0.0, 0.9),
    'brake.loss_confidence': (0.0, 0.99),
    'line.gradient_std': (0.0, 50.0),
}
START_NS = 1_700_000_000 * NS_PER_S
Document = dict[str, dict[str, object]]


def rows(low: float, high: float) -> st.SearchStrategy[list[list[float]]]:
    """Return profiles: positions that increase, each with a value."""
    positions = st.lists(st.floats(-1e8, 1e8), max_size=5, unique=True).map(sorted)
    return positions.flatmap(lambda xs: st.tuples(*(st.floats(low, high) for _ in xs)).map(
        lambda values: [[x, value] for x, value in zip(xs, values, strict=True)]))  # fmt: skip


@st.composite
def documents(draw: st.DrawFn) -> Document:
    """Return train files within all ranges; optional fields may be missing."""
    document: Document = {'train': {}, 'resistance': {}, 'brake': {}, 'line': {}}
    for name, (low, high) in RANGES.items():
        section, _, field = name.partition('.')
        if section == 'resistance' or field == 'mass' or draw(st.booleans()):
            document[section][field] = draw(st.floats(low, high))
    document['line'] |= {
        'gradient': draw(rows(-500.0, 500.0)),
        'curve': draw(rows(1.0, 1e9)),
        'speed_limit': draw(rows(0.1, 1000.0)),
        'stops': draw(st.lists(st.floats(-1e8, 1e8), max_size=4, unique=True).map(sorted)),
    }
    return document


def braking(speed: float) -> list[Record]:
    """Return some seconds of traction, coasting and braking."""
    records: list[Record] = []
    for i in range(60):
        stamp = START_NS + i * NS_PER_S // 5
        brake = -0.7 if i > 40 else 0.0
        records += [
            ForceRecord(stamp, 1e5 if i < 20 else 0.0),
            GradientRecord(stamp, -3.0, 500.0, tunnel=False),
            BrakeRecord(stamp, brake, emergency=False),
            SpeedRecord(stamp, max(0.0, speed - 0.1 * max(0, i - 40)), 2.0 * i),
        ]
    return records


@settings(deadline=None, max_examples=25)
@given(documents())
def test_every_file_within_the_ranges_is_read_back_and_runs(document: Document) -> None:
    train_file = parse_train_file(yaml.safe_dump(document), 'T.yaml')
    assert parse_train_file(dump_train_file(train_file), 'T.yaml') == train_file
    profile = LineProfile(train_file.line, train_file.train.length)
    assert all(math.isfinite(profile.gradient(x, way)) for x in (-1e8, 0.0, 1e3, 1e8) for way in (-1, 1))
    for make in (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline):
        pipeline = make(train_file, EstimatorSettings())
        outputs = [output for record in braking(15.0) for output in pipeline.push(record)]
        assert outputs
        pipeline.restore(pipeline.save())


@settings(deadline=None, max_examples=80)
@given(documents(), st.sampled_from(sorted(RANGES)), st.floats(allow_nan=True))
def test_a_value_outside_its_range_is_named_with_the_range(document: Document, name: str, value: float) -> None:
    low, high = RANGES[name]
    section, _, field = name.partition('.')
    document[section][field] = value
    text = yaml.safe_dump(document)
    if low <= value <= high:
        parse_train_file(text, 'T.yaml')
    else:
        with pytest.raises(InputError) as caught:
            parse_train_file(text, 'T.yaml')
        message = str(caught.value)
        assert message.startswith(f'T.yaml: {name} = ')
        assert 'must be ' in message
        assert '\n' not in message


@settings(deadline=None, max_examples=40)
@given(
    documents(),
    st.sampled_from(sorted(RANGES)),
    st.one_of(st.booleans(), st.text(), st.dates(), st.dictionaries(st.text(), st.integers()), st.none()),
)
def test_a_value_of_another_type_is_named(document: Document, name: str, value: object) -> None:
    section, _, field = name.partition('.')
    document[section][field] = value
    with pytest.raises(InputError) as caught:
        parse_train_file(yaml.safe_dump(document), 'T.yaml')
    assert str(caught.value).startswith(f'T.yaml: {name} = ')
