# SPDX-License-Identifier: Apache-2.0
"""The bank compared with the plain numpy reference on random drives."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from test.resistance.reference_filter_bank import Hypothesis, branch, correct, mixture, predict
from trainid_ros.resistance.hypotheses import Bank, BankPlan
from trainid_ros.resistance.speed_states import GUST, MAP, Interval, ProcessNoise, V

INERTIA, R, SPEED = 110.0, 4e-4, 12.0
MEAN = np.array([0.0, 1.5, 0.03, 0.004, 0.0, 0.0, 0.0, 0.05, 0.0])
STD = np.array([0.0, 0.5, 0.02, 0.001, 0.0, 0.0, 0.03, 0.1, 0.2])
PLAN = BankPlan(
    mean=MEAN,
    variance=STD**2,
    gust_stds=(0.1,),
    map_stds=(0.05,),
    step_variances=(0.25, 1e-6),
    hazard=1.0 / 3600.0,
    branch_interval=2.0,
    hypotheses=6,
    min_age=3.0,
    young_age=120.0,
    young_weight=20.0,
    wrong_prior=0.0,
    drift=1e-6 * STD**2,
    noise=ProcessNoise(INERTIA, gust_time=6.0, map_length=250.0, force_density=0.02, skew=0.02, outliers=0.001),
)


def first() -> Hypothesis:
    """Return the prior after a restart with a measured speed."""
    x, variance = MEAN.copy(), STD**2
    x[V], variance[V], variance[GUST], variance[MAP] = SPEED, R, PLAN.gust_stds[0] ** 2, PLAN.map_stds[0] ** 2
    return Hypothesis(x, np.diag(variance), 0.0, 1e9)


@settings(max_examples=10, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.2), st.floats(-1.0, 3.0))
def test_the_bank_equals_the_reference(seed: int, dt: float, step: float) -> None:
    """Changing force, curves, noise, outliers, and a step of the resistance in the middle of the drive."""
    rng, bank, reference, v, since = np.random.default_rng(seed), Bank(PLAN), [first()], SPEED, 0.0
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
        reference = [correct(predict(h, item, PLAN), y, R, PLAN.noise.outliers, dt) for h in reference]
        since += dt
        if since >= PLAN.branch_interval:
            reference, since = branch(reference, PLAN), 0.0
        assert len(bank.hypotheses) == len(reference)
        largest = max(h.log_weight for h in reference)
        for product, h in zip(bank.hypotheses, reference, strict=True):
            std = np.sqrt(np.diag(h.P))
            assert np.max(np.abs(product.filter.mean() - h.x) / std) < 1e-6
            assert np.max(np.abs(product.filter.covariance() - h.P) / np.outer(std, std)) < 1e-6
            assert product.log_weight == pytest.approx(h.log_weight - largest, abs=1e-5)
            assert product.age == pytest.approx(h.age)
    assert bank.branchings > 2
    mean, P = mixture(reference, PLAN)
    found = bank.mixture()
    assert list(found.mean) == pytest.approx(mean, rel=1e-6, abs=1e-9)
    std, upper = np.sqrt(np.diag(P)), np.triu_indices(5)
    size = np.outer(std, std)[upper]
    assert np.max(np.abs(np.array(list(found.covariance)) - P[upper]) / size) < 1e-6
