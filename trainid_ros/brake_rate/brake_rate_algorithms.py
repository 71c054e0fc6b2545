# SPDX-License-Identifier: Apache-2.0
"""Algorithms that estimate the brake rate."""

from __future__ import annotations

from typing import Final

from trainid_ros.brake_rate.gsma import Gsma, GsmaConfig
from trainid_ros.brake_rate.imm import Imm, ImmConfig
from trainid_ros.brake_rate.kalman import Kalman, KalmanConfig
from trainid_ros.brake_rate.printed import PrintedConfig, PrintedGsma, Sma
from trainid_ros.brake_rate.rbpf import Rbpf, RbpfConfig
from trainid_ros.core.results import BrakeRateEstimate
from trainid_ros.estimators.registry import Algorithm, Algorithms

# Settings not offered for the printed algorithms: they start with all values of the grid, whatever the prior.
_GRID: Final = frozenset({'prior_std'})

BRAKE_RATE: Final = Algorithms[BrakeRateEstimate](
    Algorithm(
        'GSMA',
        'group stochastic M-algorithm, corrected: particles that drift or jump; the default',
        GsmaConfig(),
        Gsma,
    ),
    Algorithm('KF', 'linear Kalman filter: exact and cheapest, but slow after a jump', KalmanConfig(), Kalman),
    Algorithm(
        'IMM', 'two Kalman filters, one for drift and one for jumps; as accurate as GSMA and cheaper', ImmConfig(), Imm
    ),
    Algorithm('RBPF', 'Rao-Blackwellised particle filter of a drifting rate', RbpfConfig(), Rbpf),
    Algorithm('SMA', 'stochastic M-algorithm as printed; for comparison', PrintedConfig(), Sma, _GRID),
    Algorithm(
        'GSMA-printed',
        'group stochastic M-algorithm as printed; for comparison',
        PrintedConfig(),
        PrintedGsma,
        _GRID,
    ),
)
