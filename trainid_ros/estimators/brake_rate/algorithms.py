# SPDX-License-Identifier: Apache-2.0
"""Algorithms that estimate the brake rate."""

from __future__ import annotations

from typing import Final

from trainid_ros.core.results import BrakeRateEstimate
from trainid_ros.estimators.algorithms import Algorithm, Algorithms
from trainid_ros.estimators.brake_rate.gsma import Gsma, GsmaConfig

BRAKE_RATE: Final = Algorithms[BrakeRateEstimate](
    Algorithm(
        'GSMA',
        'group stochastic M-algorithm, a Rao-Blackwellised particle filter; the default',
        GsmaConfig(),
        Gsma,
    ),
)
