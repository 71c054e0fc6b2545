# SPDX-License-Identifier: Apache-2.0
"""EKF: extended Kalman filter on [x, theta], the reference for AM-VFF-RLS.

The state is the true speed and theta; d0 is a random walk, b1 changes at stops only, a1 and a2 are constant.
It is the kernel of AM-VFF-RLS with lambda = 1: both have the same covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from trainid_ros.estimators.settings import SpeedModelConfig
from trainid_ros.interface.errors import setting
from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel, Symmetric, Theta, Tuning
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator, load_std
from trainid_ros.stream.samples import SAMPLE_PERIOD
from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class EkfConfig(SpeedModelConfig):
    """Settings of the EKF."""

    drift: float = setting(0.004, 'drift of the Davis a in 1 s (0.2 if no gradient is known)', 'N/kN', 0.0, 10.0)
    change_threshold: float = setting(
        1e3, 'chi-square of a change that triggers forgetting (1000: never)', '1', 1.0, 1e3
    )
    gate: float = setting(4.0, 'errors beyond this many standard deviations are rejected', '1', 1.0, 100.0)
    gate_floor: float = setting(0.0, 'errors below this are never rejected', 'm/s', 0.0, 10.0)


def ekf_tuning(noise: float, drift: float, load: float, gate: float, gate_floor: float = 0.0) -> Tuning:
    """Return the parameters with which the kernel of AM-VFF-RLS is the EKF.

    Args:
        noise: Variance that x gains in a sample period [(m/s)^2].
        drift: Variance that d0 gains in a sample period [(m/s)^2].
        load: Variance that b1 gains at a stop without weighing [(m/s per N/kN)^2].
        gate: Errors beyond this many standard deviations are rejected [1].
        gate_floor: Errors below this are never rejected [m/s].

    """
    return Tuning(noise, drift, load, 1.0, math.inf, 1.0, 1.0, gate, gate_floor)


def speed_ekf(train_file: TrainFile, config: EkfConfig) -> SpeedModelEstimator:
    """Return an estimator of a1, a2, b1, d0 from aligned samples by the EKF."""

    def method(theta0: Theta, P0: Symmetric) -> AuxiliaryModel:
        b1 = theta0[2]
        drift, load = (config.drift * b1) ** 2 * SAMPLE_PERIOD, (load_std(train_file, config) * b1) ** 2
        return AuxiliaryModel(theta0, P0, ekf_tuning(0.0, drift, load, config.gate, config.gate_floor))

    return SpeedModelEstimator(train_file, config, method)
