# SPDX-License-Identifier: Apache-2.0
"""Multi-innovation least squares against its printed matrix equations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainid_lab.resistance.least_squares import unpacked
from trainid_lab.resistance.recursive import Vector, covariance, start
from trainid_lab.resistance.regressions import mils, regularised_mils, stacked, use_counts

FLAGS = st.lists(st.booleans(), max_size=60).map(tuple)


@pytest.mark.parametrize('penalty', [0.0, 50.0])
@pytest.mark.parametrize('p', [1, 2, 4, 6])
def test_a_step_is_the_printed_one(p: int, penalty: float) -> None:
    rng = np.random.default_rng(40 + p)
    N = 80
    theta, UD = start(1e3, 1e-3)
    expected, P_expected = np.full(3, 1e-3), 1e3 * np.eye(3)
    stack_phi, stack_y = tuple[Vector, ...](), tuple[float, ...]()
    for v in rng.uniform(20.0, 80.0, N):
        stack_phi, stack_y = stacked(stack_phi, stack_y, (1.0, float(v), float(v * v)), float(rng.normal(6.0)), p)
        Phi, Y = np.array(stack_phi).T, np.array(stack_y)
        Q = P_expected if penalty == 0.0 else np.linalg.inv(np.linalg.inv(P_expected) + penalty / N * np.eye(3))
        L = Q @ Phi @ np.linalg.inv(np.eye(len(Y)) + Phi.T @ Q @ Phi)
        P_expected = (np.eye(3) - L @ Phi.T) @ Q
        expected = expected + L @ (Y - Phi.T @ expected) - penalty / N * P_expected @ expected
        theta, UD = regularised_mils(theta, UD, stack_phi, stack_y, penalty / N)
        assert np.array(theta) == pytest.approx(expected, abs=1e-5)
    assert unpacked(covariance(UD)) == pytest.approx(P_expected, rel=1e-3)


def test_the_order_inside_a_step_does_not_matter() -> None:
    theta, UD = start(10.0)
    stack = ((1.0, 30.0, 900.0), (1.0, 40.0, 1600.0), (1.0, 70.0, 4900.0))
    forward, _ = mils(theta, UD, stack, (3.0, 5.0, 9.0))
    backward, _ = mils(theta, UD, stack[::-1], (9.0, 5.0, 3.0))
    assert forward == pytest.approx(backward, rel=1e-6)


@given(FLAGS, st.integers(1, 6))
def test_a_strict_step_needs_p_consecutive_good_observations(good: tuple[bool, ...], p: int) -> None:
    windows = [range(t - p + 1, t + 1) for t in range(p - 1, len(good)) if all(good[t - p + 1 : t + 1])]
    counts = use_counts(good, p, strict=True)
    assert counts == tuple(sum(t in window for window in windows) for t in range(len(good)))
    assert all(count == 0 for count, fine in zip(counts, good, strict=True) if not fine)


def test_without_bad_observations_each_is_used_p_times_except_at_the_ends() -> None:
    assert use_counts((True,) * 6, 3, strict=False) == (3, 3, 3, 3, 2, 1)
    assert use_counts((True,) * 6, 3, strict=True) == (1, 2, 3, 3, 2, 1)
    assert use_counts((True, True, False, True, True, True), 3, strict=True) == (0, 0, 0, 1, 1, 1)
