# SPDX-License-Identifier: Apache-2.0
"""A row holds what ``trainid replay`` prints, and the ratio of distances; failures are rows too."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from trainid_ros.bag.types import table_of
from trainid_ros.cli.main import main
from trainid_ros.fleet.bag_row import Odometer, bag_row, killed_row
from trainid_ros.fleet.mixed_model import has_estimate, is_known
from trainid_ros.fleet.plan import PlannedBag, Setup
from trainid_ros.fleet.table_file import COLUMNS, NAMES
from trainid_ros.interface.records import NS_PER_S, SpeedRecord
from trainid_ros.interface.results import Status
from trainid_ros.train.train_file import dump_train_file, load_train_file

if TYPE_CHECKING:
    from pathlib import Path

KINDS = {'text': str, 'float': float, 'int': int, 'time': float}


def test_numbers_are_those_of_replay(tiny: Path, setup: Setup, capsys: pytest.CaptureFixture[str]) -> None:
    done: list[float] = []
    bag = PlannedBag(str(tiny), start_s=1.0, train='T1', day='2026-01-31')
    row = bag_row(setup, 'r1', bag, done.append)
    assert sum(done) == pytest.approx(1.0)
    assert main(['replay', str(tiny), '--train', str(setup.train), '--json']) == 0
    shown = json.loads(capsys.readouterr().out)
    w = shown['resistance']
    assert [row[name] for name in 'abc'] == [w[name] for name in 'abc']
    assert [row[f'{name}_std'] for name in 'abc'] == w['std']
    assert row['w15'] == w['a'] + w['b'] * 15 + w['c'] * 225
    assert (row['brake_rate'], row['brake_rate_std']) == (shown['brake_rate']['value'], shown['brake_rate']['std'])
    assert (row['used'], row['status'], row['duration_s']) == (shown['used'], w['status'], shown['duration_s'])
    assert {name: row[f'rejected_{name.lower()}'] for name in shown['rejected']} == shown['rejected']
    assert row['rejected'] == sum(shown['rejected'].values())
    assert sum(row[f'share_{status.name.lower()}'] for status in Status) == pytest.approx(1.0)
    assert row['share_valid'] > 0.0
    assert (row['train'], row['day'], row['line'], row['revision']) == ('T1', '2026-01-31', None, 'r1')


def test_a_force_that_counts_twice_is_a_contradiction(tiny: Path, setup: Setup, tmp_path: Path) -> None:
    mapping = tmp_path / 'map.yaml'
    mapping.write_text('force: {topic: ato/force, field: force, gain: 2.0}\n', encoding='utf-8')
    wrong, right = (
        bag_row(replace(setup, mapping=path), 'r1', PlannedBag(str(tiny), train='T1', day='2026-01-31'), lambda _: None)
        for path in (mapping, None)
    )
    assert 'the acceleration is 0.5 times what ato/force and mass give' in wrong['contradiction']
    assert (is_known(wrong), has_estimate(wrong)) == (False, True)
    assert (right['contradiction'], is_known(right)) == (None, True)


def test_a_dead_time_is_that_of_the_train(tiny: Path, setup: Setup, tmp_path: Path) -> None:
    true = load_train_file(setup.train)
    found = []
    for name, delay, timing_std in (('late', 0.68, 0.12), ('soon', 0.52, 0.12), ('exact', 0.68, 0.0)):
        train = tmp_path / f'{name}.yaml'
        stated = replace(true.brake, delay=delay, timing_std=timing_std)
        train.write_text(dump_train_file(replace(true, brake=stated)), encoding='utf-8')
        row = bag_row(replace(setup, train=train), 'r1', PlannedBag(str(tiny)), lambda _: None)
        found.append((row['dead_time'], row['dead_time_std']))
    for value, std in found[:2]:
        assert std < 0.04  # stated were 0.08 s
        assert abs(value - true.brake.delay) < 3.0 * std
    assert found[2] == (None, None)


def test_rows_have_the_columns_and_their_types(tiny: Path, setup: Setup) -> None:
    row = bag_row(setup, 'r1', PlannedBag(str(tiny), start_s=1.0), lambda _: None)
    assert tuple(row) == NAMES
    for column in COLUMNS:
        assert row[column.name] is None or type(row[column.name]) is KINDS[column.kind], column.name


def test_failures_are_rows(tmp_path: Path, setup: Setup) -> None:
    bag = PlannedBag(str(tmp_path / 'none'), train='T1')
    row = bag_row(setup, 'r1', bag, lambda _: None)
    assert (row['train'], row['status'], row['error']) == ('T1', None, f'{bag.path}: no such bag')
    assert bag_row(setup, 'r1', replace(bag, error='is empty'), lambda _: None)['error'] == 'is empty'
    assert 'killed' in killed_row('r1', bag)['error']


RATIO = 1.02


def ride(legs: int, ratio: float, lost: float = 0.0) -> Odometer:
    """Return an odometer after legs of 1 km, there and back, at 10 m/s measured as ``ratio`` times that."""
    speed = np.concatenate([np.r_[np.zeros(5), np.full(100, 10.0)] for _ in range(legs)] + [np.zeros(5)])
    position = np.cumsum(speed) * 1.0
    folded = 1000.0 - np.abs(position % 2000.0 - 1000.0)
    rows = [
        SpeedRecord((k + 1) * NS_PER_S + round(lost * NS_PER_S * (k > 50)), ratio * v, s)
        for k, (v, s) in enumerate(zip(speed.tolist(), folded.tolist(), strict=True))
    ]
    odometer, table = Odometer(), table_of([(record.stamp_ns, record.row()) for record in rows])
    for first in range(0, len(table), 37):
        odometer.add(table[first : first + 37])
    return odometer


def test_the_ratio_is_that_of_the_distances() -> None:
    found = ride(6, RATIO).ratio
    assert found is not None
    assert found[0] == pytest.approx(RATIO, abs=1e-9)
    assert 0.0 < found[1] < 1e-3


def test_legs_with_a_gap_do_not_count() -> None:
    assert ride(1, RATIO, lost=10.0).ratio is None
    found = ride(2, RATIO, lost=10.0).ratio
    assert found is not None
    assert found[0] == pytest.approx(RATIO, abs=1e-9)


def test_another_unit_is_not_the_wheels() -> None:
    assert ride(4, 3.6).ratio is None
