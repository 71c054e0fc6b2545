# SPDX-License-Identifier: Apache-2.0
"""An estimate becomes fit to use at its limit, with hysteresis."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.resistance.davis_posterior import (
    DrivenSpeeds,
    is_accurate,
    is_accurate_over_driven_speeds,
    representative_speeds,
)


@pytest.mark.parametrize(
    ('std', 'was_accurate', 'expected'),
    [(0.09, False, True), (0.11, False, False), (0.11, True, True), (0.149, True, True), (0.151, True, False)],
)
def test_the_limit_is_half_as_large_again_for_an_estimate_that_was_fit(
    std: float, was_accurate: bool, expected: bool
) -> None:
    assert is_accurate((std * std,) * 3, 0.1, was_accurate=was_accurate) is expected


def test_both_ends_and_the_middle_of_the_speeds_have_equal_weight() -> None:
    assert representative_speeds(2.0, 10.0) == (2.0, 6.0, 10.0)
    variances = (0.01, 0.02, 0.03)
    assert is_accurate(variances, 0.02**0.5 + 1e-9, was_accurate=False)
    assert not is_accurate(variances, 0.02**0.5 - 1e-9, was_accurate=False)


def driven(*speeds: float) -> DrivenSpeeds:
    found = DrivenSpeeds()
    for v in speeds:
        found.add(v)
    return found


def moments(found: DrivenSpeeds) -> tuple[float, float, float, float]:
    return found.m1, found.m2, found.m3, found.m4


def test_the_moments_of_driven_speeds_by_hand() -> None:
    found = driven(2.0, 4.0, 3.0)
    assert (found.count, found.slowest, found.fastest) == (3, 2.0, 4.0)
    # 9/3, 29/3, 99/3, 353/3
    assert moments(found) == pytest.approx((3.0, 29.0 / 3.0, 33.0, 353.0 / 3.0), rel=1e-12)


def test_a_mean_speed_updates_slowest_and_fastest() -> None:
    found = driven(10.0)
    found.add_mean(6.0, 4.0, 11.0)
    assert (found.slowest, found.fastest) == (4.0, 11.0)
    assert moments(found) == moments(driven(10.0, 6.0))


def test_moments_of_a_day_lose_no_digits() -> None:
    speeds = np.random.default_rng(1).uniform(0.0, 80.0, 50_000)
    found = moments(driven(*speeds.tolist()))
    assert found == pytest.approx(tuple(np.mean(speeds**k) for k in (1, 2, 3, 4)), rel=1e-11)


Array = NDArray[np.float64]
THETA = (1.0, 0.1, 0.01)


def fit_where(
    driven: DrivenSpeeds, covariance: Array, valid_std: float, share: float = 0.0, *, was_accurate: bool
) -> bool:
    """Return whether w with the parameters THETA is fit."""
    posterior = (*THETA, *covariance[np.triu_indices(3)].tolist())
    return is_accurate_over_driven_speeds(posterior, driven, valid_std, share, was_accurate=was_accurate)


def fit(std_a: float, std_b: float = 0.0, *, share: float = 0.0, was_accurate: bool = False) -> bool:
    """Return whether w is fit at 5 and 15 m/s, driven equally often, with a limit of 0.1 N/kN."""
    covariance = np.diag([std_a**2, std_b**2, 0.0])
    return fit_where(driven(5.0, 15.0), covariance, 0.1, share, was_accurate=was_accurate)


def test_before_the_first_speed_nothing_is_fit() -> None:
    nothing = DrivenSpeeds()
    assert not fit_where(nothing, np.zeros((3, 3)), 0.1, 0.05, was_accurate=False)
    assert not fit_where(nothing, np.zeros((3, 3)), 0.1, 0.05, was_accurate=True)


@pytest.mark.parametrize(
    ('std', 'was_accurate', 'expected'),
    [(0.099, False, True), (0.101, False, False), (0.101, True, True), (0.199, True, True), (0.201, True, False)],
)
def test_over_driven_speeds_the_limit_is_twice_as_large_if_it_was_fit(
    std: float, was_accurate: bool, expected: bool
) -> None:
    assert fit(std, was_accurate=was_accurate) is expected


def test_the_limit_applies_to_the_root_mean_square_over_the_driven_speeds() -> None:
    # An error of b of 0.01 N/kN per m/s: 0.05 N/kN at 5 m/s, 0.15 N/kN at 15 m/s, 0.1118 N/kN in root mean square.
    rms = math.sqrt((0.05**2 + 0.15**2) / 2.0)
    assert fit(0.0, 0.01 * 0.1 / rms * 0.999)
    assert not fit(0.0, 0.01 * 0.1 / rms * 1.001)


def test_a_speed_counts_as_often_as_it_was_driven() -> None:
    covariance = np.diag([0.0, 0.01**2, 0.0])
    for speeds, expected in (((5.0, 5.0, 5.0, 15.0), True), ((5.0, 15.0, 15.0, 15.0), False)):
        assert fit_where(driven(*speeds), covariance, 0.1, was_accurate=False) is expected


def test_a_share_of_the_resistance_adds_to_the_limit_in_squares() -> None:
    # w is 1.75 and 4.75 N/kN: 3.5795 in root mean square. A twentieth of it is 0.17897; with 0.1 the limit is 0.20502.
    limit = math.hypot(0.1, 0.05 * math.sqrt((1.75**2 + 4.75**2) / 2.0))
    assert limit == pytest.approx(0.20502, abs=1e-5)
    assert fit(0.999 * limit, share=0.05)
    assert not fit(1.001 * limit, share=0.05)
    assert fit(1.999 * limit, share=0.05, was_accurate=True)
    assert not fit(2.001 * limit, share=0.05, was_accurate=True)


def test_correlated_errors_may_cancel_where_driven() -> None:
    # Only w at 10 m/s is known: the errors of a and b cancel there.
    direction = np.array([1.0, -0.1, 0.0])
    covariance = np.outer(direction, direction)
    assert fit_where(driven(10.0, 10.0), covariance, 0.01, was_accurate=False)
    assert not fit_where(driven(5.0, 15.0), covariance, 0.4, was_accurate=False)
