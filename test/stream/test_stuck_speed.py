# SPDX-License-Identifier: Apache-2.0
"""Samples of a stuck speed sensor are rejected; a steady speed is not taken for a stuck sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.stream.sample_stream import StuckSpeed
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import Brake, TrainFile

Make = Callable[..., Sample]


def rejections(train_file: TrainFile, samples: list[Sample]) -> list[Rejection | None]:
    detector, noise = StuckSpeed(KnownForce(train_file)), SpeedNoise.declared(0.025)
    found = []
    for item in samples:
        found.append(detector.reject(item, noise))
        noise.add(item.speed, item.dt)
    return found


def test_a_speed_unaffected_by_the_brake_is_rejected_once_half_a_metre_per_second_is_missing(
    train_file: TrainFile, sample: Make
) -> None:
    file = replace(train_file, brake=Brake(delay=0.7, time_constant=0.4))
    found = rejections(file, [sample(i + 1, speed=12.0, brake_command=-0.8) for i in range(20)])
    # After 7 samples the brake need not have followed (0.7 + 2 * 0.4 s); after 4 more, 0.64 m/s are missing.
    assert [item is not None for item in found] == [False] * 10 + [True] * 10
    assert found[10] is not None
    assert found[10].reason is Reason.SPEED_STUCK
    assert found[10].value == pytest.approx(-0.64)


def test_a_coarse_speed_may_stay_the_same_during_a_long_dead_time(train_file: TrainFile, sample: Make) -> None:
    file = replace(train_file, brake=Brake(delay=3.3, time_constant=0.8))
    assert not any(rejections(file, [sample(i + 1, speed=12.0, brake_command=-1.2) for i in range(20)]))


def test_a_speed_unaffected_by_traction_is_rejected(train_file: TrainFile, sample: Make) -> None:
    pull = 2e5
    found = rejections(train_file, [sample(i + 1, speed=12.0, force=pull, force_mean=pull) for i in range(60)])
    assert found[-1] is not None


def test_the_speed_is_accepted_again_as_soon_as_it_changes(train_file: TrainFile, sample: Make) -> None:
    stuck = [sample(i + 1, speed=12.0, brake_command=-0.8) for i in range(20)]
    assert rejections(train_file, [*stuck, sample(21, speed=11.0, brake_command=-0.8)])[-1] is None


def test_a_steady_cruise_and_a_held_train_are_accepted(train_file: TrainFile, sample: Make) -> None:
    davis = train_file.resistance
    pull = (davis.a + 20.0 * davis.b + 400.0 * davis.c) * train_file.train.mass * G / 1000.0
    cruise = [sample(i + 1, speed=20.0, force=pull, force_mean=pull) for i in range(500)]
    held = [sample(i + 1, speed=0.0, brake_command=-0.5) for i in range(500)]
    noisy = [
        replace(item, speed=item.speed + 0.03 * (i % 2))
        for i, item in enumerate(sample(k + 1, speed=12.0, brake_command=-0.8) for k in range(50))
    ]
    assert not any(rejections(train_file, cruise + held + noisy))


def cruise(sample: Make, rng: np.random.Generator, std: float, quantum: float, count: int = 200) -> list[Sample]:
    """Return samples of a cruise at 12 m/s with noise and steps of the speed [m/s]."""
    speeds = 12.0 + std * rng.standard_normal(count)
    return [sample(k + 1, speed=float(round(v / quantum) * quantum)) for k, v in enumerate(speeds)]


@pytest.mark.parametrize(('quantum', 'most'), [(1e-6, 5), (0.01, 9)])
def test_a_noisy_speed_that_repeats_is_stuck(train_file: TrainFile, sample: Make, quantum: float, most: int) -> None:
    noisy = cruise(sample, np.random.default_rng(1), 0.03, quantum)
    stuck = [sample(201 + k, speed=12.0) for k in range(40)]
    found = rejections(train_file, [*noisy, *stuck])
    first = next(k for k, item in enumerate(found) if item is not None) - len(noisy)
    assert most - 3 <= first <= most + 6


@pytest.mark.parametrize(('std', 'quantum'), [(0.03, 0.1), (0.0, 0.05), (0.1, 0.2)])
def test_a_speed_in_coarse_steps_may_repeat(train_file: TrainFile, sample: Make, std: float, quantum: float) -> None:
    davis = train_file.resistance
    pull = (davis.a + 12.0 * davis.b + 144.0 * davis.c) * train_file.train.mass * G / 1000.0
    noisy = cruise(sample, np.random.default_rng(1), std, quantum, 1000)
    held = [replace(item, speed=12.0) for item in noisy[:100]]
    assert not any(rejections(train_file, [replace(s, force=pull, force_mean=pull) for s in [*noisy, *held]]))
