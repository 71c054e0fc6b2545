# SPDX-License-Identifier: Apache-2.0
"""Algorithms for the speed model that are for comparison only."""

from __future__ import annotations

from typing import Final

from trainid_lab.speed_model.integral_rls import IntegralRlsConfig, speed_integral_rls
from trainid_lab.speed_model.rls import AM_RLS, AM_VFF_RLS, RLS, VFF_RLS, RlsConfig, paper_rls
from trainid_lab.speed_model.speed_model_ekf import EkfConfig, speed_ekf
from trainid_ros.estimators.algorithm_registry import Algorithm
from trainid_ros.interface.results import SpeedModelEstimate

# Settings not offered for non-adaptive methods: no rejection, no force delay, no step of load or resistance.
_NOT_ADAPTIVE: Final = frozenset({'readmit_after', 'force_skew', 'load_std', 'weighing_std', 'change_threshold'})
_PRINTED: Final = _NOT_ADAPTIVE | {'gate', 'acceleration_noise'}
_NO_FORGETTING: Final = frozenset({'forgetting_scale', 'min_forgetting'})


def _paper(
    name: str, summary: str, config: RlsConfig, fixed: frozenset[str] = frozenset()
) -> Algorithm[SpeedModelEstimate]:
    return Algorithm(
        name,
        f'{summary}; for comparison',
        config,
        lambda train_file, config, _: paper_rls(train_file, config),
        _PRINTED | fixed,
    )


ALGORITHMS: Final[tuple[Algorithm[SpeedModelEstimate], ...]] = (
    Algorithm(
        'EKF',
        'extended Kalman filter on speed and parameters; for parameters that drift slowly without jumps',
        EkfConfig(),
        lambda train_file, config, _: speed_ekf(train_file, config),
    ),
    Algorithm(
        'integral-RLS',
        'recursive least squares on the change of speed over 5 s; the simplest one not biased by noise',
        IntegralRlsConfig(),
        lambda train_file, config, _: speed_integral_rls(train_file, config),
        _NOT_ADAPTIVE,
    ),
    _paper('RLS', 'recursive least squares on measured speed, Yuan et al. (5)', RLS, _NO_FORGETTING),
    _paper('VFF-RLS', 'RLS with variable forgetting, (6)', VFF_RLS),
    _paper('AM-RLS', 'RLS with auxiliary model', AM_RLS, _NO_FORGETTING),
    _paper('AM-VFF-RLS-printed', 'RLS with auxiliary model and variable forgetting as printed, (7)', AM_VFF_RLS),
)
