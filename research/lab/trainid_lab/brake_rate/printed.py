# SPDX-License-Identifier: Apache-2.0
"""SMA and GSMA as printed in Zheng et al. 2015, on the dynamics of :mod:`brake_rate_estimator`, for comparison only.

f is restricted to a grid, the N particles of highest weight survive, weights are not retained between samples, and the
transition is one grid step per sample, whatever the time between samples. Sections 3.4, 3.5 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_lab.brake_rate.particles import SPEED
from trainid_lab.brake_rate.theta_cloud import MRule, ThetaCloud, all_values, m_algorithm, printed_groups
from trainid_lab.brake_rate.theta_posterior import ThetaPosterior
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.errors import check_settings, setting

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_lab.brake_rate.particles import Array, Correction, LinearStep
    from trainid_ros.train.train_file import TrainFile

# Grid of the paper: 1.0, 0.9 ... 0.
GRID: Final = np.round(np.linspace(1.0, 0.0, 11), 12)
# The group {1.0, 0.9, 0.8} is missing in the paper.
PRINTED_FIRST: Final = 2


@dataclass(frozen=True, slots=True)
class PrintedConfig(BrakeRateConfig):
    """Settings of SMA and of GSMA as printed."""

    particles: int = setting(50, 'particles kept after pruning, N', '1', 2, 10_000)
    most_particles: int = setting(500, 'number of particles above which they are pruned, Q', '1', 2, 100_000)


class PrintedPosterior(ThetaPosterior):
    """Particles on the printed grid."""

    def __init__(self, config: PrintedConfig, rng: np.random.Generator, branch: Callable[[Array], Array]) -> None:
        super().__init__(max(config.particles, len(GRID) * config.most_particles), rng)
        self._config = config
        self._rule = MRule(config.particles, config.most_particles, carries=False, stochastic=False)
        self._branch = branch

    def first_values(self, rate: float, std: float) -> Array:  # noqa: ARG002 - as printed, without a prior
        """Return the values of the grid [1], repeated in turn."""
        return np.resize(GRID, self._config.particles)

    def learned(self, step: LinearStep, fix: Correction, y: Array, dt: float, elapsed: float) -> ThetaCloud:  # noqa: ARG002
        """Return the particles after a measurement; the estimate is the mean of the survivors."""
        children = self._branch(self.cloud.f)
        return m_algorithm(self.cloud, children, step, fix, SPEED, y, self._rule, 0.0)[1]


def sma(train_file: TrainFile, config: PrintedConfig, rng: np.random.Generator) -> BrakeRateEstimator:
    """Return the stochastic M-algorithm as printed."""
    check_settings(config)
    values = PrintedPosterior(config, rng, lambda f: all_values(GRID, f))
    return BrakeRateEstimator(train_file, config, values)


def printed_gsma(train_file: TrainFile, config: PrintedConfig, rng: np.random.Generator) -> BrakeRateEstimator:
    """Return the group stochastic M-algorithm as printed."""
    check_settings(config)
    groups = PrintedPosterior(config, rng, lambda f: printed_groups(GRID, f, PRINTED_FIRST))
    return BrakeRateEstimator(train_file, config, groups)
