# SPDX-License-Identifier: Apache-2.0
"""Moments and drift of the particles compared with the plain numpy reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

from test.brake_rate.particles import INTERVAL, assert_equal, both
from trainid_ros.interface.vectors import vec


def test_total_is_the_moments_of_rate_and_errors() -> None:
    particles, reference = both([40], 31, [1.0])
    share = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.5, 2.0])
    for item in (particles, reference):
        item.predict()
        item.update(9.9, [4e-4], [0.4])
    total = reference.cloud.f + share @ reference.cloud.x[3:]
    assert particles.cloud.total(vec[float](share.tolist())) == pytest.approx((total.mean(), total.var()), rel=1e-9)
    expected = float(share @ reference.P[3:, 3:] @ share)
    assert particles.covariance.error_variance(vec[float](share.tolist())) == pytest.approx(expected, rel=1e-9)


def test_a_pause_adds_to_the_variance_of_f_and_moves_the_states_with_it() -> None:
    (particles, reference), added = both([40], 31, [1.0]), 0.01
    particles.predict()
    particles.cloud.inflate_variance(INTERVAL, added)
    reference.predict()
    cloud = reference.cloud
    off = (np.sqrt(1.0 + added / cloud.variance[0]) - 1.0) * (cloud.f - cloud.mean[0])
    assert_equal(particles.cloud.f, cloud.f + off)
    assert_equal(particles.cloud.x, cloud.x + reference.model.gamma[:, None] * off)
    assert_equal(particles.cloud.variance, cloud.variance + added)
    assert np.std(list(particles.cloud.f)) == pytest.approx(math.sqrt(np.var(cloud.f) + added), rel=1e-9)
