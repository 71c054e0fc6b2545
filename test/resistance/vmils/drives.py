# SPDX-License-Identifier: Apache-2.0
"""V-MILS on journeys."""

from __future__ import annotations

from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.resistance.vmils import VMils
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

CONFIG = VMilsConfig()


def saw_tooth(t: float) -> float:
    """Power for 40 s, coast for 100 s [N/kN]: uphill the speed stays between 7 and 18 m/s."""
    return 30.0 if t % 140.0 < 40.0 else 0.0


def after(train_file: TrainFile, samples: list[Sample], config: VMilsConfig = CONFIG) -> VMils:
    estimator = VMils(train_file, config)
    for item in samples:
        estimator.step(item)
    return estimator


def w(davis: Davis, v: float) -> float:
    return davis.a + davis.b * v + davis.c * v * v
