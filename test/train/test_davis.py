# SPDX-License-Identifier: Apache-2.0
"""The specific balance against hand calculation, and its inverses."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.train.forces import G, acceleration, davis, required_force, specific_force, specific_inertia
from trainid_ros.train.train_file import Davis


def test_davis_against_hand_calculation() -> None:
    assert davis(Davis(1.0, 0.03, 0.003), 20.0) == pytest.approx(1.0 + 0.6 + 1.2)


def test_davis_accepts_arrays() -> None:
    v = np.array([0.0, 10.0])
    assert davis(Davis(1.0, 0.03, 0.003), v) == pytest.approx([1.0, 1.6])


def test_acceleration_against_hand_calculation() -> None:
    # 200 t, 98.0665 kN: 50 N/kN; resistance takes 10 N/kN, the remaining 40 N/kN accelerate 1.08 times the mass.
    force = 0.05 * 200e3 * G
    assert specific_force(force, 200e3) == pytest.approx(50.0)
    assert acceleration(force, 200e3, 0.08, 10.0) == pytest.approx(0.04 * G / 1.08)
    assert specific_inertia(0.04 * G / 1.08, 0.08) == pytest.approx(40.0)


def test_the_required_force_inverts_the_acceleration() -> None:
    a = acceleration(-120e3, 194e3, 0.08, 4.2)
    assert required_force(a, 194e3, 0.08, 4.2) == pytest.approx(-120e3, rel=1e-12)
