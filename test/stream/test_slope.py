# SPDX-License-Identifier: Apache-2.0
"""The slope of the acceleration over traction: when it is known, and what a wrong one looks like."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.stream.slope import Slope


def learned(factor: float, noise: float = 5.0, blocks: int = 20, x: float = 60.0) -> Slope:
    rng, slope = np.random.default_rng(3), Slope()
    for value in x * rng.uniform(0.5, 1.0, blocks):
        slope.add(factor * value + noise * float(rng.standard_normal()), float(value))
    return slope


def test_the_slope_is_that_of_the_regression_through_the_origin() -> None:
    assert learned(0.9).value == pytest.approx(0.9, abs=0.05)
    assert learned(0.9).is_known


@pytest.mark.parametrize('slope', [learned(0.9, blocks=4), learned(0.9, noise=40.0), Slope()])
def test_few_or_noisy_blocks_give_no_slope(slope: Slope) -> None:
    assert not slope.is_known
    slope.finding = 'as before'
    slope.judge_traction(0.0, 4.0)
    assert slope.finding == 'as before'


@pytest.mark.parametrize(
    ('factor', 'text'),
    [(1.0, ''), (0.7, ''), (1.5, ''), (-1.0, 'wrong sign'), (3.6, 'km/h'), (0.3, '0.3 times'), (1e3, 'kN')],
)
def test_a_wrong_slope_is_named_by_its_size(factor: float, text: str) -> None:
    slope = learned(factor, noise=1.0 + abs(factor))
    slope.judge_traction(0.0, 4.0)
    assert text in slope.finding
    assert bool(slope.finding) == bool(text)


def test_a_small_traction_says_nothing_since_map_and_resistance_are_off_by_as_much() -> None:
    slope = learned(2.5, noise=0.1, x=6.0)
    slope.judge_traction(0.0, 4.0)
    assert slope.finding == ''


def test_a_speed_that_does_not_follow_is_unrelated_unless_it_is_only_noise() -> None:
    slope = learned(0.0, noise=60.0)
    assert slope.is_unrelated(0.0)
    assert not slope.is_unrelated(100.0)


def test_a_few_blocks_that_are_off_do_not_count_and_many_in_a_row_do() -> None:
    slope = learned(1.0)
    for _ in range(3):
        for _ in range(7):
            slope.take(300.0, 60.0, 40.0)
        slope.take(60.0, 60.0, 40.0)
    assert slope.value == pytest.approx(1.0, abs=0.1)
    for _ in range(8):
        slope.take(300.0, 60.0, 40.0)
    assert slope.value > 2.0
    assert slope.is_valid


def test_a_wrong_slope_is_forgotten_soon_when_it_is_mended() -> None:
    slope = learned(-1.0, noise=1.0)
    slope.judge_traction(0.0, 4.0)
    count = 0
    while slope.finding:
        slope.add(60.0, 60.0)
        slope.judge_traction(0.0, 4.0)
        count += 1
    assert 6 < count < 60
