# SPDX-License-Identifier: Apache-2.0
"""Bursts of slip and slide, and outliers that are not slip."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import Dataset, assemble
from trainid_ros.explain.slip import find_slip
from trainid_ros.train.train_file import TrainFile

BURST = 6


def spoiled(maker: Any, train_file: TrainFile, sign: float) -> Dataset:
    """Return four runs with a burst under traction and one while braking; sign +1: as the force, 0: random."""
    rng, runs = np.random.default_rng(4), []
    for run in maker().runs(4, 13):
        speed = run.speed.copy()
        for at in (40, int(np.argmax(run.brake < 0.0)) + 25):
            with_force = np.sign(run.traction[at] + run.brake[at])
            speed[at : at + BURST] += 1.5 * (sign * with_force if sign else rng.choice([-1.0, 1.0]))
        runs.append(replace(run, speed=speed))
    return assemble(runs, train_file)


def test_bursts_with_the_sign_of_the_force_are_slip(maker: Any, train_file: TrainFile) -> None:
    dataset = spoiled(maker, train_file, 1.0)
    found = find_slip(dataset)
    assert found is not None
    term, evidence = found
    assert evidence > 10.0
    assert term.parameters['share'] == pytest.approx(8 * BURST / dataset.dt.size, rel=0.2)
    assert abs(term.parameters['speed'] - 1.5) < 2.0 * term.std['speed']


@pytest.mark.parametrize('sign', [-1.0, 0.0])
def test_bursts_of_other_sign_are_no_slip(maker: Any, train_file: TrainFile, sign: float) -> None:
    assert find_slip(spoiled(maker, train_file, sign)) is None


def test_bursts_without_a_force_are_ignored(maker: Any, train_file: TrainFile) -> None:
    """There are half as many of these, as from a faulty wheel sensor while coasting."""
    runs = []
    for run in maker().runs(4, 13):
        speed = run.speed.copy()
        braking = int(np.argmax(run.brake < 0.0))
        for at, size in ((40, 1.5), (braking + 25, -1.5), (braking - 30, 1.5)):
            speed[at : at + BURST] += size
        runs.append(replace(run, speed=speed))
    found = find_slip(assemble(runs, train_file))
    assert found is not None
    assert found[0].parameters['speed'] == pytest.approx(1.5, rel=0.3)


def test_single_outliers_are_no_slip(maker: Any, train_file: TrainFile) -> None:
    rng, runs = np.random.default_rng(5), []
    for run in maker().runs(4, 14):
        single = rng.choice(np.arange(5, run.time.size - 5), 15, replace=False)
        speed = run.speed.copy()
        speed[single] += rng.choice([-1.0, 1.0], 15)
        runs.append(replace(run, speed=np.maximum(speed, 0.0)))
    assert find_slip(assemble(runs, train_file)) is None


def test_clean_data_have_no_slip(dataset: Dataset) -> None:
    assert find_slip(dataset) is None
