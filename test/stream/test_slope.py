# SPDX-License-Identifier: Apache-2.0
"""The slope of the acceleration over traction: when it is known, and what a wrong one looks like."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.stream.slope_checks import Effort, Slope


def learned(factor: float, noise: float = 5.0, blocks: int = 20, x: float = 60.0) -> Slope:
    rng, slope = np.random.default_rng(3), Slope()
    for value in x * rng.uniform(0.5, 1.0, blocks):
        slope.add(factor * value + noise * float(rng.standard_normal()), float(value))
    return slope


def test_the_slope_is_that_of_the_regression_through_the_origin() -> None:
    assert learned(0.9).value == pytest.approx(0.9, abs=0.05)
    assert learned(0.9).is_known


@pytest.mark.parametrize('slope', [learned(0.9, blocks=4), learned(0.9, noise=40.0), Slope()])
def test_few_or_noisy_blocks_give_no_slope(slope: Slope) -> None:
    assert not slope.is_known
    slope.finding = 'as before'
    slope.judge_traction(0.0, 4.0, math.nan)
    assert slope.finding == 'as before'


@pytest.mark.parametrize(
    ('factor', 'text'),
    [(1.0, ''), (0.7, ''), (1.5, ''), (-1.0, 'wrong sign'), (3.6, 'km/h'), (0.3, '0.3 times'), (1e3, 'kN')],
)
def test_a_wrong_slope_is_named_by_its_size(factor: float, text: str) -> None:
    slope = learned(factor, noise=1.0 + abs(factor))
    slope.judge_traction(0.0, 4.0, math.nan)
    assert text in slope.finding
    assert bool(slope.finding) == bool(text)


@pytest.mark.parametrize(
    ('factor', 'by_position', 'text'),
    [
        (2.237, 2.237, 'ato/speed looks like mph'),
        (2.237, 1.0, 'the acceleration is 2.2 times what ato/force and mass give'),
        (2.237, math.nan, 'the acceleration is 2.2 times what ato/force and mass give'),
        (3.6, 3.6, 'ato/speed looks like km/h'),
        (4.448, 1.02, 'ato/force looks like lbf'),
        (4.448, math.nan, 'ato/speed looks like km/h, or ato/force like lbf'),
        (3.6, 1.0, 'ato/force looks like lbf'),
    ],
)
def test_the_position_tells_whether_speed_or_force_has_another_unit(
    factor: float, by_position: float, text: str
) -> None:
    slope = learned(factor, noise=3.0)
    slope.judge_traction(0.0, 4.0, by_position)
    assert slope.finding.startswith(text)


@pytest.mark.parametrize(
    ('by_position', 'text'), [(3.6, 'ato/speed looks like km/h'), (1.0, 'the train brakes 3.6 times')]
)
def test_the_position_tells_whether_the_speed_or_the_brake_is_off(by_position: float, text: str) -> None:
    slope = learned(3.6, noise=3.0)
    slope.judge_brake(0.0, by_position)
    assert slope.finding.startswith(text)


def test_a_slope_is_open_until_it_has_some_blocks_that_fit() -> None:
    slope = Slope()
    assert slope.is_open
    assert not learned(1.0).is_open
    assert learned(2.4).is_open
    assert not learned(2.4, x=6.0).is_open


def test_a_small_traction_says_nothing_since_map_and_resistance_are_off_by_as_much() -> None:
    slope = learned(2.5, noise=0.1, x=6.0)
    slope.judge_traction(0.0, 4.0, math.nan)
    assert slope.finding == ''


def test_a_speed_that_does_not_follow_is_unrelated_unless_it_is_only_noise() -> None:
    slope = learned(0.0, noise=60.0)
    assert slope.is_unrelated(0.0)
    assert not slope.is_unrelated(100.0)


def test_a_few_blocks_that_are_off_do_not_count_and_many_in_a_row_do() -> None:
    slope = learned(1.0)
    for _ in range(3):
        for _ in range(7):
            slope.take(300.0, 60.0, 40.0)
        slope.take(60.0, 60.0, 40.0)
    assert slope.value == pytest.approx(1.0, abs=0.1)
    for _ in range(8):
        slope.take(300.0, 60.0, 40.0)
    assert slope.value > 2.0


def test_a_wrong_slope_is_forgotten_soon_when_it_is_mended() -> None:
    slope = learned(-1.0, noise=1.0)
    slope.judge_traction(0.0, 4.0, math.nan)
    count = 0
    while slope.finding:
        slope.add(60.0, 60.0)
        slope.judge_traction(0.0, 4.0, math.nan)
        count += 1
    assert 6 < count < 60


def test_a_wrong_slope_lasts_while_there_is_too_little_traction_to_refute_it() -> None:
    slope = learned(0.5, noise=1.0, x=160.0)
    slope.judge_traction(0.0, 4.0, math.nan)
    assert '0.5 times' in slope.finding
    for x, y, lasts in ((20.0, 10.0, True), (60.0, 60.0, False)):
        for _ in range(30):
            slope.add(y, x)
            slope.judge_traction(0.0, 4.0, math.nan)
        assert bool(slope.finding) == lasts


def test_a_slope_is_plausible_where_it_is_known_and_within_its_limits() -> None:
    for factor, plausible in ((1.0, True), (3.6, False)):
        slope = learned(factor, noise=1.0)
        slope.judge_traction(0.0, 4.0, math.nan)
        assert slope.is_plausible == plausible
    assert not learned(1.0, blocks=4).is_plausible


def test_a_slope_is_suspected_where_errors_of_map_and_resistance_hardly_explain_it() -> None:
    near, far = Slope(offset=8.0, excess=3.9), Slope(offset=8.0, excess=4.1)
    assert (near.is_suspected, far.is_suspected) == (False, True)


def braked(by_force: float, by_speed: float, effort: Effort | None = None, blocks: int = 20) -> Effort:
    """Return the effort after brakings whose force and deceleration are these multiples of the command."""
    effort, brake = effort or Effort(), learned(by_speed, noise=1.0)
    for _ in range(blocks):
        effort.take(60.0 * by_force, 60.0)
        effort.judge(brake)
    return effort


@pytest.mark.parametrize(
    ('by_force', 'by_speed', 'text'),
    [
        (2.0, 2.1, 'ato/brake_command is off: speed and ato/force brake 2 times as much'),
        (0.5, 0.45, 'ato/brake_command is off: speed and ato/force brake 0.5 times as much'),
        (9.8, 9.0, 'ato/brake_command looks like g: speed and ato/force brake 9.8 times as much'),
        (-1.0, 1.0, 'ato/force drives while ato/brake_command brakes: its sign is missing or wrong'),
        (-0.3, 1.0, ''),
        (1.3, 1.4, ''),
        (1.4, 1.3, ''),
        (2.0, 1.4, ''),
        (1.4, 2.0, ''),
    ],
)
def test_a_command_is_off_where_force_and_speed_agree_that_it_is(by_force: float, by_speed: float, text: str) -> None:
    assert braked(by_force, by_speed).finding == text


@pytest.mark.parametrize(('by_force', 'by_speed'), [(1.1, 1.1), (2.0, 1.2)])
def test_a_command_is_right_again_where_force_and_speed_fit_it_or_do_not_agree(
    by_force: float, by_speed: float
) -> None:
    effort = braked(2.0, 2.0)
    assert effort.finding
    assert braked(by_force, by_speed, effort, blocks=60).finding == ''


def test_a_command_is_right_again_although_its_deceleration_is_still_a_little_off() -> None:
    assert braked(1.15, 1.4, braked(1.6, 1.4), blocks=60).finding == ''


def test_a_command_between_right_and_wrong_keeps_its_finding() -> None:
    assert braked(1.3, 1.6, braked(1.9, 1.6), blocks=60).finding


@pytest.mark.parametrize('factor', [0.5, 2.0])
def test_another_force_for_the_same_command_is_suspected_after_two_blocks_until_it_has_become_usual(
    factor: float,
) -> None:
    effort = Effort()
    for _ in range(40):
        effort.take(60.0, 60.0)
    effort.take(60.0 * factor, 60.0)
    assert not effort.is_suspected
    suspected = 0
    for _ in range(100):
        effort.take(60.0 * factor, 60.0)
        suspected += effort.is_suspected
    assert 8 <= suspected < 60
    assert not effort.is_suspected
    assert effort.has_stayed


def test_a_suspicion_ends_when_the_force_fits_the_command_as_before() -> None:
    effort = Effort()
    for factor in (1.0, 1.0, 2.0, 2.0, 2.0, 1.0):
        effort.take(60.0 * factor, 60.0)
    assert not effort.is_suspected
    assert not effort.has_stayed


def test_a_force_beyond_that_of_the_strongest_command_is_suspected_until_a_block_fits() -> None:
    effort = Effort()
    for _ in range(3):
        effort.compare(-70.0, -60.0)
        assert effort.off == 0
    for _ in range(3):
        effort.compare(-90.0, -60.0)
    assert effort.is_suspected
    effort.compare(-60.0, -60.0)
    assert effort.is_suspected
    effort.take(-60.0, -60.0)
    assert not effort.is_suspected


@pytest.mark.parametrize(('low', 'high', 'x'), [(48.0, 72.0, 60.0), (4.0, 10.0, 6.0)])
def test_a_force_a_fifth_off_or_small_forces_that_differ_are_not_suspected(low: float, high: float, x: float) -> None:
    effort = Effort()
    for k in range(200):
        effort.take(low if k % 4 < 2 else high, x)
        assert not effort.is_suspected


def test_a_force_that_often_leaves_part_of_the_brake_to_others_is_soon_no_reason_for_suspicion() -> None:
    effort, suspected = Effort(), []
    for k in range(400):
        effort.take(60.0 if k % 20 < 12 else 20.0, 60.0)
        suspected.append(effort.is_suspected)
    assert any(suspected[:100])
    assert not any(suspected[200:])


@pytest.mark.parametrize(('by_force', 'by_speed', 'suspected'), [
    (0.5, 0.45, True),  # the command is double
    (2.0, 2.2, True),  # or half
    (0.9, 0.5, False),  # the brake is weak
    (0.0, 1.0, False),  # other brakes do the work, of which the force does not tell
])  # fmt: skip
def test_one_braking_shows_a_command_that_force_and_speed_contradict(
    by_force: float, by_speed: float, suspected: bool
) -> None:
    effort = Effort()
    effort.take_impulses(by_force, by_speed)
    assert effort.is_suspected == suspected


def test_a_braking_that_fits_ends_the_suspicion() -> None:
    effort = Effort()
    effort.take_impulses(0.5, 0.5)
    effort.take_impulses(0.98, 0.9)
    assert not effort.is_suspected
    assert not effort.has_stayed
