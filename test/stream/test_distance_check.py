# SPDX-License-Identifier: Apache-2.0
"""Distances by speed and by position: lasting and sudden errors, and when they are over."""

from __future__ import annotations

import math

import pytest

from trainid_ros.stream.slope_checks import DistanceCheck


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


@pytest.mark.parametrize('resolution', [0.0, 90.0])
def test_a_position_that_stands_still_is_named_and_one_that_is_seldom_updated_is_not(resolution: float) -> None:
    check = DistanceCheck()
    shown = 0.0
    for k in range(300):
        before, shown = shown, 4.0 * k if resolution == 0.0 else resolution * (4.0 * k // resolution)
        check.add(4.0, shown - before)
    assert check.finding == ''
    assert check.has_position == (check.still <= 20.0)
    for _ in range(75):
        check.add(4.0, 0.0)
    assert 'position in ato/speed stands still' in check.finding
    assert drive(check, 1500.0, 1.0).finding == ''


def test_a_position_that_was_never_another_one_is_given_a_kilometre() -> None:
    check = DistanceCheck()
    for k in range(300):
        check.add(4.0, 0.0)
        assert bool(check.finding) == (4.0 * (k + 1) > 1000.0)


def test_one_leap_of_the_position_is_none_too_many_and_two_within_a_kilometre_are() -> None:
    check = drive(DistanceCheck(), 600.0, 1.0)
    check.add(4.0, 304.0)
    assert drive(check, 1500.0, 1.0).finding == ''
    check.add(4.0, -296.0)
    assert drive(check, 300.0, 1.0).finding == ''
    check.add(4.0, 304.0)
    assert check.finding == 'the position in ato/speed jumps, by +304 m the last time'


@pytest.mark.parametrize(
    ('ratio', 'by_force', 'text'),
    [
        (0.5, 1.0, 'the position in ato/speed changes by 2 times'),
        (1e3, 0.9, 'the position in ato/speed changes by 0.001 times'),
        (0.5, 0.55, 'ato/speed is about -50 % off'),
        (0.5, math.nan, 'ato/speed is about -50 % off'),
        (2.237, 2.3, 'ato/speed looks like mph'),
        (3.6, 3.9, 'ato/speed looks like km/h'),
        (1.06, 1.0, 'ato/speed is about +6 % off'),
    ],
)
def test_the_forces_tell_whether_speed_or_position_is_off(ratio: float, by_force: float, text: str) -> None:
    check = DistanceCheck()
    for _ in range(round(900.0 / ratio) if ratio < 1.0 else 300):
        check.add(4.0, 4.0 / ratio, by_force)
    assert text in check.finding
    # What the forces have shown holds where they are too small to tell.
    for _ in range(60):
        check.add(4.0, 4.0 / ratio)
    assert text in check.finding


def test_a_position_that_hardly_changes_has_no_direction() -> None:
    check = DistanceCheck()
    for _ in range(300):
        check.add(4.0, -0.004, 1.0)
    assert 'the position in ato/speed changes by 0.001 times' in check.finding


def test_the_ratio_of_the_distances_follows_within_a_short_way_and_can_be_forgotten() -> None:
    check = drive(DistanceCheck(), 500.0, 1.0)
    assert check.ratio == pytest.approx(1.0)
    drive(check, 40.0, 3.6)
    assert 2.0 < check.ratio < 3.6
    check.forget_ratio()
    assert math.isnan(check.ratio)
    assert drive(check, 40.0, 3.6).ratio == pytest.approx(3.6)
