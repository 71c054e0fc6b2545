# SPDX-License-Identifier: Apache-2.0
"""The truth file reads back exactly and gives the values at any time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.sim.truth import Truth, TruthPoint, dump_truth, load_truth, parse_truth, save_truth
from trainid_ros.train.train_file import Davis

TRUTH = Truth(10**18, ((0.0, 1.0, 0.1 + 0.2, 0.003), (60.0, 1.5, 0.3, 1e-5)), ((0.0, 1.0), (30.0, 0.85)))


@pytest.mark.parametrize('unknowns', [(), (('mass_ratio', 0.1 + 0.2), ('force_delay', 0.0))])
def test_round_trip(unknowns: tuple[tuple[str, float], ...], tmp_path: Path) -> None:
    truth = replace(TRUTH, unknowns=unknowns)
    save_truth(truth, tmp_path / 'truth.yaml')
    assert load_truth(tmp_path / 'truth.yaml') == truth
    assert ('unknowns' in dump_truth(truth)) == bool(unknowns)
    with pytest.raises(InputError, match=r'truth\.yaml: cannot be written'):
        save_truth(truth, tmp_path / 'none' / 'truth.yaml')


def test_each_value_applies_from_its_time_on() -> None:
    assert TRUTH.truth_at(59.9) == TruthPoint(Davis(1.0, 0.1 + 0.2, 0.003), 0.85)
    assert TRUTH.truth_at(60.0).resistance == Davis(1.5, 0.3, 1e-5)
    assert TRUTH.truth_at(-5.0).brake_rate == 1.0
    assert TRUTH.truth_at_ns(10**18 + 30 * 10**9).brake_rate == 0.85
    unknown = parse_truth('start_ns: 5\nresistance: [[0, 1, 0, 0]]', 'truth.yaml')
    assert unknown.truth_at(1.0).brake_rate is None


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('start_ns: 5', 'truth.yaml: resistance is missing: at least one row [time s, a, b, c] is required'),
        ('resistance: [[0, 1, 2]]', 'truth.yaml: resistance[0] = [0, 1, 2] must be [time s, a, b, c]'),
        (
            'resistance: [[5, 1, 2, 3], [5, 1, 2, 4]]',
            'truth.yaml: resistance[1] = 5 s must be later than 5 s: times must increase',
        ),
        ('start_ns: 1.5\nresistance: [[5, 1, 2, 3]]', 'truth.yaml: start_ns = 1.5 must be a whole number'),
        (
            'resistance: [[5, 1, 2, 3]]\nunknowns: {mass_ratio: big}',
            "truth.yaml: unknowns.mass_ratio = 'big' must be a number",
        ),
        ('resistence: []', "truth.yaml: resistence is not a known field; did you mean 'resistance'?"),
    ],
)
def test_invalid_fields_are_named(text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_truth(text, 'truth.yaml')
    assert str(caught.value) == message
