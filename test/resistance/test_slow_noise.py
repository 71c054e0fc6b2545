# SPDX-License-Identifier: Apache-2.0
"""The correlation of innovations is estimated with and without gross errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.resistance.long_run_variance import SlowNoise


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
