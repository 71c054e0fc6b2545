# SPDX-License-Identifier: Apache-2.0
"""Algorithms for the brake rate that are for comparison only."""

from __future__ import annotations

from typing import Final

from trainid_lab.brake_rate.kalman import ImmConfig, KalmanConfig, imm, kalman
from trainid_lab.brake_rate.theta_posterior import PrintedConfig, RbpfConfig, printed_gsma, rao_blackwellised, sma
from trainid_ros.estimators.algorithm_registry import Algorithm
from trainid_ros.interface.results import BrakeRateEstimate

# Settings not offered for the printed algorithms: they start with all values of the grid, whatever the prior.
_GRID: Final = frozenset({'prior_std'})

ALGORITHMS: Final[tuple[Algorithm[BrakeRateEstimate], ...]] = (
    Algorithm('KF', 'linear Kalman filter: exact and cheapest, but slow after a jump', KalmanConfig(), kalman),
    Algorithm(
        'IMM', 'two Kalman filters, one for drift and one for jumps; as accurate as GSMA and cheaper', ImmConfig(), imm
    ),
    Algorithm('RBPF', 'Rao-Blackwellised particle filter of a drifting rate', RbpfConfig(), rao_blackwellised),
    Algorithm('SMA', 'stochastic M-algorithm as printed; for comparison', PrintedConfig(), sma, _GRID),
    Algorithm(
        'GSMA-printed',
        'group stochastic M-algorithm as printed; for comparison',
        PrintedConfig(),
        printed_gsma,
        _GRID,
    ),
)
