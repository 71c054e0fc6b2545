# SPDX-License-Identifier: Apache-2.0
"""The rounding error of a coarse speed is found; that of a fine one is negligible."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from trainid_ros.estimators.rounding import EXACT, Rounding
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.resistance.tachometer import Tachometer

KMH = 1.0 / 3.6


def coasting(quantum: float, noise: float, slowing: float = 0.05, count: int = 1200) -> list[float]:
    rng = np.random.default_rng(41)
    speeds = 20.0 - 0.2 * slowing * np.arange(count) + noise * rng.standard_normal(count)
    rounded: list[float] = (quantum * np.round(speeds / quantum)).tolist()
    return rounded


def after(speeds: list[float]) -> Rounding:
    rounding = EXACT
    for last, speed in pairwise(speeds):
        rounding = rounding.add(speed, last)
    return rounding


def test_samples_between_two_jumps_count_as_one_sample() -> None:
    rounding = after(coasting(KMH, 0.0))
    jump_every = KMH / 0.01
    assert rounding.quantum == pytest.approx(KMH)
    assert rounding.variance == pytest.approx(KMH**2 / 12.0 * jump_every, rel=0.6)


def test_a_wrong_message_is_forgotten() -> None:
    speeds = coasting(KMH, 0.1)
    speeds[300] += 0.01
    assert after(speeds[:310]).quantum < 0.02
    assert after(speeds + speeds + speeds).quantum == pytest.approx(KMH)


def test_slip_is_not_taken_for_a_quantum() -> None:
    assert after([15.0] * 50 + [18.0, 15.0]).variance == 0.0


def test_the_variance_stays_bounded_at_rest_and_with_a_stuck_speed() -> None:
    moving = after(coasting(KMH, 0.0))
    stuck, standing = moving, moving
    for _ in range(10_000):
        stuck, standing = stuck.add(15.0, 15.0), standing.add(0.0, 0.0)
    assert standing == moving
    assert stuck.variance == pytest.approx(KMH**2 / 12.0 * 50.0)


def test_long_coasting_does_not_make_the_noise_of_driving_too_small() -> None:
    """While coasting most second differences of a coarse speed are zero."""
    quantum, rng = 0.4 * KMH, np.random.default_rng(7)
    true = [20.0 - 0.01 * i for i in range(300)] + [17.0 + 0.1 * i for i in range(50)]
    tachometer, noise = Tachometer(0.025, 0.025**2), SpeedNoise.declared(0.025)
    for i, speed in enumerate(true):
        measured = quantum * round((speed + 0.02 * rng.standard_normal()) / quantum)
        tachometer.add(measured, math.nan if i == 0 else 0.2)
        noise = noise.add(measured, math.nan if i == 0 else 0.2)
    error = math.hypot(0.02, quantum / math.sqrt(12.0))
    assert 0.8 * error < tachometer.std < 2.0 * error
    assert 0.8 * error < noise.std < 2.0 * error


@pytest.mark.parametrize(('quantum', 'coarse'), [(KMH, True), (0.1 * KMH, False), (1e-6, False)])
def test_both_noise_models_include_coarse_rounding_only(quantum: float, coarse: bool) -> None:
    tachometer, noise = Tachometer(0.025, 0.025**2), SpeedNoise.declared(0.025)
    for i, speed in enumerate(coasting(quantum, 0.02)):
        dt = math.nan if i == 0 else 0.2
        tachometer.add(speed, dt)
        noise = noise.add(speed, dt)
        assert tachometer.rounding == noise.rounding
        if not coarse:
            assert (tachometer.variance, noise.variance) == (tachometer.learned, noise.learned)
    assert (noise.std > KMH / math.sqrt(12.0)) is coarse
