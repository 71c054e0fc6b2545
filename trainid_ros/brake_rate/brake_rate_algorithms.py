# SPDX-License-Identifier: Apache-2.0
"""Algorithms that estimate the brake rate."""

from __future__ import annotations

from typing import Final

from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.results import BrakeRateEstimate

BRAKE_RATE: Final = Algorithms[BrakeRateEstimate](
    'brake_rate',
    Algorithm(
        'GSMA',
        'group stochastic M-algorithm, corrected: particles that drift or jump; the default',
        GsmaConfig(),
        Gsma,
    ),
)
