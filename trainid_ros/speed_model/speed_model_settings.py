# SPDX-License-Identifier: Apache-2.0
"""Settings of the estimators of the speed model."""

from __future__ import annotations

from dataclasses import dataclass

from trainid_ros.estimators.prior import PriorSettings
from trainid_ros.settings import setting


@dataclass(frozen=True, slots=True)
class SpeedModelConfig(PriorSettings):
    """Settings shared by all estimators of the speed model."""

    speed_std: float = setting(0.025, 'noise of measured speed at the start (then estimated)', 'm/s', 1e-4, 2.0)
    min_speed: float = setting(0.5, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    acceleration_noise: float = setting(
        0.006, 'gusts, force noise and map errors at the start (then estimated)', 'm/s per sqrt(s)', 1e-3, 0.05
    )
    force_skew: float = setting(0.15, 'prior std of the delay of the reported force (then estimated)', 's', 0.0, 5.0)
    load_std: float = setting(
        0.03, 'relative change of the mass at a stop without weighing; at most train.mass_std', '1', 0.0, 1.0
    )
    weighing_std: float = setting(0.004, 'relative error of weighing, independent at each stop', '1', 0.0, 1.0)
    change_threshold: float = setting(
        9.0, 'chi-square of the mean window error above which the resistance has changed', '1', 1.0, 1e3
    )
    readmit_after: int = setting(5, 'rejected samples in a row after which the measurement is accepted', '', 1, 1000)
    valid_std: float = setting(
        0.25, 'valid while the rms std of w over the speeds driven is below this', 'N/kN', 1e-3, 100.0
    )


@dataclass(frozen=True, slots=True)
class AmVffRlsConfig(SpeedModelConfig):
    """Settings of AM-VFF-RLS."""

    drift: float = setting(0.004, 'drift of the Davis a in 1 s (0.1 if no gradient is known)', 'N/kN', 0.0, 10.0)
    memory: float = setting(25.0, 'memory of the running mean of the errors', 'samples', 1.0, 1e4)
    threshold: float = setting(6.0, 'chi-square of the mean error above which lambda falls below 1', '1', 0.0, 1e3)
    forgetting_scale: float = setting(
        50.0, 'sigma of (6): chi-square above the threshold for lambda = 0', '1', 1.0, 1e9
    )
    min_forgetting: float = setting(0.5, 'smallest forgetting factor', '1', 0.01, 1.0)
    gate: float = setting(4.0, 'errors beyond this many standard deviations are rejected', '1', 1.0, 100.0)
    gate_floor: float = setting(0.0, 'errors below this are never rejected', 'm/s', 0.0, 10.0)
