# SPDX-License-Identifier: Apache-2.0
"""The speed noise and the correlation of innovations are estimated with and without gross errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.resistance.slow_noise import SlowNoise
from trainid_ros.resistance.tachometer import Tachometer


def learned(speeds: list[float], declared: float) -> float:
    """Return the median of the learned standard deviation over the second half."""
    tachometer, found = Tachometer(declared, declared**2), []
    for i, speed in enumerate(speeds):
        tachometer.add(speed, math.nan if i == 0 else 0.2)
        found.append(tachometer.std)
    return float(np.median(found[len(found) // 2 :]))


@pytest.mark.parametrize('std', [0.01, 0.03, 0.1])
def test_speed_noise_is_estimated_also_with_gross_errors(std: float) -> None:
    rng = np.random.default_rng(21)
    i = np.arange(4000)
    clean = 12.0 + 3.0 * np.sin(i / 150.0) + std * rng.standard_normal(4000)
    spoiled = np.where(rng.random(4000) < 0.05, clean + rng.uniform(0.5, 3.0, 4000), clean)
    assert learned(clean.tolist(), 0.025) == pytest.approx(std, rel=0.07)
    assert std < learned(spoiled.tolist(), 0.025) < 1.35 * std


def test_gaps_and_uneven_steps_do_not_change_the_noise() -> None:
    tachometer = Tachometer(0.02, 0.02**2)
    for i, (speed, dt) in enumerate([(10.0, math.nan), (11.0, 0.2), (13.0, math.nan), (17.0, 0.2), (25.0, 0.4)]):
        tachometer.add(speed, dt)
        assert tachometer.std == 0.02, i
    tachometer.add(41.0, 0.4)
    assert tachometer.std > 0.02


@pytest.mark.parametrize(('rho', 'expected'), [(0.0, 1.0), (0.6, 4.0), (-0.5, 1.0 / 3.0)])
def test_the_factor_is_long_run_over_marginal_variance(rho: float, expected: float) -> None:
    """AR(1): (1 + rho) / (1 - rho). A batch of 20 contains most of it, and large sums are capped."""
    rng = np.random.default_rng(22)
    slow, x, found = SlowNoise(), 0.0, []
    for _ in range(40_000):
        x = rho * x + math.sqrt(1.0 - rho * rho) * float(rng.standard_normal())
        slow.add(0.3 * x, 0.0, 0.09 * slow.factor, (0.1, 10.0))
        found.append(slow.factor)
    assert float(np.mean(found[2000:])) == pytest.approx(expected, rel=0.25)


def test_one_batch_of_a_step_does_not_count_as_noise() -> None:
    slow = SlowNoise()
    for _ in range(20):
        slow.add(50.0, 0.0, 1.0, (0.1, 10.0))
    assert slow.factor <= 1.5
