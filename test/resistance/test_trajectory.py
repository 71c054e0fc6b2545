# SPDX-License-Identifier: Apache-2.0
"""Pieces: braking and gaps end them, short ones are removed. Noise: white, a random walk, and rounding."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from trainid_ros.interface.results import Reason
from trainid_ros.resistance.davis_fit import PieceCollector, Trajectory, half_variance, rounding_variance
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile


def collect(train_file: TrainFile, samples: list[Sample]) -> tuple[PieceCollector, Counter[Reason]]:
    collector, rejected = PieceCollector(train_file, 1.0, 2.0), Counter[Reason]()
    for sample in samples:
        collector.add(sample, rejected)
    return collector, rejected


def test_pieces_begin_after_gaps_and_short_ones_are_removed(
    train_file: TrainFile, sample: Callable[..., Sample]
) -> None:
    given = [sample(i, dt=math.nan if i in (0, 30, 35) else 0.2) for i in range(80)]
    collector, rejected = collect(train_file, given)
    trajectory = collector.trajectory()
    assert rejected == {Reason.GAP: 3}
    assert trajectory.starts.tolist() == [0, 29]
    assert trajectory.speed.size == 29 + 44
    assert np.all(trajectory.known == 0.0)


def test_traction_and_gradient_are_stored_separately(train_file: TrainFile, sample: Callable[..., Sample]) -> None:
    weight = 200e3 * 9.80665 / 1000.0
    given = [sample(i, force_mean=8.0 * weight, force=8.0 * weight, gradient_mean=3.0) for i in range(40)]
    trajectory = collect(train_file, given)[0].trajectory()
    assert trajectory.traction == pytest.approx(8.0)
    assert trajectory.known == pytest.approx(5.0)


def test_monitored_braking_is_tracked_and_rejects_samples_until_released(
    train_file: TrainFile, sample: Callable[..., Sample]
) -> None:
    collector = PieceCollector(train_file, 1.0, 2.0)
    for i in range(1, 20):
        collector.monitor(sample(i, speed=16.0 - 0.1 * i, brake_command=-0.5))
    rejected: Counter[Reason] = Counter()
    for i in range(20, 60):
        collector.add(sample(i, speed=14.0 - 0.001 * i), rejected)
    # The brake needs 0.6 s and eight time constants of 0.4 s after its release.
    assert rejected[Reason.BRAKING] in (18, 19)
    assert collector.trajectory().speed.size == 40 - rejected[Reason.BRAKING]


def test_half_variance_of_noise_and_of_a_walk() -> None:
    rng, one = np.random.default_rng(31), np.zeros(20_000, dtype=np.intp)
    assert half_variance(0.2 * rng.standard_normal(one.size), one, 1) == pytest.approx(0.04, rel=0.1)
    walk = np.cumsum(0.1 * rng.standard_normal(one.size))
    assert half_variance(walk, one, 10) == pytest.approx(0.05, rel=0.2)


def test_increments_between_pieces_do_not_count() -> None:
    y = np.repeat(np.array([0.0, 5.0, -3.0]), 3)
    assert half_variance(y, np.repeat(np.arange(3), 3), 2) == 0.0


@pytest.mark.parametrize('quantum', [0.01, 0.28])
def test_rounding_variance_is_that_of_increments_of_rounded_motion(quantum: float) -> None:
    rng = np.random.default_rng(32)
    dt = np.full(20_000, 0.2)
    dt[0] = 0.0
    exact = 30.0 + np.cumsum(0.05 * rng.standard_normal(dt.size))
    spoiled = np.where(rng.random(dt.size) < 0.005, rng.uniform(0.0, 40.0, dt.size), exact)
    rounded = quantum * np.round(spoiled / quantum)
    given = Trajectory(rounded, dt, np.zeros(dt.size), np.zeros(dt.size), 110.0)
    errors = rounded - spoiled
    assert half_variance(errors, np.zeros(dt.size, dtype=np.intp), 100) == pytest.approx(
        rounding_variance(given), rel=0.15
    )
