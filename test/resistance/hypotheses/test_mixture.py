# SPDX-License-Identifier: Apache-2.0
"""The mixture, its prior and load, branching and pruning."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from test.resistance.bank_rows import BankRows
from test.resistance.hypotheses.banks import ONE, PLAN, branched, held, mixed, still
from trainid_ros.resistance.hypotheses import DELTA, GUST, KAPPA, MAP, STATES, A, B, Bank, C, V

# States of a mixture.
PUBLISHED = (A, B, C, KAPPA, DELTA)
DT, SPEED_STD = 0.2, 0.02


def bank_of(weights: list[float], ages: list[float], seed: int = 0, **changes: Any) -> Bank:
    """Return a bank of random hypotheses with given weights and ages."""
    rng = np.random.default_rng(seed)
    n = len(weights)
    root = rng.standard_normal((n, STATES, STATES))
    log_weight = np.log(weights)
    bank = Bank(replace(PLAN, **changes))
    BankRows(
        x=rng.standard_normal((n, STATES)),
        P=root @ root.transpose(0, 2, 1),
        log_weight=log_weight - log_weight.max(),
        age=np.array(ages),
        size=np.zeros(n),
    ).put(bank)
    return bank


def test_a_young_hypothesis_has_more_weight_in_the_covariance_than_in_the_mean() -> None:
    bank = bank_of([0.9, 0.1], [1e9, 119.0])
    x, P = BankRows.of(bank).x[:, PUBLISHED], [p[np.ix_(PUBLISHED, PUBLISHED)] for p in BankRows.of(bank).P]
    mean = 0.9 * x[0] + 0.1 * x[1]
    # 0.9 : 20 * 0.1
    old, young = 0.9 / 2.9, 2.0 / 2.9
    spread = old * np.outer(x[0] - mean, x[0] - mean) + young * np.outer(x[1] - mean, x[1] - mean)
    found = mixed(bank)
    assert found.mean == pytest.approx(mean, rel=1e-12)
    assert found.covariance == pytest.approx(old * P[0] + young * P[1] + spread, rel=1e-12)
    plain = 0.9 * P[0] + 0.1 * P[1] + 0.09 * np.outer(x[0] - x[1], x[0] - x[1])
    assert found.posterior == pytest.approx(plain, rel=1e-12)
    with BankRows.changed(bank) as state:
        state.age[1] = 120.0
    assert mixed(bank).covariance == pytest.approx(plain, rel=1e-12)


def test_a_hypothesis_counts_from_the_minimum_age() -> None:
    bank = bank_of([0.2, 0.8], [1e9, 9.99])
    assert mixed(bank).mean == pytest.approx(BankRows.of(bank).x[0, PUBLISHED], rel=1e-12)
    with BankRows.changed(bank) as state:
        state.age[1] = 10.0
    assert mixed(bank).mean == pytest.approx(
        0.2 * BankRows.of(bank).x[0, PUBLISHED] + 0.8 * BankRows.of(bank).x[1, PUBLISHED], rel=1e-12
    )


def test_if_no_old_hypothesis_is_likely_all_count() -> None:
    bank = bank_of([1.0, 1.0], [1.0, 1.0])
    assert mixed(bank).mean == pytest.approx(BankRows.of(bank).x[:, PUBLISHED].mean(axis=0), rel=1e-12)
    with BankRows.changed(bank) as state:
        state.age[0] = 1e9
        state.log_weight[0] = -1e4
    assert mixed(bank).mean == pytest.approx(BankRows.of(bank).x[1, PUBLISHED], rel=1e-12)


def test_the_bank_starts_at_the_prior_with_each_pair_of_sizes() -> None:
    bank = held()
    assert len(BankRows.of(bank).size) == 6
    pairs = set(
        zip(BankRows.of(bank).P[:, GUST, GUST].round(9), BankRows.of(bank).P[:, MAP, MAP].round(9), strict=True)
    )
    assert pairs == {(round(g * g, 9), round(m * m, 9)) for g in PLAN.gust_stds for m in PLAN.map_stds}
    found = mixed(bank)
    assert found.mean == pytest.approx(PLAN.mean[list(PUBLISHED)])
    assert found.covariance == pytest.approx(np.diag(PLAN.variance[list(PUBLISHED)]))


def test_the_wide_prior_starts_with_a_small_weight() -> None:
    bank = held(replace(PLAN, wrong_prior=0.01))
    assert BankRows.of(bank).log_weight == pytest.approx([0.0] * 6 + [math.log(0.01)] * 6)
    assert BankRows.of(bank).size.tolist() == [*range(6), *range(6)]
    std = np.sqrt(np.diagonal(BankRows.of(bank).P, axis1=1, axis2=2))[:, PUBLISHED]
    assert std[6:] == pytest.approx(std[:6] * [5.0, 5.0, 5.0, 5.0, 1.0])
    exact = replace(PLAN, wrong_prior=0.01, variance=PLAN.variance * (np.arange(STATES) != KAPPA))
    assert BankRows.of(held(exact)).P[6:, KAPPA, KAPPA] == pytest.approx([0.06**2] * 6)


@pytest.mark.parametrize(('hours', 'steps'), [(0.5, 0.5), (1.0, 1.0), (1000.0, 1.0)])
def test_an_idle_time_adds_the_variance_of_at_most_one_step_of_a_and_c(hours: float, steps: float) -> None:
    bank = held(replace(PLAN, hazard=1.0 / 3600.0, drift=np.full(STATES, 1e-9)))
    with BankRows.changed(bank) as state:
        state.P *= 0.01
    before = BankRows.of(bank).P.copy()
    bank.idle(3600.0 * hours)
    grown = BankRows.of(bank).P - before
    expected = np.minimum(steps * np.array(PLAN.step_variances), 0.99 * PLAN.variance[[A, C]])
    assert grown[0][[A, C], [A, C]] == pytest.approx(expected)
    grown[:, [A, C], [A, C]] = 0.0
    assert not grown.any()


def test_a_stop_widens_the_force_scale_up_to_the_prior_plus_one_step() -> None:
    bank = held()
    with BankRows.changed(bank) as state:
        state.P[:, KAPPA, KAPPA] = [1e-6, 1e-4, 9e-4, 9.5e-4, 0.01, 0.0]
    others = BankRows.of(bank).P.copy()
    bank.inflate_force_scale_variance(1e-4)
    # The prior has 9e-4.
    assert BankRows.of(bank).P[:, KAPPA, KAPPA] == pytest.approx([1.01e-4, 2e-4, 1e-3, 1e-3, 0.01, 1e-4], rel=1e-12)
    others[:, KAPPA, KAPPA] = BankRows.of(bank).P[:, KAPPA, KAPPA]
    assert np.array_equal(BankRows.of(bank).P, others)


def test_the_innovation_is_that_of_the_mixture_before_the_correction() -> None:
    bank = held(replace(PLAN, gust_stds=(0.1,), map_stds=(0.05, 0.25)))
    with BankRows.changed(bank) as state:
        state.x[:, V] = [11.9, 12.2]
        state.log_weight[:] = [0.0, math.log(0.5)]
    predicted = Bank(bank.plan)
    BankRows.of(bank).put(predicted)
    unmeasured = replace(still(12.0), speed_variance=1e12)
    predicted.advance(unmeasured)
    v, S = BankRows.of(predicted).x[:, V], BankRows.of(predicted).P[:, V, V]
    found = bank.advance(still(12.0))
    mean = (2.0 * v[0] + v[1]) / 3.0
    variance = (2.0 * (S[0] + (v[0] - mean) ** 2) + S[1] + (v[1] - mean) ** 2) / 3.0
    assert found.value == pytest.approx(12.0 - mean, abs=1e-9)
    assert found.variance == pytest.approx(variance + SPEED_STD**2, rel=1e-6)


def test_a_new_size_is_adjacent_to_that_of_the_best_and_not_among_the_likely_ones() -> None:
    bank = held()
    # Sizes by gust, then map error: 0.1/0.05 0.1/0.25 0.2/0.05 0.2/0.25 0.4/0.05 0.4/0.25
    neighbours = {0: {1, 2}, 1: {0, 3}, 2: {0, 3, 4}, 3: {1, 2, 5}, 4: {2, 5}, 5: {3, 4}}
    for size, near in neighbours.items():
        bank.reset()
        bank.restart(12.0, SPEED_STD**2)
        with BankRows.changed(bank) as state:
            state.log_weight[:] = -20.0
            state.log_weight[size] = 0.0
        seen = set()
        for _ in range(2 * len(near)):
            before = len(BankRows.of(bank).size)
            with BankRows.changed(bank) as state:
                state.since_s = PLAN.branch_interval
            bank.advance(still(12.0))
            assert len(BankRows.of(bank).size) == before + 3
            new = BankRows.of(bank).size[-1]
            assert BankRows.of(bank).log_weight[-1] == pytest.approx(math.log(1e-3), abs=0.5)
            seen.add(int(new))
            # With it removed and only the best hypothesis likely, the next size is tried.
            with BankRows.changed(bank) as state:
                for name in ('x', 'P', 'log_weight', 'age', 'size'):
                    setattr(state, name, getattr(state, name)[:6])
                state.log_weight[:] = -20.0
                state.log_weight[size] = 0.0
        assert seen == near


def test_no_size_is_added_while_the_adjacent_ones_are_likely() -> None:
    bank = held()
    with BankRows.changed(bank) as state:
        state.since_s = PLAN.branch_interval
    bank.advance(still(12.0))
    assert len(BankRows.of(bank).size) == 8
    assert BankRows.of(bank).size[-2:].tolist() == [BankRows.of(bank).size[np.argmax(BankRows.of(bank).log_weight)]] * 2


@pytest.mark.parametrize('hypotheses', [4, 7])
@pytest.mark.parametrize('min_age', [0.0, 10.0, 60.0])
def test_young_ones_never_displace_the_best(hypotheses: int, min_age: float) -> None:
    """With a long minimum age, young hypotheses could otherwise fill all places."""
    bank = held(replace(PLAN, hypotheses=hypotheses, min_age=min_age, hazard=1.0 / 60.0))
    for _ in range(8):
        branched(bank)
        assert 1 <= len(BankRows.of(bank).log_weight) <= hypotheses
        assert BankRows.of(bank).log_weight.max() == 0.0


def test_the_probability_of_a_step_never_exceeds_one() -> None:
    bank = held(replace(ONE, branch_interval=100.0, hazard=1.0 / 10.0))
    now = BankRows.of(branched(bank))
    assert now.log_weight == pytest.approx([0.0, math.log(0.5), math.log(0.5)], rel=1e-12)


def test_old_unlikely_hypotheses_are_pruned_before_young_ones() -> None:
    bank = bank_of([1.0, math.exp(-4.0), math.exp(-5.0), math.exp(-7.0)], [1e9] * 4, hypotheses=4)
    with BankRows.changed(bank) as state:
        state.x[:] = PLAN.mean
        state.P[:] = np.diag(PLAN.variance + 1e-12)
        state.size[:] = [0, 0, 1, 2]
        state.since_s = PLAN.branch_interval
    bank.restart(12.0, SPEED_STD**2)
    bank.advance(still(12.0))
    now = BankRows.of(bank)
    # A step has e^-6.6: less likely than two of the old ones, but young. The best two old ones are kept.
    assert sorted(now.age.round().tolist()) == [0.0, 0.0, 1e9, 1e9]
    assert sorted(now.log_weight[now.age > 1.0]) == pytest.approx([-4.0, 0.0], abs=0.05)


def test_hypotheses_of_negligible_weight_are_pruned_even_below_the_maximum_number() -> None:
    bank = held()
    with BankRows.changed(bank) as state:
        state.log_weight[:] = [0.0, -39.0, -41.0, -300.0, -1e5, -20.0]
        state.since_s = PLAN.branch_interval
    bank.advance(still(12.0))
    old = BankRows.of(bank).log_weight[BankRows.of(bank).age > 1e8]
    assert sorted(round(float(weight)) for weight in old if weight < -10.0) == [-39, -20]


def test_after_an_outlier_of_the_speed_all_hypotheses_remain() -> None:
    bank = held()
    bank.advance(replace(still(12.0), speed=200.0))
    assert len(BankRows.of(bank).log_weight) == 6
    assert BankRows.of(bank).log_weight.max() == 0.0
    assert BankRows.of(bank).log_weight.min() > -0.01
    assert mixed(bank).mean == pytest.approx(PLAN.mean[list(PUBLISHED)], abs=1e-3)
