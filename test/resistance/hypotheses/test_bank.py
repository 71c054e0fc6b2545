# SPDX-License-Identifier: Apache-2.0
"""The bank on simulated drives: steps, gusts, consistency; compared with the plain numpy reference."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from test.resistance.bank_rows import BankRows, covariance
from test.resistance.hypotheses.banks import INERTIA, NOISE, ONE, PLAN, drive, errors_squared, held, mixed, still
from test.resistance.reference_filter_bank import Hypothesis, branch, correct, mixture, predict
from trainid_ros.resistance.hypotheses import GUST, KAPPA, MAP, A, B, Bank, C, Interval, V

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


def test_the_most_likely_hypothesis_has_the_size_of_the_gusts() -> None:
    plan = replace(PLAN, gust_stds=(0.1, 0.4), map_stds=(0.05,))
    truth = plan.mean[[A, B, C, KAPPA]]
    for gust, expected in ((0.1, 0.0), (0.4, 1.0)):
        bank = Bank(plan)
        follow(bank, drive(lambda _: truth, 120.0, 11, replace(plan, gust_stds=(gust,))))
        assert BankRows.of(bank).size[np.argmax(BankRows.of(bank).log_weight)] == expected


@pytest.mark.parametrize(
    ('seeds', 'seconds', 'of_nees', 'of_nis'),
    # Means of chi-squared numbers over their 64 and 3200 degrees of freedom: 3 standard deviations.
    [(range(16), 40.0, 0.53, 0.075), pytest.param(range(100, 200), 120.0, 0.21, 0.02, marks=pytest.mark.slow)],
)
def test_one_filter_is_consistent(seeds: range, seconds: float, of_nees: float, of_nis: float) -> None:
    nees, nis = errors_squared(seeds, seconds)
    assert nees == pytest.approx(1.0, abs=of_nees)
    assert nis == pytest.approx(1.0, abs=of_nis)


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


R, SPEED = 4e-4, 12.0
MEAN = np.array([0.0, 1.5, 0.03, 0.004, 0.0, 0.0, 0.0, 0.05, 0.0])
STD = np.array([0.0, 0.5, 0.02, 0.001, 0.0, 0.0, 0.03, 0.1, 0.2])
SMALL = replace(
    ONE,
    mean=MEAN,
    variance=STD**2,
    branch_interval=2.0,
    hypotheses=6,
    min_age=3.0,
    drift=1e-6 * STD**2,
    noise=replace(NOISE, skew=0.02),
)


def first() -> Hypothesis:
    """Return the prior after a restart with a measured speed."""
    x, variance = MEAN.copy(), STD**2
    x[V], variance[V], variance[GUST], variance[MAP] = SPEED, R, SMALL.gust_stds[0] ** 2, SMALL.map_stds[0] ** 2
    return Hypothesis(x, np.diag(variance), 0.0, 1e9)


@settings(max_examples=10, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.2), st.floats(-1.0, 3.0))
def test_the_bank_equals_the_reference(seed: int, dt: float, step: float) -> None:
    """Changing force, curves, noise, outliers, and a step of the resistance in the middle of the drive."""
    rng, bank, reference, v, since = np.random.default_rng(seed), Bank(SMALL), [first()], SPEED, 0.0
    bank.restart(SPEED, R)
    T = np.cumsum(rng.normal(0.0, 5.0, 124)).tolist()
    for k in range(120):
        before, now, next_, last = T[k : k + 4]
        curve = float(rng.random() < 0.3)
        w = 1.5 + (step if k > 60 else 0.0) + 0.03 * v + 0.004 * v * v
        v += dt / INERTIA * (now - w - 0.3 * curve)
        y = v + math.sqrt(R) * float(rng.standard_normal()) + (1.0 if rng.random() < 0.01 else 0.0)
        item = Interval(dt, (before, now, next_, last), 0.5, curve, y, R, dt, dt)
        bank.advance(item)
        reference = [correct(predict(h, item, SMALL), y, R, SMALL.noise.outliers, dt) for h in reference]
        since += dt
        if since >= SMALL.branch_interval:
            reference, since = branch(reference, SMALL), 0.0
        assert len(bank.hypotheses) == len(reference)
        largest = max(h.log_weight for h in reference)
        for product, h in zip(bank.hypotheses, reference, strict=True):
            std = np.sqrt(np.diag(h.P))
            assert np.max(np.abs(np.array(list(product.filter.x)) - h.x) / std) < 1e-6
            assert np.max(np.abs(covariance(product.filter) - h.P) / np.outer(std, std)) < 1e-6
            assert product.log_weight == pytest.approx(h.log_weight - largest, abs=1e-5)
            assert product.age == pytest.approx(h.age)
    assert bank.branchings > 2
    mean, P = mixture(reference, SMALL)
    found = bank.mixture()
    assert list(found.mean) == pytest.approx(mean, rel=1e-6, abs=1e-9)
    std, upper = np.sqrt(np.diag(P)), np.triu_indices(5)
    size = np.outer(std, std)[upper]
    assert np.max(np.abs(np.array(list(found.covariance)) - P[upper]) / size) < 1e-6
