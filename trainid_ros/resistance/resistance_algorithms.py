# SPDX-License-Identifier: Apache-2.0
"""Registry of the algorithms that estimate the running resistance."""

from __future__ import annotations

from typing import Final

from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms
from trainid_ros.estimators.settings import FilterBankConfig, VMilsConfig
from trainid_ros.interface.results import ResistanceEstimate
from trainid_ros.resistance.filter_bank import FilterBank
from trainid_ros.resistance.vmils import VMils

RESISTANCE: Final = Algorithms[ResistanceEstimate](
    'resistance',
    Algorithm(
        'filter-bank',
        'change-point bank of Kalman filters on raw speed, with the force errors as states; default',
        FilterBankConfig(),
        lambda train_file, config, _: FilterBank(train_file, config),
    ),
    Algorithm(
        'V-MILS',
        'interval-varying multi-innovation least squares on speed windows; less computing time',
        VMilsConfig(),
        lambda train_file, config, _: VMils(train_file, config),
    ),
)
