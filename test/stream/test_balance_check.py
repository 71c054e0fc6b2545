# SPDX-License-Identifier: Apache-2.0
"""Residuals of the balance: sudden ones, and those of a longer time."""

from __future__ import annotations

from trainid_ros.stream.balance_check import BalanceCheck


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


def test_a_mean_residual_is_named_until_it_is_gone() -> None:
    check = BalanceCheck()
    for _ in range(200):
        check.add_released(-15.0, 5.0)
    assert check.finding == 'forces do not balance by +14 N/kN: ato/force or ato/gradient is off'
    for _ in range(200):
        check.add_released(0.0, 5.0)
    assert check.finding == ''
