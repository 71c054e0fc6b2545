# SPDX-License-Identifier: Apache-2.0
"""Train files of OSRD, from small files in the shape of its public ones."""

from __future__ import annotations

import json
from typing import Any

import pytest
import yaml

from trainid_ros.interface.errors import InputError
from trainid_ros.train.draft import Draft, read_osrd
from trainid_ros.train.forces import G, davis
from trainid_ros.train.train_file import parse_train_file

STOCK_OSRD = {
    'name': 'fast', 'railjson_version': '3.2', 'length': 400.0, 'mass': 900000.0, 'max_speed': 80.0,
    'inertia_coefficient': 1.05, 'gamma': {'type': 'CONST', 'value': 0.5}, 'supported_signaling_systems': ['BAL'],
    'rolling_resistance': {'type': 'davis', 'A': 5400.0, 'B': 200.0, 'C': 12.0},
    'effort_curves': {
        'default_mode': 'thermal',
        'modes': {'thermal': {'default_curve': {'speeds': [0, 20, 40], 'max_efforts': [440000, 400000, 250000]}}},
    },
}  # fmt: skip
TRACK_OSRD = {
    'version': '3.4.12',
    'track_sections': [
        {
            'id': 'TA', 'length': 2000.0, 'slopes': [{'gradient': -3.0, 'begin': 500.0, 'end': 700.0}],
            'curves': [{'radius': -6000.0, 'begin': 0.0, 'end': 300.0}],
        },
        {'id': 'TB', 'length': 50.0, 'slopes': [], 'curves': []},
    ],
    'speed_sections': [
        {'id': 'a', 'speed_limit': 40.0, 'track_ranges': [{'track': 'TA', 'begin': 0.0, 'end': 2000.0}]},
        {'id': 'b', 'speed_limit': 30.0, 'track_ranges': [
            {'track': 'TA', 'begin': 500.0, 'end': 900.0, 'applicable_directions': 'BOTH'},
            {'track': 'TA', 'begin': 900.0, 'end': 950.0, 'applicable_directions': 'STOP_TO_START'}]},
    ],
    'operational_points': [
        {'id': 'W', 'parts': [{'track': 'TA', 'position': 700.0}, {'track': 'TB', 'position': 5.0}]},
    ],
    'signals': [{}, {}],
}  # fmt: skip


def osrd(document: Any, track: str = '') -> Draft:
    draft = Draft()
    read_osrd(json.dumps(document), 'X.json', track, draft)
    return draft


def test_osrd_rolling_stock_is_in_si() -> None:
    draft = osrd(STOCK_OSRD)
    found = parse_train_file(yaml.safe_dump(draft.sections()), 'T.yaml')
    weight = found.train.mass * G / 1000.0
    assert davis(found.resistance, 50.0) * weight == pytest.approx(5400.0 + 200.0 * 50.0 + 12.0 * 2500.0, rel=1e-6)
    train = found.train
    assert (train.mass, train.length, train.max_speed, train.rotary_mass) == (9e5, 400.0, 80.0, 0.05)
    assert (train.max_traction_force, train.max_traction_power) == (440e3, 10e6)
    assert draft.left_out == ["gamma = {'type': 'CONST', 'value': 0.5}", 'supported_signaling_systems (1)']
    assert 'at most 10% above its curve' in draft.notes[0]
    assert 'brake.delay' in draft.missing()[1]


def test_a_track_of_osrd_takes_the_lowest_limit() -> None:
    draft = osrd(TRACK_OSRD, 'TA')
    assert draft.sections()['line'] == {
        'gradient': [[0.0, 0.0], [500.0, -3.0], [700.0, 0.0]],
        'curve': [[0.0, 6000.0], [300.0, 0.0]],
        'speed_limit': [[0.0, 40.0], [500.0, 30.0], [900.0, 40.0]],
        'stops': [700.0],
    }
    assert draft.left_out == ['signals (2)']


@pytest.mark.parametrize(
    ('document', 'message'),
    [
        ([], 'X.json = [] must be a mapping of fields'),
        ({'a': 1}, 'X.json: has neither rolling_resistance nor track_sections'),
        (STOCK_OSRD | {'mass': 'heavy'}, "X.json: mass = 'heavy' must be a number in kg"),
        (STOCK_OSRD | {'rolling_resistance': {'type': 'strahl'}}, 'X.json: rolling_resistance.type'),
        (TRACK_OSRD, 'X.json: has TA, TB; choose one with --track'),
    ],
)
def test_a_wrong_field_of_osrd_is_named(document: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        osrd(document)
    assert str(caught.value).startswith(message)
