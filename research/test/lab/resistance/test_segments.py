# SPDX-License-Identifier: Apache-2.0
"""Segments and windows against their definition, and their observations against the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from research.papers import coasts as data
from trainid_lab.resistance.segments import Cutter, Segments, Windows, bounds, cut, difference, observe
from trainid_ros.interface.errors import InputError

CLEAN = data.CoastPlan(noise_std=0.0, quantum=0.0)
UNITS = {'period': 0.2, 'rotary_mass': data.GAMMA, 'speed_unit': data.KMH}


@dataclass(frozen=True, slots=True)
class Speed:
    speed: float
    index: int


def coasts(plan: data.CoastPlan, seed: int = 3) -> data.Coasts:
    return data.drive(plan, np.random.default_rng(seed))


def test_a_segment_ends_at_the_change_and_the_next_starts_from_its_middle() -> None:
    speed = np.linspace(60.0, 58.7, 14)
    assert bounds(speed, Segments(0.5)) == [(0, 6), (2, 8), (4, 10), (6, 12), (8, 14)]


def test_windows_overlap_by_length_minus_hop() -> None:
    assert bounds(np.zeros(12), Windows(5, 3)) == [(0, 5), (3, 8), (6, 11)]
    assert bounds(np.zeros(4), Windows(5, 3)) == []


@pytest.mark.parametrize('cutter', [Segments(0.5), Segments(2.0), Windows(11, 5), Windows(7, 7)])
def test_stream_and_record_are_cut_identically(cutter: Cutter) -> None:
    speed = coasts(data.CoastPlan(coasts=1, slowest=70.0)).speed[0]
    pending, found = tuple[Speed, ...](), []
    for index, value in enumerate(speed):
        pending, piece = cut(pending, Speed(float(value), index), cutter)
        if piece:
            found.append((piece[0].index, piece[-1].index + 1))
    assert found == bounds(speed, cutter)
    assert len(found) > 5


def test_a_constant_speed_keeps_a_bounded_number_of_samples() -> None:
    pending = tuple[Speed, ...]()
    for index in range(1000):
        pending, piece = cut(pending, Speed(60.0, index), Segments(0.5))
        assert not piece
    assert len(pending) == Segments(0.5).longest


@pytest.mark.parametrize('cutter', [Segments(0.5), Windows(11, 5)])
def test_without_noise_the_resistance_is_exact_except_for_the_curvature(cutter: Cutter) -> None:
    records = coasts(CLEAN).true_speed
    seen = observe(records, cutter, **UNITS)
    # The slope of a line through a curve has an error of third order; and c (mean of v^2) is not c (mean v)^2.
    known_bias = data.PAPER[2] * 1.0**2 / 12.0
    assert np.abs(seen.y - data.resistance(data.PAPER, seen.v)).max() < 2.0 * known_bias
    assert len(seen.y) > 800


def test_differences_are_the_shortest_windows() -> None:
    seen = difference(coasts(CLEAN).true_speed, **UNITS)
    assert len(seen.y) == 24 * 224
    assert np.abs(seen.y - data.resistance(data.PAPER, seen.v)).max() < 1e-4


def test_the_gradient_is_subtracted() -> None:
    records = coasts(CLEAN).true_speed[:2]
    level, uphill = observe(records, Windows(11, 5), **UNITS), observe(records, Windows(11, 5), **UNITS, gradient=10.0)
    assert level.y - uphill.y == pytest.approx(10.0)


def test_the_weight_is_inversely_proportional_to_the_variance_of_white_noise() -> None:
    rng = np.random.default_rng(8)
    records: NDArray[np.float64] = 50.0 + 0.04 * rng.standard_normal((4000, 22))
    for length in (6, 22):
        seen = observe(records, Windows(length, length), **UNITS)
        expected = (data.INERTIA * 0.04) ** 2 / seen.weight[0]
        assert np.var(seen.y) == pytest.approx(expected, rel=0.1)


def test_stopping_at_a_change_of_noisy_speed_is_biased_and_fixed_windows_are_not() -> None:
    fast = data.CoastPlan(coasts=60, slowest=75.0)
    stopped, fixed = (observe(coasts(fast, 11).speed, cutter, **UNITS) for cutter in (Segments(0.5), Windows(11, 5)))
    bias = [float(np.mean(seen.y - data.resistance(data.PAPER, seen.v))) for seen in (stopped, fixed)]
    assert bias[0] > 0.15
    assert abs(bias[1]) < 0.02


def test_a_hop_longer_than_the_window_is_an_error() -> None:
    with pytest.raises(InputError, match=r'hop = 12 must lie in \[1, window = 11\]'):
        Windows(11, 12)
