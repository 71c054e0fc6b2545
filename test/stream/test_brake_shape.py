# SPDX-License-Identifier: Apache-2.0
"""A brake rate that changes over speed otherwise than the train file says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from trainid_ros.stream.brake_shape import BrakeShapeCheck

MAX_SPEED = 22.0
FORCE = -100.0
"""Nominal specific force [N/kN]."""


def braking(
    rate: Callable[[float], float], seed: int, speeds: tuple[float, float] = (20.0, 1.0), factor: float = 1.0
) -> list[tuple[float, float, float]]:
    """Return the blocks of a braking with noise whose rate over that of the train file is a factor and ``rate(v)``."""
    rng, blocks = np.random.default_rng(seed), []
    for v in np.linspace(*speeds, 30):
        x = FORCE * float(rng.uniform(0.5, 1.2))
        y = (factor + rate(float(v))) * x + float(rng.normal(0.0, 2.0))
        blocks.append((y, x, float(v) / MAX_SPEED - 0.5))
    return blocks


def learn(check: BrakeShapeCheck, blocks: list[tuple[float, float, float]]) -> None:
    """Let a check learn from a whole braking."""
    for block in blocks:
        check.add(*block)
    check.end()


def checked(
    rate: Callable[[float], float], brakings: int, speeds: tuple[float, float] = (20.0, 1.0)
) -> BrakeShapeCheck:
    check = BrakeShapeCheck()
    for k in range(brakings):
        # Each braking has a factor of its own.
        learn(check, braking(rate, k, speeds, 1.0 + 0.2 * (-1) ** k))
    return check


@pytest.mark.parametrize('rise', [-0.8, -0.5, 0.5, 0.8])
def test_a_linear_change_is_named_with_its_size(rise: float) -> None:
    check = checked(lambda v: rise * v / MAX_SPEED, 3)
    size = abs(rise) * 19.0 / MAX_SPEED
    change = check.known.change(check.slowest, check.fastest)
    assert change.size == pytest.approx(size, abs=0.04)
    sense = 'rises' if rise > 0.0 else 'falls'
    assert check.warning(MAX_SPEED) == (
        f'from 1 to 20 m/s the brake rate {sense} by about {change.size:.2f} against brake.rate of the train file: '
        'it needs another table over speed, see trainid fit --brake'
    )
    assert check.is_wrong


def test_a_dip_at_medium_speed_is_named_between_the_dip_and_an_end() -> None:
    check = checked(lambda v: 0.006 * (v - 10.0) ** 2, 3)
    change = check.known.change(check.slowest, check.fastest)
    assert change.least == pytest.approx(10.0 / MAX_SPEED - 0.5, abs=0.03)
    assert change.size == pytest.approx(0.006 * 100.0, abs=0.05)
    assert check.is_wrong


@pytest.mark.parametrize('rise', [-0.15, 0.0, 0.15])
def test_a_small_change_is_not_named(rise: float) -> None:
    check = checked(lambda v: rise * v / MAX_SPEED, 6)
    assert not check.is_wrong
    assert check.warning(MAX_SPEED) == ''


def test_one_braking_in_which_the_brake_becomes_weaker_is_no_proof() -> None:
    check = checked(lambda v: 0.15 if v > 10.0 else -0.1, 1)
    assert not check.is_wrong


def test_speeds_alike_say_nothing_of_a_change_over_speed() -> None:
    assert not checked(lambda _: 0.0, 3, (10.0, 9.5)).is_wrong
    assert not checked(lambda v: v / MAX_SPEED, 3, (10.0, 9.5)).is_wrong


def test_a_braking_at_one_speed_does_not_clear_what_others_have_shown() -> None:
    check = checked(lambda v: 0.6 * v / MAX_SPEED, 3)
    learn(check, braking(lambda v: 0.6 * v / MAX_SPEED, 9, (20.0, 19.0)))
    assert check.is_wrong
    assert check.warning(MAX_SPEED).startswith('from 1 to 20 m/s the brake rate rises by about 0.5')


def test_a_braking_that_has_not_ended_is_judged_and_forgotten() -> None:
    check = BrakeShapeCheck()
    for block in braking(lambda v: v / MAX_SPEED, 1):
        check.add(*block)
    assert check.is_odd
    check.end()
    assert not check.is_odd


def test_few_blocks_say_nothing() -> None:
    check = BrakeShapeCheck()
    learn(check, [((1.0 + v / MAX_SPEED) * FORCE, FORCE, v / MAX_SPEED - 0.5) for v in (20.0, 15.0, 10.0, 5.0)])
    assert check == BrakeShapeCheck()


def test_a_contradiction_ends_after_some_brakings_as_stated() -> None:
    check, was_wrong = checked(lambda v: 0.5 * v / MAX_SPEED, 2), []
    for k in range(6):
        was_wrong.append(check.is_wrong)
        learn(check, braking(lambda _: 0.0, 100 + k))
    assert was_wrong[:2] == [True, True]
    assert not check.is_wrong
