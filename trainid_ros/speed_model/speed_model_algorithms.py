# SPDX-License-Identifier: Apache-2.0
"""Algorithms that estimate the speed model."""

from __future__ import annotations

from typing import Final

from trainid_ros.estimators.registry import Algorithm, Algorithms
from trainid_ros.results import SpeedModelEstimate
from trainid_ros.speed_model.am_vff_rls import AmVffRls, AmVffRlsConfig

SPEED_MODEL: Final = Algorithms[SpeedModelEstimate](
    'speed_model',
    Algorithm(
        'AM-VFF-RLS',
        'recursive least squares with auxiliary model and variable forgetting; the default',
        AmVffRlsConfig(),
        lambda train_file, config, _: AmVffRls(train_file, config),
    ),
)
