# SPDX-License-Identifier: Apache-2.0
"""The stock scenario runs on the shipped train file and holds what its description says."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.sim.scenario import simulate
from trainid_ros.sim.yizhuang_day import DRY, RAIN, RAIN_AND_DRAG, yizhuang_day
from trainid_ros.train.train_file import TrainFile, dump_train_file, load_train_file, parse_train_file

SHIPPED = Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml'


@pytest.fixture(scope='module')
def believed() -> TrainFile:
    return load_train_file(SHIPPED)


def test_the_shipped_file_holds_the_published_train(believed: TrainFile) -> None:
    assert believed.train.mass == 278e3
    assert len(believed.line.stops) == 14
    assert (believed.line.stops[0], believed.line.stops[-1]) == (0.0, 22728.0)
    # 3.9476 kN and 0.0022294 kN/(km/h)^2 on 278 t, per kN of weight and with v in m/s.
    weight_kn = 278.0 * 9.80665
    assert believed.resistance.a == pytest.approx(3947.6 / weight_kn, abs=1e-6)
    assert believed.resistance.c == pytest.approx(2.2294 * 3.6**2 / weight_kn, abs=1e-8)
    assert parse_train_file(dump_train_file(believed), 'again') == believed


def test_the_day_changes_as_described(believed: TrainFile) -> None:
    scenario = yizhuang_day(believed, runs=3)
    assert scenario.train_file.resistance == DRY
    assert scenario.train_file.line == believed.line
    steps = [(c.time_s, c.resistance) for c in scenario.changes if c.resistance is not None]
    assert steps == [(1300.0, RAIN), (2500.0, RAIN_AND_DRAG)]
    rates = [(c.time_s, c.brake_rate) for c in scenario.changes if c.brake_rate is not None]
    assert rates[-2:] == [(1500.0, 0.85), (2900.0, 0.95)]
    # While running, the brake wears too slowly to be seen in one braking of some 25 s.
    assert all(abs(b[1] - a[1]) <= 0.00251 for a, b in pairwise(rates[:-1]))


def test_the_first_runs_stop_in_place(believed: TrainFile) -> None:
    arrivals = simulate(yizhuang_day(believed, runs=3), np.random.default_rng(7)).arrivals
    assert [arrival.stop for arrival in arrivals] == [2631.0, 3906.0, 6272.0]
    assert max(abs(arrival.error) for arrival in arrivals) < 1.0
