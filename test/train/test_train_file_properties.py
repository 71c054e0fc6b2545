# SPDX-License-Identifier: Apache-2.0
"""Any train file within the ranges works; outside them the field and the range are named."""

from __future__ import annotations

import math

import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pytest import raises

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import dump_train_file, parse_train_file

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
    'resistance.a': (0.0, 100.0),
    'resistance.b': (-10.0, 10.0),
    'resistance.c': (0.0, 1.0),
    'brake.rate': (0.01, 10.0),
    'brake.time_constant': (0.0, 60.0),
    'brake.delay': (0.0, 60.0),
    'brake.timing_std': (0.0, 1.0),
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
        with raises(InputError) as caught:
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
    with raises(InputError) as caught:
        parse_train_file(yaml.safe_dump(document), 'T.yaml')
    assert str(caught.value).startswith(f'T.yaml: {name} = ')
