# SPDX-License-Identifier: Apache-2.0
"""The gradient against the line: offsets, other lines, sudden errors, and when they are over."""

from __future__ import annotations

import math

import pytest

from trainid_ros.stream.balance_checks import LineCheck


def follow(check: LineCheck, blocks: int, factor: float = 1.0, offset: float = 0.0, height: float = 5.0) -> LineCheck:
    """Follow a line of hills with the gradient of the topic scaled and offset."""
    for k in range(blocks):
        expected = height * math.sin(0.1 * k)
        check.add(factor * expected + offset, expected, expected, expected, 0.05)
    return check


def test_a_gradient_off_the_line_is_named_with_its_size() -> None:
    check = follow(LineCheck(), 100, offset=3.0)
    assert check.finding == 'ato/gradient is about +3.0 per mille off the line of the train file'


def test_a_gradient_that_goes_its_own_way_is_named() -> None:
    check = LineCheck()
    for k in range(300):
        expected = 5.0 * math.sin(0.1 * k)
        check.add(5.0 * math.cos(0.1 * k), expected, expected, expected, 0.2)
    assert check.finding == 'ato/gradient does not follow the line of the train file'
    assert 3.0 < check.limit < check.value < 7.0


@pytest.mark.parametrize(('share', 'named'), [(0.7, False), (0.9, True)])
def test_a_gradient_that_differs_by_less_than_the_line_rises_and_falls_is_not_named(share: float, named: bool) -> None:
    check = LineCheck()
    for k in range(300):
        expected = 20.0 * math.sin(0.1 * k)
        check.add(expected + 20.0 * share * math.cos(0.1 * k), expected, expected, expected, 0.2)
    assert bool(check.finding) is named


def test_a_sudden_error_is_suspected_within_two_seconds_and_named_within_seven() -> None:
    check = follow(LineCheck(), 100)
    assert not follow(check, 1, offset=2.0).is_suspected
    assert follow(check, 1, offset=2.0).is_suspected
    assert check.finding == ''
    assert follow(check, 12, offset=2.0).finding == 'ato/gradient is suddenly +2.0 per mille off the line'
    assert check.value == check.lately > check.limit > 0.0


def test_errors_as_large_and_long_as_those_before_are_not_sudden() -> None:
    def scattered(check: LineCheck, offset: float, blocks: int = 40) -> LineCheck:
        for k in range(blocks):
            error = offset + (0.8 if k % 20 < 10 else -0.8)
            check.add(error, 0.0, 0.0, 0.0, 0.3)
        return check

    check = scattered(LineCheck(), 0.0, 400)
    assert not scattered(check, 0.0).is_suspected
    assert 'suddenly' in scattered(check, 4.0).finding


def test_the_mean_error_that_is_named_is_that_against_the_line_nearby() -> None:
    check = LineCheck()
    for _ in range(100):
        check.add(6.0, 0.0, -2.0, 2.0, 0.2)
    assert check.finding == 'ato/gradient is about +4.0 per mille off the line of the train file'
    assert check.value == 4.0
    assert check.limit == 0.3 + 2.5 * 0.2


def test_a_single_odd_gradient_names_nothing() -> None:
    check = follow(LineCheck(), 100)
    follow(check, 1, offset=3.0)
    assert follow(check, 10).finding == ''
    assert not check.is_suspected


def test_a_finding_is_over_where_the_gradient_agrees_on_slopes_sooner_than_on_the_flat() -> None:
    hills = follow(follow(follow(LineCheck(), 100), 30, factor=-1.0), 45)
    assert hills.finding == ''
    flat = follow(follow(follow(LineCheck(), 100), 30, factor=-1.0), 45, height=0.0)
    assert flat.finding
    assert follow(flat, 60, height=0.0).finding == ''


def test_a_position_that_is_off_excuses_the_gradient_of_a_place_nearby() -> None:
    check = follow(LineCheck(), 100)
    for _ in range(20):
        check.add(5.0, 0.0, 0.0, 5.0, 0.05)
    assert check.finding == ''
    assert not check.is_suspected
