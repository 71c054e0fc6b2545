# SPDX-License-Identifier: Apache-2.0
"""Residuals of the balance: sudden ones, and those of a longer time."""

from __future__ import annotations

from trainid_ros.stream.balance_checks import BalanceCheck


def test_residuals_of_two_seconds_are_sudden_and_a_single_one_is_not() -> None:
    check = BalanceCheck()
    for residual in (0.0, 0.0, 60.0, 0.0, 0.0):
        check.add(residual, 20.0)
        assert not check.is_sudden
    for _ in range(4):
        check.add(60.0, 20.0)
    assert check.is_sudden
    check.decay(0.2)
    assert not check.is_sudden


def released(
    check: BalanceCheck,
    residual: float,
    offset: float,
    blocks: int = 200,
    resistance: float = 4.0,
    map_std: float = 0.2,
) -> None:
    """Add blocks of one residual."""
    for _ in range(blocks):
        check.add_released(residual, offset, resistance, map_std)


def test_a_mean_residual_is_named_until_it_is_gone() -> None:
    check = BalanceCheck()
    released(check, -15.0, -15.0)
    assert check.finding == 'forces do not balance by +14 N/kN: ato/force or ato/gradient is off'
    released(check, 0.0, 0.0)
    assert check.finding == ''
    assert not check.is_suspected


def test_a_mean_residual_that_a_fast_train_explains_is_not_named() -> None:
    slow, fast = BalanceCheck(), BalanceCheck()
    released(slow, -13.0, -13.0, resistance=2.0)
    released(fast, -13.0, -13.0, resistance=16.0)
    assert slow.finding
    assert not fast.finding


def test_a_mean_residual_half_as_large_is_suspected() -> None:
    check = BalanceCheck()
    released(check, 5.0, 5.0)
    assert not check.is_suspected
    released(check, 7.0, 7.0)
    assert check.is_suspected
    assert not check.finding


def test_a_force_that_drifts_is_suspected_before_it_is_far_off() -> None:
    check = BalanceCheck()
    released(check, 4.0, 4.0)
    assert not check.is_suspected
    released(check, 4.0, 0.0, blocks=1)
    assert check.is_suspected


def test_a_drift_is_judged_beside_the_resistance() -> None:
    slow, fast = BalanceCheck(), BalanceCheck()
    released(slow, 3.0, 0.0, blocks=200, resistance=2.0)
    released(fast, 3.0, 0.0, blocks=200, resistance=8.0)
    assert (slow.is_suspected, fast.is_suspected) == (True, False)


def test_a_drift_that_a_rough_map_explains_is_not_suspected() -> None:
    exact, rough = BalanceCheck(), BalanceCheck()
    released(exact, 4.0, 0.0)
    released(rough, 4.0, 0.0, map_std=1.5)
    assert (exact.is_drifting, rough.is_drifting) == (True, False)
    released(rough, 6.0, 0.0, map_std=1.5)
    assert rough.is_drifting


def test_after_a_drift_the_force_is_back_or_the_offset_has_followed() -> None:
    back, followed = BalanceCheck(), BalanceCheck()
    for check in (back, followed):
        released(check, 4.0, 0.0)
        assert check.is_drifting
    released(back, 0.0, 0.5)
    released(followed, 4.0, 3.5)
    assert not (back.is_drifting or back.has_stayed)
    assert not followed.is_drifting
    assert followed.has_stayed


def test_a_drift_is_suspected_until_a_fifth_of_it_is_gone() -> None:
    check = BalanceCheck()
    released(check, 4.0, 0.0)
    released(check, 2.3, 0.0)
    assert check.is_suspected
    released(check, 2.0, 0.0)
    assert not check.is_suspected
