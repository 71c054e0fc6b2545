# SPDX-License-Identifier: Apache-2.0
"""Verdicts of the benchmark depend on the numbers."""

from __future__ import annotations

import math

import pytest

from research.papers.xia2023 import unit_verdict
from research.papers.xia2023_fits import mean_squares
from research.papers.yuan_claims import (
    PRINTED_RANGES,
    parameters_verdict,
    ranges_verdict,
    sharp_noise,
    sharp_verdict,
)
from research.papers.zheng2015 import cost_verdict


@pytest.mark.parametrize(
    ('count', 'share', 'verdict'),
    [
        (0.27, 0.3, 'confirmed'),
        (0.27, 0.6, 'confirmed in count only, the other is 2.0 x printed'),
        (1.2, 0.3, 'confirmed in CPU time only, the other is 4.0 x printed'),
        (1.2, 0.6, 'refuted: 4.0 x printed in count, 2.0 x in CPU time'),
    ],
)
def test_cost_is_confirmed_by_count_and_by_time(count: float, share: float, verdict: str) -> None:
    assert cost_verdict(0.3, count, share) == verdict


def test_share_of_small_noise_follows_the_normal_distribution() -> None:
    assert sharp_noise(0.005) == pytest.approx(0.6827, abs=1e-4)
    assert sharp_noise(0.005 / 1.959964) == pytest.approx(0.95, abs=1e-5)


def test_verdict_on_small_errors_depends_on_noise() -> None:
    as_noise = 'as with noise alone, so it characterises the sensor'
    assert sharp_verdict({0.002: 0.9, 0.02: 0.2}) == f'confirmed at noise of 0.002 m/s, refuted at 0.02: {as_noise}'
    assert sharp_verdict({0.002: 0.4, 0.02: 0.2}) == 'refuted at every noise: noise alone gives another result'
    assert sharp_verdict({0.002: 0.9, 0.02: 0.6}).startswith('confirmed at noise of 0.002, 0.02 m/s: noise alone')


def test_converged_parameters_are_listed() -> None:
    assert parameters_verdict((0.1, 0.1, 0.0, 0.19)) == 'confirmed'
    assert parameters_verdict((3.0, 0.9, 0.01, 0.5)) == 'refuted: of four only b1 within 20%'
    assert parameters_verdict((3.0, 0.9, 0.3, math.nan)) == 'refuted: of four none within 20%'


def test_verdict_on_ranges_uses_sign_and_size() -> None:
    true = {'a1': (-3e-5, -1e-5), 'a2': (0.99, 0.9999), 'b1': (0.0016, 0.002), 'd0': (-0.3, 0.3)}
    verdict = ranges_verdict(true)
    assert 'a1 up to 400 times' in verdict
    for wrong in ('a1 = 0.008', 'a2 = 1.02', 'b1 = -0.003'):
        assert wrong in verdict
    assert 'a1 up to 4 times' in ranges_verdict({**true, 'a1': (-3e-3, -1e-5)})
    assert set(PRINTED_RANGES) < set(true)


def test_verdict_on_unit_uses_the_largest_random_start() -> None:
    assert unit_verdict(40.0, 2000.0) == 'confirmed'
    assert unit_verdict(904.0, 2000.0) == 'confirmed with another unit: (m/s)^2'
    assert unit_verdict(904.0, 500.0).startswith('refuted')


def test_mean_square_is_that_of_noise_at_the_minimum_and_large_at_starts() -> None:
    starts, least = mean_squares(6000)
    assert least == pytest.approx(0.18**2, rel=0.2)
    assert starts > 100.0
