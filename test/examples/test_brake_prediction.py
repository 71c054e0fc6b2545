# SPDX-License-Identifier: Apache-2.0
"""Predicted stops against the simulated train."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ato.brake_prediction import BrakePredictor, Motion
from ato.knowledge import TrainValues
from ato.train_state import PositionModel, TrainState
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.sim.plant import Plant
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

PERIOD = 0.2
BEGIN = 200.0
LINE = Line(stops=(0.0, 3000.0), gradient=((0.0, 0.0), (250.0, -12.0), (320.0, 6.0)))


def train_file(delay: float = 0.6, rate: float = 1.0) -> TrainFile:
    train = Train(mass=200e3, rotary_mass=0.06, length=100.0)
    return TrainFile(train, Davis(2.0, 0.02, 0.004), Brake(rate, 0.4, delay), LINE)


def plant_and_predictor(file: TrainFile, speed: float) -> tuple[Plant, BrakePredictor, TrainState]:
    profile = LineProfile(file.line, file.train.length)
    plant = Plant(file, profile, NS_PER_S, 0.8)
    state = TrainState(PositionModel(), profile, np.random.default_rng(1))
    plant.speed = state.speed = speed
    plant.position = state.position = BEGIN
    return plant, BrakePredictor(TrainValues(file.resistance, file.brake), state, file.train.rotary_mass, PERIOD), state


@pytest.mark.parametrize('delay', [0.0, 0.5, 0.6, 0.73])
@pytest.mark.parametrize('rate', [0.8, 1.1])
def test_a_train_stops_where_it_is_predicted_to(delay: float, rate: float) -> None:
    plant, predictor, _ = plant_and_predictor(train_file(delay, rate), 16.0)
    expected = predictor.stop_distance(predictor.when_next_acts(), -0.7)
    plant.command(-0.7)
    while plant.speed > 0.0:
        plant.step(0.0)
    assert expected == pytest.approx(plant.position - BEGIN, abs=0.15)


@pytest.mark.parametrize('delay', [0.0, 0.5, 0.6, 0.73])
def test_commands_that_have_been_given_act_until_the_next_one_does(delay: float) -> None:
    plant, predictor, state = plant_and_predictor(train_file(delay), 16.0)
    for target in (0.0, -0.2, -0.4, -0.4, -0.5, -0.3):
        plant.command(target)
        predictor.command(target)
        for _ in range(10):
            plant.step(0.0)
        state.speed, state.position = plant.speed, plant.position
        assert predictor.acceleration == pytest.approx(plant.acceleration, abs=0.03)
    begin = plant.position
    expected = predictor.stop_distance(predictor.when_next_acts(), -0.6)
    plant.command(-0.6)
    while plant.speed > 0.0:
        plant.step(0.0)
    assert expected == pytest.approx(plant.position - begin, abs=0.1)


def test_a_command_that_does_not_stop_the_train_takes_very_long() -> None:
    file = replace(train_file(), line=Line(stops=(0.0, 3000.0), gradient=((0.0, -30.0),)))
    _, predictor, _ = plant_and_predictor(file, 16.0)
    assert predictor.stop_distance(Motion(16.0, 0.0, 0.0), -0.1) > 1000.0
    assert predictor.stop_distance(Motion(0.0, 3.0, 0.0), 0.0) == 3.0
