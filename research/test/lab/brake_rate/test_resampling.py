# SPDX-License-Identifier: Apache-2.0
"""Weights and resampling compared with their definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainid_lab.brake_rate.particles import effective_number, normal_weights, normalise, systematic

LOGS = st.lists(st.floats(-1000.0, 1000.0), min_size=1, max_size=30)


@given(LOGS, st.floats(-1e5, 1e5))
def test_normalised_weights_sum_to_one_at_any_scale(logs: list[float], shift: float) -> None:
    weights = np.exp(normalise(np.array(logs) + shift))
    assert weights.sum() == pytest.approx(1.0, abs=1e-9)
    ratio = normalise(np.array(logs))
    # Adding a number to 1e5 costs 1e-11 of it.
    assert np.exp(ratio) == pytest.approx(weights, abs=1e-9)


def test_impossible_particles_keep_zero_weight_unless_all_are_impossible() -> None:
    assert np.exp(normalise(np.array([-np.inf, 0.0, 0.0]))) == pytest.approx([0.0, 0.5, 0.5])
    assert np.exp(normalise(np.full(4, -np.inf))) == pytest.approx([0.25] * 4)


@given(LOGS, st.integers(1, 50), st.floats(0.0, 1.0, exclude_max=True))
def test_each_particle_is_kept_in_proportion_to_its_weight(logs: list[float], count: int, uniform: float) -> None:
    weights = np.exp(normalise(0.01 * np.array(logs)))
    kept = np.bincount(systematic(weights, count, uniform), minlength=len(weights))
    assert kept.sum() == count
    # Systematic resampling differs from the expectation by less than one, apart from rounding.
    assert np.all(np.abs(kept - count * weights) < 1.0 + 1e-6)


def test_resampling_is_unbiased() -> None:
    weights = np.array([0.07, 0.53, 0.0, 0.29, 0.11])
    draws = (np.arange(20_000) + 0.5) / 20_000
    kept = sum(np.bincount(systematic(weights, 7, float(u)), minlength=5) for u in draws) / len(draws)
    # The mean over all draws is the expectation; the grid of draws is 5e-5 fine.
    assert kept == pytest.approx(7 * weights, abs=1e-3)


def test_weights_that_sum_to_less_than_one_give_valid_indices() -> None:
    weights = np.full(10, 0.1 * (1.0 - 1e-9))
    assert weights.sum() < 1.0
    kept = systematic(weights, 1000, math.nextafter(1.0, 0.0))
    assert kept.max() == 9
    assert systematic(np.array([0.5, 0.2]), 4, 0.99).tolist() == [0, 0, 1, 1]


def test_weights_of_logarithms_by_hand() -> None:
    logs = np.array([-3.0, 0.0, 2.0])
    assert normal_weights(logs + 1e5) == pytest.approx(np.exp(logs) / np.exp(logs).sum(), abs=1e-9)
    assert normal_weights(np.array([-np.inf, 0.0, 0.0])) == pytest.approx([0.0, 0.5, 0.5])
    assert normal_weights(np.full(4, -np.inf)) == pytest.approx([0.25] * 4)


def test_effective_number_by_hand() -> None:
    assert effective_number(np.full(8, 0.125)) == pytest.approx(8.0)
    assert effective_number(np.array([1.0, 0.0, 0.0])) == pytest.approx(1.0)
    assert effective_number(np.array([0.5, 0.25, 0.25])) == pytest.approx(1.0 / 0.375)
