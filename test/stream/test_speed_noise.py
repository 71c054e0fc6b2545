# SPDX-License-Identifier: Apache-2.0
"""The learned speed noise: correct for white noise, unaffected by motion, bounded under faults.

The rounding error of a coarse speed is found; that of a fine one is negligible.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.stream.known_force import SpeedNoise

KMH = 1.0 / 3.6


def learned(speeds: list[float], dt: float = 0.2, declared: float = 0.025) -> SpeedNoise:
    return after([(speed, math.nan if i == 0 else dt) for i, speed in enumerate(speeds)], declared)


def after(measured: list[tuple[float, float]], declared: float = 0.025, *, robust: bool = False) -> SpeedNoise:
    """Return the noise after speeds [m/s], each some time after the last [s]."""
    noise = SpeedNoise.declared(declared, robust=robust)
    for speed, dt in measured:
        noise.add(speed, dt)
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
    start, declared = [(10.0, math.nan), (11.0, 0.2)], 0.025**2
    assert after([*start, (20.0, 0.4)]).variance == declared
    again = [*start, (20.0, math.nan), (10.0, 0.2)]
    for count in range(1, 5):
        assert after(again[:count]).variance == declared
    assert after([*again, (30.0, 0.2)]).variance > declared


def test_one_second_difference_by_hand() -> None:
    measured = [(10.0, math.nan), (10.0, 0.2), (10.3, 0.2)]
    # 0.3^2 / 6 = 0.015, with a memory of 1 %.
    assert after(measured, 0.1).variance == pytest.approx(0.01 + 0.01 * (0.015 - 0.01), rel=1e-12)
    # Capped at 0.01, and divided by E min(z^2, 1) = 0.516.
    assert after(measured, 0.1, robust=True).variance == pytest.approx(0.01 + 0.01 * (0.01 / 0.51606 - 0.01), rel=1e-12)


def robust_std(speeds: list[float], declared: float) -> float:
    """Return the median of the learned standard deviation over the second half."""
    noise, found = SpeedNoise.declared(declared, robust=True), []
    for i, speed in enumerate(speeds):
        noise.add(speed, math.nan if i == 0 else 0.2)
        found.append(noise.std)
    return float(np.median(found[len(found) // 2 :]))


@pytest.mark.parametrize('std', [0.01, 0.03, 0.1])
def test_speed_noise_is_estimated_also_with_gross_errors(std: float) -> None:
    rng = np.random.default_rng(21)
    i = np.arange(4000)
    clean = 12.0 + 3.0 * np.sin(i / 150.0) + std * rng.standard_normal(4000)
    spoiled = np.where(rng.random(4000) < 0.05, clean + rng.uniform(0.5, 3.0, 4000), clean)
    assert robust_std(clean.tolist(), 0.025) == pytest.approx(std, rel=0.07)
    assert std < robust_std(spoiled.tolist(), 0.025) < 1.35 * std


def test_a_noise_much_larger_than_declared_is_learned_in_half_a_minute() -> None:
    rng = np.random.default_rng(5)
    found = list[float]()
    for _ in range(20):
        noise = SpeedNoise.declared(0.02, robust=True, squares=3.0)
        for i in range(150):
            noise.add(12.0 + 0.15 * float(rng.standard_normal()), math.nan if i == 0 else 0.2)
        found.append(noise.std)
    assert 0.11 < np.mean(found) < 0.17


def test_gaps_and_uneven_steps_do_not_change_the_robust_noise() -> None:
    noise = SpeedNoise.declared(0.02, robust=True)
    for i, (speed, dt) in enumerate([(10.0, math.nan), (11.0, 0.2), (13.0, math.nan), (17.0, 0.2), (25.0, 0.4)]):
        noise.add(speed, dt)
        assert noise.std == 0.02, i
    noise.add(41.0, 0.4)
    assert noise.std > 0.02


def coasting(quantum: float, noise: float, slowing: float = 0.05, count: int = 1200) -> list[float]:
    rng = np.random.default_rng(41)
    speeds = 20.0 - 0.2 * slowing * np.arange(count) + noise * rng.standard_normal(count)
    rounded: list[float] = (quantum * np.round(speeds / quantum)).tolist()
    return rounded


def test_samples_between_two_jumps_count_as_one_sample() -> None:
    noise = learned(coasting(KMH, 0.0))
    jump_every = KMH / 0.01
    assert noise.quantum == pytest.approx(KMH)
    assert noise.rounding == pytest.approx(KMH**2 / 12.0 * jump_every, rel=0.6)


def test_a_wrong_message_is_forgotten() -> None:
    speeds = coasting(KMH, 0.1)
    speeds[300] += 0.01
    assert learned(speeds[:310]).quantum < 0.02
    assert learned(speeds + speeds + speeds).quantum == pytest.approx(KMH)


def test_slip_is_not_taken_for_a_quantum() -> None:
    assert learned([15.0] * 50 + [18.0, 15.0]).rounding == 0.0


def test_the_variance_stays_bounded_at_rest_and_with_a_stuck_speed() -> None:
    moving = coasting(KMH, 0.0)
    stuck, standing = learned(moving + [15.0] * 10_000), learned(moving + [0.0] * 10_000)
    assert (standing.quantum, standing.changed) == (learned(moving).quantum, learned(moving).changed)
    assert stuck.rounding == pytest.approx(KMH**2 / 12.0 * 50.0)


def test_long_coasting_does_not_make_the_noise_of_driving_too_small() -> None:
    """While coasting most second differences of a coarse speed are zero."""
    quantum, rng = 0.4 * KMH, np.random.default_rng(7)
    true = [20.0 - 0.01 * i for i in range(300)] + [17.0 + 0.1 * i for i in range(50)]
    robust, noise = SpeedNoise.declared(0.025, robust=True), SpeedNoise.declared(0.025)
    for i, speed in enumerate(true):
        measured = quantum * round((speed + 0.02 * rng.standard_normal()) / quantum)
        robust.add(measured, math.nan if i == 0 else 0.2)
        noise.add(measured, math.nan if i == 0 else 0.2)
    error = math.hypot(0.02, quantum / math.sqrt(12.0))
    assert 0.8 * error < robust.std < 2.0 * error
    assert 0.8 * error < noise.std < 2.0 * error


@pytest.mark.parametrize(('quantum', 'coarse'), [(KMH, True), (0.1 * KMH, False), (1e-6, False)])
def test_both_kinds_of_noise_include_coarse_rounding_only(quantum: float, coarse: bool) -> None:
    robust, noise = SpeedNoise.declared(0.025, robust=True), SpeedNoise.declared(0.025)
    for i, speed in enumerate(coasting(quantum, 0.02)):
        dt = math.nan if i == 0 else 0.2
        robust.add(speed, dt)
        noise.add(speed, dt)
        assert robust.rounding == noise.rounding
        if not coarse:
            assert (robust.variance, noise.variance) == (robust.learned, noise.learned)
    assert (noise.std > KMH / math.sqrt(12.0)) is coarse
