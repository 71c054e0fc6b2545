# SPDX-License-Identifier: Apache-2.0
"""Tests of suggested drives: what is chosen, and what it promises."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.estimators.settings import FilterBankConfig, VMilsConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.resistance.davis_posterior import resistance_std
from trainid_ros.resistance.filter_bank import FilterBank
from trainid_ros.resistance.suggested_drive import KM_H, Manoeuvre, SuggestedDrive, plan_run, suggested_drive
from trainid_ros.resistance.vmils import VMils
from trainid_ros.setup.pipelines import EstimatorSettings, resistance_pipeline
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile

FILE = TrainFile(Train(200e3, max_speed=80.0 * KM_H), Davis(2.0, 0.02, 0.004), line=Line(gradient_std=0.05))
BANK = FilterBankConfig(hypotheses=8)
HELD = 50.0 * KM_H
DT = 0.2


def held(seconds: float) -> list[Sample]:
    """Return samples of a speed that is held."""
    rng, w = np.random.default_rng(3), 2.0 + 0.02 * HELD + 0.004 * HELD * HELD
    force = w * FILE.train.mass * G / 1000.0
    samples = []
    for k in range(round(seconds / DT)):
        speed = HELD + 0.02 * float(rng.standard_normal())
        sample = coasting_sample(round((1000.0 + DT * k) * NS_PER_S), math.nan if k == 0 else DT, speed)
        sample.force = sample.force_mean = force
        sample.position, sample.curvature_mean = HELD * DT * k, 0.0
        samples.append(sample)
    return samples


def driven(estimator: FilterBank | VMils, seconds: float = 120.0) -> FilterBank | VMils:
    for sample in held(seconds):
        estimator.step(sample)
    return estimator


def suggested(estimator: FilterBank | VMils, file: TrainFile = FILE) -> SuggestedDrive | None:
    prior = type(estimator)(file, estimator.config).estimate(0.0)  # type: ignore[arg-type]
    return suggested_drive(estimator, file, prior, estimator.estimate(0.0))


@pytest.mark.parametrize('estimator', [FilterBank(FILE, BANK), VMils(FILE, VMilsConfig())], ids=['bank', 'V-MILS'])
def test_after_one_speed_another_is_suggested(estimator: FilterBank | VMils) -> None:
    drive = suggested(driven(estimator))
    assert drive is not None
    by_name = {item.wanted.name: item for item in drive.promises}
    # At the speed held w is known already; elsewhere it is not.
    assert by_name['w at 40 km/h'].before < by_name['w at 80 km/h'].before > 1.0
    assert drive.least_known.then < 0.9 * drive.least_known.now
    assert drive.run.manoeuvre.text in drive.text
    assert f'{drive.least_known.wanted.name} ± {drive.least_known.then:.2g}' in drive.text
    assert drive.numbers['least_known'] == drive.least_known.wanted.name
    assert pickle.loads(pickle.dumps(drive)).numbers == drive.numbers  # trials run in other processes


def test_a_promise_leaves_the_estimator_as_it_is() -> None:
    bank = driven(FilterBank(FILE, BANK), 60.0)
    before = bank.save()
    first, second = suggested(bank), suggested(bank)
    assert bank.save() == before
    assert first is not None is not second
    assert first.numbers == second.numbers


@pytest.mark.parametrize('estimator', [FilterBank(FILE, BANK), VMils(FILE, VMilsConfig())], ids=['bank', 'V-MILS'])
def test_repetitions_promise_more(estimator: FilterBank | VMils) -> None:
    driven(estimator)
    drive = suggested(estimator)
    assert drive is not None
    stds = [math.sqrt(then.covariance[4]) for then in estimator.foreseen(drive.run, 3)]
    assert stds[0] > stds[1] > stds[2]
    assert stds[0] < math.sqrt(estimator.estimate(0.0).covariance[4])


def test_nothing_is_suggested_where_all_is_known() -> None:
    known = replace(BANK, prior_share=0.0, prior_std_a=0.6, valid_std=10.0)
    sure = replace(FILE, train=replace(FILE.train, mass_std=0.001, force_std=0.0))
    bank = driven(FilterBank(sure, known))
    prior = FilterBank(sure, known).estimate(0.0)
    wide = tuple(100.0 * x for x in prior.covariance)
    prior.covariance = wide
    assert suggested_drive(bank, sure, prior, bank.estimate(0.0)) is None


def test_nothing_is_suggested_before_the_first_sample_or_by_other_estimators() -> None:
    fresh = FilterBank(FILE, BANK)
    assert suggested(fresh) is None
    estimate = driven(FilterBank(FILE, BANK), 20.0).estimate(0.0)
    assert suggested_drive(object(), FILE, fresh.estimate(0.0), estimate) is None


def test_no_drive_is_suggested_after_which_something_known_would_not_be() -> None:
    line = Line(stops=(0.0, 3450.0), speed_limit=((0.0, 8.0),))
    file = TrainFile(Train(194e3, length=118.0, cars=6), Davis(1.0, 0.03, 0.003), line=line)
    pipeline = resistance_pipeline(file, EstimatorSettings())
    prior = pipeline.current().estimate
    for record in simulate(Scenario(file, runs=2), np.random.default_rng(3)).records:
        pipeline.push(record)
    now, bank = pipeline.current().estimate, pipeline.estimator
    assert isinstance(bank, FilterBank)
    run = plan_run(Manoeuvre(25.0 * KM_H, 10.0 * KM_H), file, Davis(now.a, now.b, now.c), now.force_scale)
    assert run is not None
    *_, then = bank.foreseen(run, 3)
    # This drive shows more of c, but for so long that w is no longer known.
    limit = math.hypot(bank.config.valid_std, bank.config.valid_share * 1.2)
    assert math.sqrt(then.covariance[8]) < 0.9 * math.sqrt(now.covariance[8])
    assert resistance_std(then.covariance, 12.0 * KM_H) > limit > resistance_std(now.covariance, 12.0 * KM_H)
    assert suggested_drive(bank, file, prior, now) is None
