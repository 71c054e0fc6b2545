# SPDX-License-Identifier: Apache-2.0
"""Covariances of a bank of hypotheses over planned runs."""

from __future__ import annotations

import numpy as np
import pytest

from test.resistance.bank_rows import BankRows
from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.resistance.filter_bank import FilterBank, bank_plan, foreseen_mixtures, usual_deviations
from trainid_ros.resistance.hypotheses import Bank, Mixture
from trainid_ros.resistance.suggested_drive import KM_H, Manoeuvre, Run, plan_run
from trainid_ros.train.forces import specific_inertia
from trainid_ros.train.train_file import Davis, Train, TrainFile

FILE = TrainFile(Train(194e3, length=118.0, cars=6), Davis(1.0, 0.03, 0.003))
VARIANCES = 1e-4, 1e-4
FIRST = 5


def bank() -> Bank:
    return Bank(bank_plan(FILE, FilterBankConfig(), specific_inertia(1.0, FILE.train.rotary_mass)))


def run() -> Run:
    planned = plan_run(Manoeuvre(60.0 * KM_H, 40.0 * KM_H), FILE, FILE.resistance)
    assert planned is not None
    return planned


def after(deviations: np.ndarray) -> list[Mixture]:
    return list(foreseen_mixtures(bank(), run(), deviations, FIRST, 1.0, VARIANCES))


def test_each_run_makes_the_resistance_better_known() -> None:
    first, second = after(np.zeros((2, len(run().steps))))
    prior = bank().mixture().covariance
    assert prior[0] > first.covariance[0] > second.covariance[0]
    assert prior[9] > first.covariance[9] > second.covariance[9]


def test_the_bank_itself_stays_as_it_is() -> None:
    now = bank()
    before = BankRows.of(now)
    assert len(list(foreseen_mixtures(now, run(), np.zeros((2, len(run().steps))), FIRST, 1.0, VARIANCES))) == 2
    assert np.array_equal(BankRows.of(now).P, before.P)
    assert np.array_equal(BankRows.of(now).log_weight, before.log_weight)


def test_an_innovation_far_beyond_its_standard_deviation_makes_a_step_likely() -> None:
    usual, odd = np.zeros((1, len(run().steps))), np.zeros((1, len(run().steps)))
    odd[0, -40:] = 2.0
    assert after(odd)[0].covariance[0] > 1.2 * after(usual)[0].covariance[0]


def test_usual_deviations_are_two_sequences_of_opposite_sign() -> None:
    one, other = usual_deviations(run(), 3)
    assert one.shape == (3, len(run().steps))
    assert np.array_equal(one, -other)
    assert np.std(one) == pytest.approx(1.0, abs=0.1)


def test_covariances_are_averaged() -> None:
    bank, pair = FilterBank(FILE, FilterBankConfig()), usual_deviations(run(), 1)
    (both,), (first,), (second,) = (list(bank.foreseen(run(), 1, some)) for some in (pair, pair[:1], pair[1:]))
    mean = [0.5 * (x + y) for x, y in zip(first.covariance, second.covariance, strict=True)]
    assert first.covariance != second.covariance
    assert both.covariance == pytest.approx(mean, rel=1e-12)
