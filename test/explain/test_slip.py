# SPDX-License-Identifier: Apache-2.0
"""Bursts of slip and slide, told from outliers of either sign."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import Dataset, assemble
from trainid_ros.explain.slip import find_slip
from trainid_ros.train.train_file import TrainFile

BURST = 6


def spoiled(maker: Any, believed: TrainFile, sign: float) -> Dataset:
    """Return four runs with a burst under traction and one while braking; sign +1 with the force, 0 either way."""
    rng, runs = np.random.default_rng(4), []
    for run in maker().runs(4, 13):
        speed = run.speed.copy()
        for at in (40, int(np.argmax(run.brake < 0.0)) + 25):
            with_force = np.sign(run.traction[at] + run.brake[at])
            speed[at : at + BURST] += 1.5 * (sign * with_force if sign else rng.choice([-1.0, 1.0]))
        runs.append(replace(run, speed=speed))
    return assemble(runs, believed)


def test_bursts_with_the_force_are_slip(maker: Any, believed: TrainFile) -> None:
    dataset = spoiled(maker, believed, 1.0)
    found = find_slip(dataset)
    assert found is not None
    term, evidence = found
    assert evidence > 10.0
    assert term.parameters['share'] == pytest.approx(8 * BURST / dataset.dt.size, rel=0.2)
    assert abs(term.parameters['speed'] - 1.5) < 2.0 * term.std['speed']


@pytest.mark.parametrize('sign', [-1.0, 0.0])
def test_bursts_against_the_force_are_none(maker: Any, believed: TrainFile, sign: float) -> None:
    assert find_slip(spoiled(maker, believed, sign)) is None


def test_bursts_without_a_force_say_nothing(maker: Any, believed: TrainFile) -> None:
    """As from a wheel sensor that stutters while coasting, in half as many places."""
    runs = []
    for run in maker().runs(4, 13):
        speed = run.speed.copy()
        braking = int(np.argmax(run.brake < 0.0))
        for at, size in ((40, 1.5), (braking + 25, -1.5), (braking - 30, 1.5)):
            speed[at : at + BURST] += size
        runs.append(replace(run, speed=speed))
    found = find_slip(assemble(runs, believed))
    assert found is not None
    assert found[0].parameters['speed'] == pytest.approx(1.5, rel=0.3)


def test_single_outliers_are_no_slip(maker: Any, believed: TrainFile) -> None:
    rng, runs = np.random.default_rng(5), []
    for run in maker().runs(4, 14):
        single = rng.choice(np.arange(5, run.time.size - 5), 15, replace=False)
        speed = run.speed.copy()
        speed[single] += rng.choice([-1.0, 1.0], 15)
        runs.append(replace(run, speed=np.maximum(speed, 0.0)))
    assert find_slip(assemble(runs, believed)) is None


def test_nothing_slips(dataset: Dataset) -> None:
    assert find_slip(dataset) is None
