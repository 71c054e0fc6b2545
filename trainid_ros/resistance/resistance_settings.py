# SPDX-License-Identifier: Apache-2.0
"""Settings of the resistance estimators."""

from __future__ import annotations

from dataclasses import dataclass

from trainid_ros.estimators.prior import PriorSettings
from trainid_ros.settings import setting


@dataclass(frozen=True, slots=True)
class FilterBankConfig(PriorSettings):
    """Settings of the filter bank."""

    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    gust_std: float = setting(0.1, 'smallest std of gusts; 2, 4 and 8 times it are tried too', 'N/kN', 1e-3, 10.0)
    gust_time: float = setting(6.0, 'correlation time of gusts', 's', 0.1, 600.0)
    map_length: float = setting(250.0, 'correlation length of map errors', 'm', 1.0, 1e5)
    force_noise: float = setting(0.35, 'white noise of the reported specific force', 'N/kN', 0.0, 100.0)
    force_delay_std: float = setting(0.15, 'prior std of the delay of the reported force', 's', 0.0, 1.0)
    force_skew: float = setting(0.015, 'jitter between the stamps of force and speed', 's', 0.0, 1.0)
    drift_share: float = setting(
        0.03, 'drift in one hour, except of the force scale, std as a share of the prior std', '1', 0.0, 100.0
    )
    outlier_share: float = setting(0.01, 'share of outliers among the speeds', '1', 1e-6, 0.5)
    step_interval: float = setting(3600.0, 'mean time between steps of a or c', 's', 60.0, 1e7)
    step_a: float = setting(0.3, 'std of a step of a, to which 15 % of a are added', 'N/kN', 1e-3, 10.0)
    step_share_c: float = setting(0.2, 'std of a step of c as a share of c', '1', 1e-3, 10.0)
    hypotheses: int = setting(28, 'maximum number of hypotheses', '', 4, 1000)
    branch_interval: float = setting(10.0, 'driving time between branchings', 's', 1.0, 1000.0)
    min_age: float = setting(10.0, 'minimum age of a hypothesis in the estimate', 's', 0.0, 1000.0)
    young_weight: float = setting(500.0, 'weight of young hypotheses in the stated covariance', '1', 1.0, 1000.0)
    wrong_prior: float = setting(0.01, 'prior odds that the train file is overconfident', '1', 0.0, 1.0)
    valid_std: float = setting(
        0.15, 'fit to use below this standard deviation, without suspected steps', 'N/kN', 1e-3, 10.0
    )
    valid_share: float = setting(0.05, 'or below this share of the resistance (root of squares)', '1', 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class VMilsConfig(PriorSettings):
    """Settings of V-MILS."""

    innovation_length: int = setting(4, 'innovation length p', 'observations', 1, 50)
    window: float = setting(4.8, 'duration of a speed window, of 8 samples or more', 's', 0.5, 60.0)
    hop: float = setting(1.2, 'time between windows', 's', 0.02, 60.0)
    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(
        0.11, 'unmodelled resistance without map errors at the start (then learned)', 'N/kN', 0.0, 10.0
    )
    disturbance_time: float = setting(12.0, 'its correlation time at the start (then learned)', 's', 0.0, 600.0)
    force_error: float = setting(0.003, 'relative error of the traction force besides its scale', '1', 0.0, 0.5)
    force_skew: float = setting(0.03, 'timing error of the force besides its delay', 's', 0.0, 5.0)
    force_delay_std: float = setting(0.15, 'prior std of the delay of the reported force', 's', 0.0, 5.0)
    model_error: float = setting(0.006, 'unmodelled error of w, as a share of w', '1', 0.0, 0.5)
    drift_share: float = setting(0.08, 'drift in one hour, std as a share of the prior std', '1', 0.0, 100.0)
    outlier_share: float = setting(0.05, 'share of outliers among the observations', '1', 0.0, 0.5)
    step_interval: float = setting(3600.0, 'mean time between steps of the parameters', 's', 60.0, 1e7)
    step_share: float = setting(0.5, 'std of a step as a share of the prior std', '1', 0.01, 10.0)
    step_min_age: int = setting(12, 'observations after which a step hypothesis counts', 'observations', 1, 1000)
    valid_std: float = setting(0.15, 'fit to use below this standard deviation', 'N/kN', 1e-3, 10.0)
    valid_share: float = setting(0.05, 'or below this share of the resistance (root of squares)', '1', 0.0, 1.0)
