# SPDX-License-Identifier: Apache-2.0
"""Additional resistance (5): shares of cars, exact means, curves."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_lab.resistance.trajectory.multi_mass import Cars, MultiMassLine
from trainid_ros.interface.errors import InputError
from trainid_ros.train.train_file import Line

LINE = Line(gradient=((0.0, 0.0), (1000.0, 10.0), (2000.0, -4.0)), curve=((0.0, 0.0), (1500.0, 600.0)))
CARS = Cars.of_lengths(np.array([60.0, 40.0]), np.array([20.0, 20.0]))


def test_cars_are_weighted_by_mass_at_their_own_position() -> None:
    line = MultiMassLine(LINE, CARS)
    # With the head at 1020 m the first centroid is at 1010 m, on the hill, the second one at 990 m, before it.
    assert line.at(np.array([900.0, 1020.0, 1100.0])) == pytest.approx([0.0, 6.0, 10.0])
    assert line.at(np.array([1600.0])) == pytest.approx([11.0])


def test_means_are_the_average_of_many_values() -> None:
    line, positions = MultiMassLine(LINE, CARS), np.array([900.0, 1013.0, 1511.0, 2300.0])
    for mean, start, end in zip(line.means(positions), positions[:-1], positions[1:], strict=True):
        fine = np.linspace(start, end, 200_001)
        assert mean == pytest.approx(line.at(0.5 * (fine[1:] + fine[:-1])).mean(), abs=1e-4)


def test_cars_must_match() -> None:
    with pytest.raises(InputError, match='2 masses and 1 lengths'):
        Cars.of_lengths(np.ones(2), np.ones(1))
