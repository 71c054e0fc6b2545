# SPDX-License-Identifier: Apache-2.0
"""Scores of a ride against the true train, step by step."""

from __future__ import annotations

import numpy as np
import pytest

from ato.ride_score import RideScore
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.sim.plant import Plant
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

TICK_STEPS = 10


def plant_of(*limits: tuple[float, float]) -> Plant:
    train = Train(mass=200e3, length=100.0)
    file = TrainFile(train, Davis(2.0, 0.0, 0.004), Brake(1.0, 0.4, 0.6), Line(stops=(0.0, 3000.0), speed_limit=limits))
    return Plant(file, LineProfile(file.line, train.length), NS_PER_S, 0.8)


def braked_to_rest(speed: float, command: float) -> tuple[Plant, RideScore]:
    plant, score = plant_of(), RideScore()
    plant.speed = speed
    plant.command(command)
    while plant.speed > 0.0:
        score.add(plant, None)
        for _ in range(TICK_STEPS):
            plant.step(0.0)
    score.add(plant, None)
    return plant, score


# The standstill is somewhere in a tick; at one of these speeds it is in its last step.
@pytest.mark.parametrize('speed', np.arange(9.0, 9.17, 0.015).tolist())
def test_the_jolt_at_standstill_counts(speed: float) -> None:
    _, score = braked_to_rest(speed, -0.8)
    # Beside the brake, the resistance of 2 N/kN decelerates.
    assert score.final_decelerations == [pytest.approx(0.82, abs=0.01)]
    assert score.jerks[-1] == pytest.approx(0.82 / 0.2, abs=0.05)


def test_overspeed_counts_where_the_limit_begins() -> None:
    plant, score = plant_of((0.0, 20.0), (151.0, 10.0)), RideScore()
    plant.position, plant.speed = 150.0, 12.0
    plant._actuator.output = -1.0
    plant.command(-1.0)
    score.skip(plant)
    at = 0.0
    for _ in range(TICK_STEPS):
        before = plant.speed
        plant.step(0.0)
        at = before if not at and plant.position > 151.0 else at
    score.add(plant, None)
    assert plant.speed < 11.9
    assert score.overspeed == pytest.approx(at - 10.0, abs=0.03)
    assert score.overspeed > plant.speed - 10.0 + 0.05


def test_only_counted_ticks_are_scored() -> None:
    plant, score = plant_of(), RideScore()
    plant.speed = 5.0
    score.skip(plant)
    assert (score.jerks, score.speed_errors) == ([], [])
    score.add(plant, 5.5)
    assert score.jerks == [0.0]
    assert score.speed_errors == [-0.5]
