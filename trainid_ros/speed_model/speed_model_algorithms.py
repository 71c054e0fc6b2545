# SPDX-License-Identifier: Apache-2.0
"""Algorithms that estimate the speed model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms
from trainid_ros.estimators.settings import AmVffRlsConfig
from trainid_ros.interface.results import SpeedModelEstimate
from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel, Tuning
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator, load_std
from trainid_ros.stream.samples import SAMPLE_PERIOD

if TYPE_CHECKING:
    from trainid_ros.speed_model.am_vff_rls import Symmetric, Theta
    from trainid_ros.train.train_file import TrainFile


def am_vff_rls(train_file: TrainFile, config: AmVffRlsConfig) -> SpeedModelEstimator:
    """Return an estimator of a1, a2, b1, d0 from aligned samples by AM-VFF-RLS."""

    def method(theta0: Theta, P0: Symmetric) -> AuxiliaryModel:
        b1 = theta0[2]
        tuning = Tuning(
            noise=0.0,
            drift=(config.drift * b1) ** 2 * SAMPLE_PERIOD,
            load=(load_std(train_file, config) * b1) ** 2,
            share=1.0 / config.memory,
            threshold=config.threshold,
            scale=config.forgetting_scale,
            low=config.min_forgetting,
            gate=config.gate,
            gate_floor=config.gate_floor,
        )
        return AuxiliaryModel(theta0, P0, tuning)

    return SpeedModelEstimator(train_file, config, method)


SPEED_MODEL: Final = Algorithms[SpeedModelEstimate](
    'speed_model',
    Algorithm(
        'AM-VFF-RLS',
        'recursive least squares with auxiliary model and variable forgetting; the default',
        AmVffRlsConfig(),
        lambda train_file, config, _: am_vff_rls(train_file, config),
    ),
)
