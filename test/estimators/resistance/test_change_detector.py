# SPDX-License-Identifier: Apache-2.0
"""CUSUM against its definition as the largest sum of any run of innovations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainid_ros.estimators.resistance.change_detector import NO_STEP, Cusum

ALLOWANCE, CLIP, THRESHOLD = 0.4, 3.0, 7.0
INNOVATIONS = st.lists(st.floats(-50.0, 50.0), max_size=40)


def sums(innovations: list[float]) -> Cusum:
    cusum = NO_STEP
    for z in innovations:
        cusum = cusum.add(z, ALLOWANCE, CLIP)
    return cusum


@given(INNOVATIONS)
def test_it_is_the_largest_sum_of_the_latest_innovations(innovations: list[float]) -> None:
    z = np.clip(np.array([0.0, *innovations]), -CLIP, CLIP)
    up = max([0.0, *(float(np.sum(z[k:] - ALLOWANCE)) for k in range(1, len(z)))])
    down = max([0.0, *(float(np.sum(-z[k:] - ALLOWANCE)) for k in range(1, len(z)))])
    found = sums(innovations)
    assert (found.up, found.down) == pytest.approx((up, down), abs=1e-9)
    assert found.peak == max(found.up, found.down)


@given(INNOVATIONS)
def test_both_directions_are_alike(innovations: list[float]) -> None:
    found, mirrored = sums(innovations), sums([-z for z in innovations])
    assert (mirrored.up, mirrored.down) == (found.down, found.up)


def test_no_single_outlier_counts_as_a_step() -> None:
    assert sums([1e9]).peak == CLIP - ALLOWANCE < THRESHOLD


def test_a_step_of_one_deviation_is_found_soon_and_noise_is_not() -> None:
    rng = np.random.default_rng(11)
    late, false = [], 0
    for _ in range(300):
        noise = rng.standard_normal(100)
        false += any(sums(noise[:k].tolist()).peak >= THRESHOLD for k in range(20, 101, 20))
        cusum, k = NO_STEP, 0
        while cusum.peak < THRESHOLD:
            cusum, k = cusum.add(float(rng.standard_normal()) + 1.0, ALLOWANCE, CLIP), k + 1
        late.append(k)
    # Siegmund's formula with d = 1 - 0.4 and b = 7 + 1.166: (2 d b - 1) / (2 d^2) = 12.2 innovations.
    assert np.mean(late) == pytest.approx(12.2, abs=1.2)
    assert false <= 30
