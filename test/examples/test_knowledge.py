# SPDX-License-Identifier: Apache-2.0
"""Where a controller gets its values."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ato.knowledge import LiveValues, StatedValues, TrueValues, client_values
from trainid_ros.client import TrainModel
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.sim.plant import Plant
from trainid_ros.sim.worlds import find_world, world_train
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Davis, Effect

FILE = world_train(find_world('metro'))


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
