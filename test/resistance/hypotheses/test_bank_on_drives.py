# SPDX-License-Identifier: Apache-2.0
"""The bank on simulated drives: steps, gusts, consistency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from test.resistance.bank_rows import BankRows
from test.resistance.hypotheses.banks import ONE, PLAN, drive, errors_squared, held, mixed, still
from trainid_ros.resistance.hypotheses import Bank
from trainid_ros.resistance.speed_states import (
    KAPPA,
    A,
    B,
    C,
    Interval,
)

SPEED_STD = 0.02


def follow(bank: Bank, intervals: list[Interval]) -> None:
    bank.restart(intervals[0].speed, intervals[0].speed_variance)
    for interval in intervals[1:]:
        bank.advance(interval)


def test_a_step_of_a_is_detected() -> None:
    plan = replace(PLAN, gust_stds=(0.1, 0.2), map_stds=(0.05,), step_variances=(1.0, 1e-6))
    before, after = np.array([1.8, 0.03, 0.004, 0.0]), np.array([3.3, 0.03, 0.004, 0.0])
    bank = Bank(plan)
    intervals = drive(lambda t: after if t > 150.0 else before, 270.0, 2, plan)
    follow(bank, intervals[:751])
    phi = np.array([1.0, 12.0, 144.0, 0.0, 0.0])
    assert mixed(bank).mean @ phi == pytest.approx(before[:3] @ phi[:3], abs=0.3)
    for interval in intervals[751:]:
        bank.advance(interval)
    found = mixed(bank)
    assert found.mean @ phi == pytest.approx(after[:3] @ phi[:3], abs=0.4)
    # The best hypothesis branched off near the step.
    best = int(np.argmax(BankRows.of(bank).log_weight))
    assert BankRows.of(bank).age[best] == pytest.approx(120.0, abs=30.0)


@pytest.mark.slow
def test_without_branching_a_filter_does_not_follow_the_step() -> None:
    """The bank follows the step, not the drift of one filter."""
    before, after = np.array([1.8, 0.03, 0.004, 0.0]), np.array([3.3, 0.03, 0.004, 0.0])
    bank = Bank(ONE)
    follow(bank, drive(lambda t: after if t > 150.0 else before, 270.0, 2))
    phi = np.array([1.0, 12.0, 144.0, 0.0, 0.0])
    assert abs(mixed(bank).mean @ phi - after[:3] @ phi[:3]) > 0.4


def test_the_most_likely_hypothesis_has_the_size_of_the_gusts() -> None:
    plan = replace(PLAN, gust_stds=(0.1, 0.4), map_stds=(0.05,))
    truth = plan.mean[[A, B, C, KAPPA]]
    for gust, expected in ((0.1, 0.0), (0.4, 1.0)):
        bank = Bank(plan)
        follow(bank, drive(lambda _: truth, 120.0, 11, replace(plan, gust_stds=(gust,))))
        assert BankRows.of(bank).size[np.argmax(BankRows.of(bank).log_weight)] == expected


def test_one_filter_is_consistent() -> None:
    nees, nis = errors_squared(range(16), 40.0)
    # Means of chi-squared numbers over their 64 and 3200 degrees of freedom: 3 standard deviations.
    assert nees == pytest.approx(1.0, abs=0.53)
    assert nis == pytest.approx(1.0, abs=0.075)


@pytest.mark.slow
def test_one_filter_is_consistent_over_many_drives() -> None:
    nees, nis = errors_squared(range(100, 200), 120.0)
    assert nees == pytest.approx(1.0, abs=0.21)
    assert nis == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_in_half_a_day_of_driving_covariances_stay_symmetric_and_positive() -> None:
    plan = replace(PLAN, gust_stds=(0.1,), map_stds=(0.05,), hypotheses=4, drift=1e-3 / 3600.0 * PLAN.variance)
    bank = held(plan)
    rng = np.random.default_rng(1)
    speeds = 12.0 + np.cumsum(rng.normal(0.0, 1e-3, 200_000)) + rng.normal(0.0, SPEED_STD, 200_000)
    for i, speed in enumerate(speeds.tolist()):
        bank.advance(still(min(max(speed, 2.0), 30.0)))
        if i % 20_000 < 3:
            P = BankRows.of(bank).P
            std = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
            std = np.where(std > 0.0, std, 1.0)
            R = P / (std[:, :, None] * std[:, None, :])
            assert np.max(np.abs(R - R.transpose(0, 2, 1))) < 1e-7
            assert np.linalg.eigvalsh(R).min() > -1e-7
    assert np.isfinite(BankRows.of(bank).x).all()
