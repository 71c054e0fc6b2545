# SPDX-License-Identifier: Apache-2.0
"""Where a controller gets its values, and what it learns at stops."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import pytest

from ato.knowledge import LearnedRate, LiveValues, StatedValues, StopBias, TrueValues, client_values
from trainid_ros.client import TrainModel
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, GradientRecord, SpeedRecord
from trainid_ros.sim.plant import Plant
from trainid_ros.sim.worlds import find_world, world_train
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Davis, Effect, Line, TrainFile

FILE = world_train(find_world('metro'))
START_NS: Final = 10**18


def test_the_values_of_a_client_are_those_of_the_train_file_at_first() -> None:
    file = replace(FILE, resistance=Davis(1.5, 0.03, 0.006))
    values = client_values(TrainModel(None, file, clock=lambda: 0.0), file.brake)
    assert values.resistance.a == pytest.approx(1.5)
    assert values.resistance.b == pytest.approx(0.03)
    assert values.resistance.c == pytest.approx(0.006)
    assert values.brake == file.brake
    assert LiveValues(file).values() == StatedValues(file).values()


def test_true_values_know_mass_heat_and_wear() -> None:
    effects = (
        Effect('brake_fade', (('loss', 0.2), ('energy', 100.0))),
        Effect('mass_error', (('ratio', 1.1),)),
    )
    file = replace(FILE, effects=effects)
    plant = Plant(file, LineProfile(file.line, file.train.length), NS_PER_S, 0.8)
    known = TrueValues(file, plant)
    assert known.values().brake.rate == pytest.approx(1.0 / 1.1)
    plant.heat, plant.brake_rate, plant.resistance = 50.0, 0.9, Davis(3.0, 0.0, 0.0)
    assert known.values().brake.rate == pytest.approx(0.9 * 0.9 / 1.1)
    assert known.values().resistance == Davis(3.0, 0.0, 0.0)


def test_a_constant_error_is_learned() -> None:
    bias = StopBias()
    for _ in range(20):
        bias.learn(0.5 + bias.aim)
    assert bias.aim == pytest.approx(-0.5, abs=0.01)


def test_it_aims_at_most_five_metres_away() -> None:
    bias = StopBias()
    for _ in range(20):
        bias.learn(-15.0)
    assert bias.aim == 5.0


@pytest.mark.parametrize('gradient', [0.0, -8.0])
def test_the_brake_rate_of_whole_brakings_is_learned(train_file: TrainFile, gradient: float) -> None:
    """The true brake rate is 0.8 of the stated one; each stop corrects half of the difference."""
    file = replace(train_file, line=Line(stops=(0.0, 1e5), gradient=((-1e3, gradient),)))
    true = replace(file, brake=replace(file.brake, rate=0.8 * file.brake.rate))
    known, rates = LearnedRate(file), []
    for k in range(3):
        stop(Plant(true, LineProfile(true.line, true.train.length), START_NS + 60 * NS_PER_S * k, 1.0), known, gradient)
        rates.append(known.values().brake.rate / file.brake.rate)
        assert known.values().resistance == file.resistance
    assert rates == pytest.approx([0.9, 0.85, 0.825], abs=0.006)


def stop(plant: Plant, known: LearnedRate, gradient: float) -> None:
    """Brake from 15 m/s to a stop; the sensors measure ten times a second."""
    plant.speed = 15.0
    plant.command(-0.7)
    known.observe(GradientRecord(plant.now_ns, gradient, 0.0, tunnel=False))
    known.observe(BrakeRecord(plant.now_ns, -0.7, emergency=False))
    while plant.speed > 0.0:
        known.observe(SpeedRecord(plant.now_ns, plant.speed, plant.position))
        for _ in range(5):
            plant.step(0.0)
    known.observe(BrakeRecord(plant.now_ns, 0.0, emergency=False))
    known.observe(SpeedRecord(plant.now_ns, 0.0, plant.position))
    known.observe(SpeedRecord(plant.now_ns + 20 * NS_PER_S, 0.0, plant.position))
