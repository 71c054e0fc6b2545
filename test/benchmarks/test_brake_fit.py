# SPDX-License-Identifier: Apache-2.0
"""The brakes of the benchmark do what they say, and a simulated one is scored in all quantities."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.brake_fit import LAWS, Law, Trial, draw_law, moments, run


@pytest.mark.parametrize(
    ('law', 'mean', 'spread'),
    [
        (Law('one lag', 0.5, (0.8,)), 1.3, 0.8),
        (Law('two lags', 0.5, (0.8, 0.6)), 1.9, 1.0),
        # A ramp of 1.6 s behind one of some 0.4 s.
        (Law('jerk limit', 0.5, (0.001,), jerk=0.5), 0.5 + 0.8 - 0.2, math.sqrt(1.6**2 - 0.4**2) / math.sqrt(12.0)),
    ],
)
def test_moments(law: Law, mean: float, spread: float) -> None:
    assert moments(law, -0.8) == pytest.approx((mean, spread), abs=0.04)


def test_the_mean_rate_is_that_over_loads() -> None:
    loads = np.linspace(0.0, 0.3, 1001)
    law = Law('load', 0.5, (0.8,), load=0.3)
    assert law.rate_at(10.0) == pytest.approx(float(np.mean(1.0 / (1.0 + loads))), rel=1e-3)


def test_every_law_can_be_drawn() -> None:
    assert {draw_law(name, np.random.default_rng(1)).name for name in LAWS} == set(LAWS)


@pytest.mark.long
def test_a_simulated_brake_is_scored() -> None:
    found = {score.quantity: score for score in run(Trial(7))}
    assert {'response time', 'dead time', 'time constant', 'rate at 9 m/s'} <= found.keys()
    assert all(abs(score.z) < 5.0 for score in found.values())
