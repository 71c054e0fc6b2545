# SPDX-License-Identifier: Apache-2.0
"""Distances by speed and by position: lasting and sudden errors, and when they are over."""

from __future__ import annotations

import math

import pytest

from trainid_ros.stream.distance_check import DistanceCheck


def drive(check: DistanceCheck, metres: float, ratio: float, noise: float = 0.0) -> DistanceCheck:
    """Drive some way by the position; the distance by the speed is ``ratio`` times as long."""
    for k in range(round(metres / 4.0)):
        check.add(4.0 * ratio, 4.0 + (noise if k % 50 < 25 else -noise))
    return check


@pytest.mark.parametrize(('ratio', 'text'), [(1.0, ''), (1.02, ''), (1.06, '+6 %'), (3.6, 'km/h')])
def test_distances_are_compared(ratio: float, text: str) -> None:
    check = drive(DistanceCheck(), 800.0, ratio)
    assert text in check.finding
    assert bool(check.finding) == bool(text)


def test_a_sudden_error_is_suspected_after_a_segment_and_named_after_two() -> None:
    check = drive(DistanceCheck(), 1500.0, 0.99)
    drive(check, 150.0, 1.04)
    assert check.is_suspected
    assert check.finding == ''
    drive(check, 100.0, 1.04)
    assert check.finding == 'ato/speed is about +4 % off what its position gives'


def test_positions_that_vary_as_much_by_themselves_are_left_alone() -> None:
    check = drive(DistanceCheck(), 3000.0, 1.0, noise=0.2)
    assert not drive(check, 400.0, 1.03, noise=0.2).finding


def test_a_finding_ends_below_a_lower_limit_only() -> None:
    check = drive(DistanceCheck(), 1000.0, 1.05)
    assert drive(check, 2000.0, 1.03).finding
    assert drive(check, 450.0, 1.01).finding == ''
    assert drive(check, 1000.0, 1.01).finding == ''


def test_an_unknown_or_corrected_position_is_left_out() -> None:
    check = DistanceCheck()
    for k in range(800):
        check.add(4.0, math.nan if k % 70 == 0 else 500.0 if k == 200 else 4.0)
    assert check.finding == ''
    assert check.count > 4


def test_positions_back_before_the_direction_is_known_are_left_out() -> None:
    check = drive(DistanceCheck(), 600.0, 1.0)
    for _ in range(3):
        drive(check, 50.0, 1.0)
        check.interrupt()
        for _ in range(4):
            check.add(2.0, -2.0)
        drive(check, 150.0, 1.0)
    assert check.finding == ''
    assert not check.is_suspected
