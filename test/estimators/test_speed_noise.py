# SPDX-License-Identifier: Apache-2.0
"""The learned speed noise: correct for white noise, unaffected by motion, bounded under faults."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.estimators.speed_noise import SpeedNoise


def learned(speeds: list[float], dt: float = 0.2, declared: float = 0.025) -> SpeedNoise:
    noise = SpeedNoise.declared(declared).add(speeds[0], math.nan)
    for speed in speeds[1:]:
        noise = noise.add(speed, dt)
    return noise


@pytest.mark.parametrize('std', [0.01, 0.025, 0.1])
def test_white_noise_on_a_moving_train_is_learned(std: float) -> None:
    rng = np.random.default_rng(1)
    t = 0.2 * np.arange(3000)
    speeds = 15.0 + 5.0 * np.sin(0.1 * t) + std * rng.standard_normal(len(t))
    # With a memory of 100 correlated squares the error is 12 % of the variance, 6 % of the deviation: average some.
    found = [learned(speeds[:n].tolist()).std for n in range(1500, 3001, 250)]
    assert np.mean(found) == pytest.approx(std, rel=0.1)


def test_acceleration_is_not_taken_for_noise() -> None:
    t = 0.2 * np.arange(600)
    assert learned((0.9 * t).tolist()).std == pytest.approx(0.3 * 0.025)


def test_the_noise_stays_bounded_under_slip() -> None:
    rng = np.random.default_rng(2)
    speeds = 15.0 + 0.025 * rng.standard_normal(2000)
    speeds[rng.choice(2000, 60, replace=False)] += 5.0
    # 3 % outliers affect 9 % of the second differences, each limited to 3 sigma: the noise converges.
    assert learned(speeds.tolist()).std < 10.0 * 0.025
    assert learned([15.0, 100.0] * 1000).std == pytest.approx(10.0 * 0.025)


def test_unequal_steps_and_gaps_do_not_change_the_noise() -> None:
    noise = SpeedNoise.declared(0.025).add(10.0, math.nan).add(11.0, 0.2)
    assert noise.add(20.0, 0.4).variance == noise.variance
    assert noise.add(20.0, math.nan).variance == noise.variance
    again = noise.add(20.0, math.nan).add(10.0, 0.2)
    assert again.variance == noise.variance
    assert again.add(30.0, 0.2).variance > noise.variance


def test_one_second_difference_by_hand() -> None:
    noise = SpeedNoise.declared(0.1).add(10.0, math.nan).add(10.0, 0.2).add(10.3, 0.2)
    # 0.3^2 / 6 = 0.015, with a memory of 1 %.
    assert noise.variance == pytest.approx(0.01 + 0.01 * (0.015 - 0.01), rel=1e-12)
