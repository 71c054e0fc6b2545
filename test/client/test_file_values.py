# SPDX-License-Identifier: Apache-2.0
"""What the train file says: how fast its resistance may move, and what effects do to its brake."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.client.channel import MAX_RATE, Gradual, Normal
from trainid_ros.client.file_values import DAVIS, FileValues
from trainid_ros.estimators.settings import FilterBankConfig, GsmaConfig
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile, load_train_file

TRAINS = sorted((Path(__file__).parents[2] / 'config' / 'trains').glob('*.yaml'))
FILE = TrainFile(Train(mass=200e3), Davis(1.5, 0.02, 0.003))


def values(file: TrainFile) -> FileValues:
    return FileValues(file, FilterBankConfig(), GsmaConfig())


@pytest.mark.parametrize('path', TRAINS, ids=[path.stem for path in TRAINS])
def test_a_resistance_moves_at_most_a_quarter_faster_than_stated_at_any_speed(path: Path) -> None:
    file = load_train_file(path)
    parameter = values(file).resistance()[DAVIS]
    top, start, rng = file.train.max_speed, parameter.file, np.random.default_rng(3)
    directions = [(1.0, v, v * v) for v in np.linspace(0.0, top, 61).tolist()]
    fastest = 0.0
    for _ in range(150):
        way = rng.standard_normal(3) * (1.0, 1.0 / top, 1.0 / top**2) * rng.uniform(0.1, 10.0, 3)
        target = Normal(tuple((np.array(start.mean) + way).tolist()), start.covariance)
        move = Gradual(start, parameter.probes)
        move.go_to(target, 0.0)
        for direction in directions:
            (before, variance), (after, _) = start.along(direction), target.along(direction)
            fastest = max(fastest, abs(after - before) / math.sqrt(variance) / move.left_s(0.0))
    print(f'{fastest / MAX_RATE:.3f}')
    assert MAX_RATE < fastest < 1.25 * MAX_RATE


def test_without_effects_the_brake_rate_has_the_rows_of_the_train_file() -> None:
    table = ((2.0, 1.2), (22.0, 0.4))
    for brake in (Brake(), Brake(rate_table=table)):
        shape = values(TrainFile(FILE.train, FILE.resistance, brake)).stop_shape(1)
        assert list(zip(shape.speeds, shape.rates, strict=True)) == list(brake.rate_table)
        assert shape.resistances == []


def test_effects_scale_the_rows_of_the_brake_rate() -> None:
    heavy = parse_effects(['mass_error:ratio=1.25'])
    table = TrainFile(FILE.train, FILE.resistance, Brake(rate_table=((2.0, 1.2), (22.0, 0.4))), effects=heavy)
    assert values(table).stop_shape(1).rates == pytest.approx([0.96, 0.32])
    one = values(TrainFile(FILE.train, FILE.resistance, effects=heavy)).stop_shape(-1)
    assert one.speeds == [0.0]
    assert one.rates == pytest.approx([0.8])


def test_a_wind_gives_each_direction_its_resistance() -> None:
    windy = values(TrainFile(FILE.train, FILE.resistance, effects=parse_effects(['headwind:speed=5'])))
    for direction in (1, -1):
        shape = windy.stop_shape(direction)
        for v in (0.0, 4.125, 20.0, 150.0):
            assert shape.extra(v) == pytest.approx(windy.effects.resistance(v, direction), abs=1e-3)
