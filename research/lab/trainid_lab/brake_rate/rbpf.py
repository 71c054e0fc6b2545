# SPDX-License-Identifier: Apache-2.0
"""RBPF: Rao-Blackwellised particle filter of the brake rate with a shared covariance.

In Zheng et al. 2015, section 3.3, f is static: after some resampling all particles have the same value. Here f is a
random walk of variance q per second, so the values stay distinct.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from trainid_lab.brake_rate.particles import SPEED
from trainid_lab.brake_rate.theta_cloud import ThetaCloud, rbpf
from trainid_lab.brake_rate.theta_posterior import ThetaPosterior
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.errors import check_settings, setting

if TYPE_CHECKING:
    from trainid_lab.brake_rate.particles import Array, Correction, LinearStep
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class RbpfConfig(BrakeRateConfig):
    """Settings of RBPF."""

    particles: int = setting(500, 'number of particles', '1', 2, 100_000)


class RbpfPosterior(ThetaPosterior):
    """Particles that start at the quantiles of the prior and drift."""

    def __init__(self, config: RbpfConfig, rng: np.random.Generator) -> None:
        super().__init__(config.particles, rng)
        self._config = config

    def first_values(self, rate: float, std: float) -> Array:
        """Return the quantiles of the prior of f [1]."""
        prior, N = NormalDist(rate, std), self._config.particles
        return np.array([max(0.0, prior.inv_cdf((i + 0.5) / N)) for i in range(N)])

    def learned(self, step: LinearStep, fix: Correction, y: Array, dt: float, elapsed: float) -> ThetaCloud:  # noqa: ARG002
        """Return the particles after a measurement; f drifted over ``elapsed`` [s]."""
        std = self._config.drift * math.sqrt(elapsed)
        jitter = std * self.rng.standard_normal(len(self.cloud.f))
        return rbpf(self.cloud, step, fix, SPEED, y, jitter, float(self.rng.random()))


def rao_blackwellised(train_file: TrainFile, config: RbpfConfig, rng: np.random.Generator) -> BrakeRateEstimator:
    """Return the Rao-Blackwellised particle filter."""
    check_settings(config)
    return BrakeRateEstimator(train_file, config, RbpfPosterior(config, rng))
