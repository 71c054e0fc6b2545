# SPDX-License-Identifier: Apache-2.0
"""Outliers, dropouts, slip and any other input: the estimate stays finite and recovers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from test.estimators.makers import stepped
from test.estimators.test_any_input import wild
from test.resistance.bank_rows import BankRows
from test.resistance.filter_bank.drives import (
    FILE,
    SMALL,
    TRUTH,
    G,
    after,
    check_finite,
    check_recovers,
    drive,
    fields_except_speed,
    restored,
    shifted,
    w,
)
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.resistance.filter_bank import FilterBank
from trainid_ros.resistance.hypotheses import B
from trainid_ros.stream.samples import Sample

Make = Callable[..., Sample]


def test_single_outliers_are_rejected_and_hardly_affect_the_estimate(learned: str) -> None:
    good = shifted(drive(60.0, seed=13), 1000.0)
    odd = [replace(s, speed=s.speed + 2.0) if i % 20 == 10 else s for i, s in enumerate(good)]
    plain, hit = restored(learned), restored(learned)
    stepped(plain, good)
    reasons = [r.reason for r in map(hit.step, odd) if isinstance(r, Rejection)]
    assert reasons.count(Reason.OUTLIER) == 15
    expected = plain.estimate(12.0)
    assert hit.estimate(12.0).resistance == pytest.approx(expected.resistance, abs=0.5 * expected.resistance_std)


def test_a_lasting_speed_error_is_rejected_25_times_and_then_restarts_the_filters(learned: str) -> None:
    bank = restored(learned)
    before = bank.estimate(12.0)
    good = shifted(drive(8.0, seed=18), 1000.0)
    stepped(bank, good[:5])
    answers = [step_and_estimate(bank, replace(item, speed=item.speed + 3.0)) for item in good[5:]]
    reasons = [answer.reason for answer in answers if isinstance(answer, Rejection)]
    assert reasons == [Reason.OUTLIER] * 25
    assert bank.estimate(12.0).resistance == pytest.approx(before.resistance, abs=before.resistance_std)


def test_dropouts_do_not_affect_the_accuracy(learned: str) -> None:
    good = shifted(drive(90.0, seed=14), 1000.0)
    bank = restored(learned)
    for i, item in enumerate(good):
        if i % 40 < 3:
            continue
        step_and_estimate(bank, replace(item, dt=math.nan) if i % 40 == 3 else item)
        check_finite(bank.estimate(item.speed))
    found = bank.estimate(12.0)
    assert found.resistance == pytest.approx(w(TRUTH, 12.0), abs=3.0 * found.resistance_std)


def test_bursts_of_wheel_slip_do_not_bias_the_resistance(learned: str) -> None:
    """Wheels spin up by 2 m/s within a second and regain adhesion, every half minute."""
    slip = [0.3, 0.8, 1.3, 1.8, 2.0, 2.0, 1.5, 1.0, 0.5, 0.2]
    samples = shifted(drive(120.0, seed=15), 1000.0)
    bank = restored(learned)
    for i, item in enumerate(samples):
        k = i % 150 - 50
        bank.step(replace(item, speed=item.speed + slip[k]) if 0 <= k < len(slip) else item)
    found = bank.estimate(12.0)
    assert found.resistance == pytest.approx(w(TRUTH, 12.0), abs=max(0.4, 3.0 * found.resistance_std))


@pytest.mark.parametrize('force', [1e6, -1e6, 1e8])
def test_after_impossible_forces_the_estimate_is_finite_and_recovers(learned: str, force: float) -> None:
    samples = shifted(drive(12.0, seed=16), 1000.0)
    bank = restored(learned)
    for i, item in enumerate(samples):
        step_and_estimate(bank, replace(item, force=force, force_mean=force) if i % 15 == 9 else item)
        check_finite(bank.estimate(item.speed))
    check_recovers(bank)


def test_states_saved_during_a_lasting_impossible_force_can_be_restored(learned: str, minutes: list[Sample]) -> None:
    bank = restored(learned)
    item, force = minutes[-1], 0.99 * G * FILE.train.mass
    fastest = 0.0
    for _ in range(40):
        item = after([item], dt=1.0, force=force, force_mean=force)
        bank.step(item)
        check_finite(bank.estimate(12.0))
        text = bank.save()
        assert restored(text).save() == text
        fastest = max(fastest, float(BankRows.of(bank.bank).x[:, 0].max()))
    assert fastest > 40.0


def test_a_bank_with_a_non_finite_number_reports_it_and_restarts_from_the_prior(
    learned: str, minutes: list[Sample]
) -> None:
    bank = restored(learned)
    assert bank.converged
    bank.bank.hypotheses[0].filter.x[B] = math.nan
    rejection = bank.step(after(minutes))
    assert isinstance(rejection, Rejection)
    assert rejection.reason is Reason.NUMERICAL
    assert not bank.converged
    found, prior = bank.estimate(12.0), FilterBank(FILE, SMALL).estimate(12.0)
    assert fields_except_speed(found) == fields_except_speed(prior)
    assert (found.speed_min, found.speed_max) == (0.0, 0.0)
    check_recovers(bank)


def test_after_speed_jumps_up_to_two_hundred_the_estimate_is_finite_and_recovers(learned: str) -> None:
    rng = np.random.default_rng(17)
    samples = shifted(drive(12.0, seed=17), 1000.0)
    bank = restored(learned)
    for item in samples:
        bank.step(replace(item, speed=float(rng.choice([item.speed, 1.0, 200.0]))))
        check_finite(bank.estimate(item.speed))
    # Long enough that the filters restart after consecutive rejections.
    for item in samples:
        bank.step(replace(item, stamp_ns=item.stamp_ns + 100 * NS_PER_S, speed=200.0))
        check_finite(bank.estimate(item.speed))
    check_recovers(bank)


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(100, 140))
def test_after_many_random_inputs_it_recovers(sample: Make, seed: int) -> None:
    bank = FilterBank(FILE, SMALL)
    for i, fields in enumerate(wild(np.random.default_rng(seed))):
        bank.step(sample(i, **fields))
    # Plausible ones among the random values have changed the estimate.
    check_recovers(bank, sigmas=5.0)
