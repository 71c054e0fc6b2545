# SPDX-License-Identifier: Apache-2.0
"""The EKF: accuracy, and equality with AM-VFF-RLS without forgetting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from benchmarks.stepping import step_and_estimate
from trainid_lab.speed_model.speed_model_ekf import EkfConfig, speed_ekf
from trainid_ros.estimators.settings import AmVffRlsConfig
from trainid_ros.setup.pipelines import am_vff_rls
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Journey = Callable[..., list[Sample]]


def saw_tooth(t: float) -> float:
    return 30.0 if t % 140.0 < 40.0 else 0.0


def test_resistance_and_mass_are_estimated(train_file: TrainFile, journey: Journey) -> None:
    estimator = speed_ekf(train_file, EkfConfig())
    for item in journey(400.0, traction=saw_tooth, speed=8.0):
        estimator.step(item)
    e = estimator.estimate(0.0)
    assert e.a + 12.0 * e.b + 144.0 * e.c == pytest.approx(2.76, abs=0.2)
    assert e.mass_factor == pytest.approx(1.08, rel=0.01)
    assert e.forgetting_factor == 1.0


def test_it_equals_am_vff_rls_without_forgetting(train_file: TrainFile, journey: Journey) -> None:
    ekf = speed_ekf(train_file, EkfConfig())
    config = replace(AmVffRlsConfig(), threshold=1e3, change_threshold=1e3, drift=EkfConfig().drift)
    never = am_vff_rls(train_file, config)
    for item in journey(200.0, traction=saw_tooth, speed=8.0):
        assert repr(step_and_estimate(ekf, item)) == repr(step_and_estimate(never, item))
