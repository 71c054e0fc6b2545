# SPDX-License-Identifier: Apache-2.0
"""Moments and drift of the particles compared with the same in matrices."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from trainid_lab.brake_rate.particles import SPEED, Array, speed_correction
from trainid_ros.interface.vectors import vec


def test_total_is_the_moments_of_rate_and_errors(alike: Any) -> None:
    particles, matrices, P, step = alike
    share = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.5, 2.0])
    particles.predict()
    particles.update(9.9, [4e-4], [0.4])
    fix = speed_correction(step.predict_covariance(P), particles.r)
    matrices = matrices.predicted(step).learned(step, fix, SPEED, np.array([9.9]), 4e-4, 3.0, 0.4)
    total = matrices.f + share @ matrices.x[3:]
    assert particles.cloud.total(vec[float](share.tolist())) == pytest.approx((total.mean(), total.var()), rel=1e-9)
    expected = float(share @ fix.P[3:, 3:] @ share)
    assert particles.covariance.error_variance(vec[float](share.tolist())) == pytest.approx(expected, rel=1e-9)


def test_a_pause_widens_f_and_what_moves_with_it(alike: Any, matches: Callable[[Any, Array], None]) -> None:
    (particles, matrices, _, step), added = alike, 0.01
    particles.predict()
    particles.cloud.inflate_variance(particles.interval, added)
    matrices = matrices.predicted(step)
    off = (np.sqrt(1.0 + added / matrices.variance) - 1.0) * (matrices.f - matrices.mean)
    matches(particles.cloud.f, matrices.f + off)
    matches(particles.cloud.x, matrices.x + step.gamma[:, None] * off)
    matches(particles.cloud.variance, np.array([matrices.variance + added]))
    assert np.std(list(particles.cloud.f)) == pytest.approx(math.sqrt(np.var(matrices.f) + added), rel=1e-9)
