# SPDX-License-Identifier: Apache-2.0
"""Tests of suggested brakings: what is chosen, and what it promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.interface.records import KM_H, NS_PER_S
from trainid_ros.resistance.suggested_drive import DECELERATION, SuggestedDrive, suggested_braking
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile

LINE = Line(stops=(0.0, 2000.0), gradient_std=0.05)
FILE = TrainFile(Train(200e3, max_speed=80.0 / KM_H), Davis(2.0, 0.02, 0.004), line=LINE)


def driven(file: TrainFile = FILE, seconds: float = 40.0) -> Gsma:
    """Return the estimator some seconds after the start of a run, long before its braking."""
    pipeline = brake_rate_pipeline(file, EstimatorSettings())
    scenario = Scenario(FILE, runs=1)
    for record in simulate(scenario, np.random.default_rng(5003)).records:
        if record.stamp_ns < scenario.start_ns + round(seconds * NS_PER_S):
            pipeline.push(record)
    assert isinstance(pipeline.estimator, Gsma)
    return pipeline.estimator


def suggested(estimator: Gsma, file: TrainFile = FILE) -> SuggestedDrive | None:
    return suggested_braking(estimator, file, estimator.estimate(0.0))


def test_before_the_first_braking_one_is_suggested() -> None:
    estimator = driven()
    before = estimator.save()
    drive, again = suggested(estimator), suggested(estimator)
    assert estimator.save() == before
    assert drive is not None is not again
    assert drive.numbers == again.numbers
    start, promise = drive.run.manoeuvre.start * KM_H, drive.least_known
    assert promise.now == pytest.approx(estimator.config.prior_std, rel=0.02)
    assert promise.then < promise.wanted.limit == estimator.config.valid_std
    assert drive.text.startswith(f'brake from {start:.0f} km/h with -0.6 m/s² once')
    assert f'brake rate ± {promise.then:.2g}, now ± 0.2' in drive.text
    assert (drive.numbers['brake_command'], drive.numbers['to_speed']) == (-DECELERATION, 0.0)


def test_a_valid_rate_needs_no_braking() -> None:
    estimator = driven(seconds=1000.0)
    assert estimator.converged
    assert suggested(estimator) is None


def test_a_worse_map_promises_less() -> None:
    rough = replace(FILE, line=replace(LINE, gradient_std=3.0))
    good, bad = suggested(driven()), suggested(driven(rough), rough)
    assert good is not None is not bad
    assert bad.times * bad.run.duration_s >= good.times * good.run.duration_s
    assert bad.least_known.then > 1.1 * good.least_known.then


def test_nothing_is_suggested_before_the_first_sample_or_of_other_estimators() -> None:
    fresh = brake_rate_pipeline(FILE, EstimatorSettings()).estimator
    assert suggested_braking(fresh, FILE, fresh.estimate(0.0)) is None
    assert suggested_braking(object(), FILE, fresh.estimate(0.0)) is None
