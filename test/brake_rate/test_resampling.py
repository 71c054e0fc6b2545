# SPDX-License-Identifier: Apache-2.0
"""Weights compared with their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.brake_rate.resampling import effective_number, normal_weights


def test_weights_sum_to_one_at_any_scale() -> None:
    logs = np.array([-3.0, 0.0, 2.0])
    assert normal_weights(logs + 1e5) == pytest.approx(np.exp(logs) / np.exp(logs).sum(), abs=1e-9)


def test_impossible_particles_have_zero_weight_unless_all_are_impossible() -> None:
    assert normal_weights(np.array([-np.inf, 0.0, 0.0])) == pytest.approx([0.0, 0.5, 0.5])
    assert normal_weights(np.full(4, -np.inf)) == pytest.approx([0.25] * 4)


def test_effective_number_by_hand() -> None:
    assert effective_number(np.full(8, 0.125)) == pytest.approx(8.0)
    assert effective_number(np.array([1.0, 0.0, 0.0])) == pytest.approx(1.0)
    assert effective_number(np.array([0.5, 0.25, 0.25])) == pytest.approx(1.0 / 0.375)
