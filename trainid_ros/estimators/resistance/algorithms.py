# SPDX-License-Identifier: Apache-2.0
"""Algorithms that estimate the running resistance."""

from __future__ import annotations

from typing import Final

from trainid_ros.core.results import ResistanceEstimate
from trainid_ros.estimators.algorithms import Algorithm, Algorithms
from trainid_ros.estimators.resistance.vmils import VMils, VMilsConfig

RESISTANCE: Final = Algorithms[ResistanceEstimate](
    Algorithm(
        'V-MILS',
        'interval-varying multi-innovation least squares on speed windows; the default',
        VMilsConfig(),
        lambda train_file, config, _: VMils(train_file, config),
    ),
)
