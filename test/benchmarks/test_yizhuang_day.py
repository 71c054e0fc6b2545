# SPDX-License-Identifier: Apache-2.0
"""The standard scenario uses the shipped train file and matches its description."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.yizhuang_day import DRY, RAIN, RAIN_AND_DRAG, yizhuang_day
from trainid_ros.sim.scenario import simulate
from trainid_ros.train.train_file import TrainFile, dump_train_file, load_train_file, parse_train_file

SHIPPED = Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml'


@pytest.fixture(scope='module')
def stated() -> TrainFile:
    return load_train_file(SHIPPED)


def test_the_shipped_file_has_the_published_train(stated: TrainFile) -> None:
    assert stated.train.mass == 278e3
    assert len(stated.line.stops) == 14
    assert (stated.line.stops[0], stated.line.stops[-1]) == (0.0, 22728.0)
    # 3.9476 kN and 0.0022294 kN/(km/h)^2 on 278 t, per kN of weight and with v in m/s.
    weight_kn = 278.0 * 9.80665
    assert stated.resistance.a == pytest.approx(3947.6 / weight_kn, abs=1e-6)
    assert stated.resistance.c == pytest.approx(2.2294 * 3.6**2 / weight_kn, abs=1e-8)
    assert parse_train_file(dump_train_file(stated), 'again') == stated


def test_the_day_changes_as_described(stated: TrainFile) -> None:
    scenario = yizhuang_day(stated, runs=3)
    assert scenario.train_file.resistance == DRY
    assert scenario.train_file.line == stated.line
    steps = [(c.time_s, c.resistance) for c in scenario.changes if c.resistance is not None]
    assert steps == [(1300.0, RAIN), (2500.0, RAIN_AND_DRAG)]
    rates = [(c.time_s, c.brake_rate) for c in scenario.changes if c.brake_rate is not None]
    assert rates[-2:] == [(1500.0, 0.85), (2900.0, 0.95)]
    # The wear is too slow to be detected in one brake application of about 25 s.
    assert all(abs(b[1] - a[1]) <= 0.00251 for a, b in pairwise(rates[:-1]))


def test_the_first_runs_stop_in_place(stated: TrainFile) -> None:
    arrivals = simulate(yizhuang_day(stated, runs=3), np.random.default_rng(7)).arrivals
    assert [arrival.stop for arrival in arrivals] == [2631.0, 3906.0, 6272.0]
    assert max(abs(arrival.error) for arrival in arrivals) < 1.0
