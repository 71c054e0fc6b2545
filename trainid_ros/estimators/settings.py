# SPDX-License-Identifier: Apache-2.0
"""Settings of the estimators: prior uncertainty of a, b, c; then resistance, speed model and brake rate."""

from __future__ import annotations

from dataclasses import dataclass

from trainid_ros.interface.errors import setting


@dataclass(frozen=True, slots=True)
class PriorSettings:
    """Settings of an estimator's prior standard deviations: a share of the train file's values, and floors."""

    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their stated values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of a (root of squares)', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of c', 'N/kN per (m/s)^2', 1e-9, 1.0)


def prior_variances(davis: tuple[float, float, float], settings: PriorSettings) -> tuple[float, float, float]:
    """Return the prior variances of (a, b, c), in the squared units of N/kN and m/s.

    Trains differ by decades in c and in a, so the standard deviation is a share of the train file's value; the floors
    keep a parameter free whose value there is zero.
    """
    a, b, c = (settings.prior_share * value for value in davis)
    return (
        a * a + settings.prior_std_a * settings.prior_std_a,
        b * b + settings.prior_std_b * settings.prior_std_b,
        c * c + settings.prior_std_c * settings.prior_std_c,
    )


@dataclass(frozen=True, slots=True)
class FilterBankConfig(PriorSettings):
    """Settings of the filter bank."""

    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    gust_std: float = setting(0.1, 'smallest std of gusts; 2, 4 and 8 times it are tried too', 'N/kN', 1e-3, 10.0)
    gust_time: float = setting(6.0, 'correlation time of gusts', 's', 0.1, 600.0)
    map_length: float = setting(250.0, 'correlation length of map errors along the line', 'm', 1.0, 1e5)
    force_noise: float = setting(0.35, 'white noise of the reported specific force', 'N/kN', 0.0, 100.0)
    force_delay_std: float = setting(0.15, 'prior std of the delay of the reported force', 's', 0.0, 1.0)
    force_skew: float = setting(0.015, 'jitter between the stamps of force and speed', 's', 0.0, 1.0)
    drift_share: float = setting(
        0.03, 'drift in one hour, except of the force scale, std as a share of the prior std', '1', 0.0, 100.0
    )
    outlier_share: float = setting(0.01, 'share of outliers among the speeds', '1', 1e-6, 0.5)
    step_interval: float = setting(1800.0, 'mean time between steps of a or c', 's', 60.0, 1e7)
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


@dataclass(frozen=True, slots=True)
class BrakeRateConfig:
    """Settings of all: prior of brake, track and sensors, and which samples are used."""

    prior_std: float = setting(0.2, 'prior standard deviation of the brake rate', '1', 1e-4, 2.0)
    drift: float = setting(0.003, 'drift of the brake rate in one second, standard deviation', '1', 0.0, 1.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then estimated)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(0.006, 'unmodelled acceleration, standard deviation', 'm/s^2', 0.0, 1.0)
    disturbance_length: float = setting(200.0, 'distance over which disturbance_std decorrelates', 'm', 1.0, 1e5)
    acceleration_noise: float = setting(0.003, 'white acceleration noise', 'm/s per sqrt(s)', 0.0, 1.0)
    resistance_std: float = setting(0.25, 'relative error of the resistance of the train file', '1', 0.0, 2.0)
    slope_std: float = setting(0.08, 'change of the brake rate from standstill to full speed', '1', 0.0, 1.0)
    # Valves act in steps, assumed as 2.5 % of 1.3 m/s^2, over sqrt(12); benchmarks have 1 to 3 %.
    level_std: float = setting(
        0.0094, 'error of the brake acceleration that depends on the brake level', 'm/s^2', 0.0, 0.2
    )
    level_length: float = setting(0.05, 'change of level over which level_std decorrelates', 'm/s^2', 1e-3, 5.0)
    blend_speed: float = setting(2.5, 'speed at which electric and friction brakes change over', 'm/s', 0.1, 30.0)
    blend_std: float = setting(0.06, 'change of the brake rate at blend_speed', '1', 0.0, 1.0)
    scale_std: float = setting(0.003, 'relative error of speed that is not observable (wheels)', '1', 0.0, 0.1)
    force_error: float = setting(0.01, 'relative error of the traction force', '1', 0.0, 0.5)
    min_speed: float = setting(0.5, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    min_braking: float = setting(0.03, 'weakest braking to learn from', 'm/s^2', 0.0, 5.0)
    gate: float = setting(5.0, 'innovations beyond this many standard deviations are rejected', '1', 1.0, 100.0)
    readmit_after: int = setting(5, 'rejected samples in a row after which the speed is accepted', 'samples', 1, 1000)
    valid_std: float = setting(0.05, 'brake rate is valid below this standard deviation', '1', 1e-3, 1.0)


@dataclass(frozen=True, slots=True)
class JumpConfig(BrakeRateConfig):
    """Settings of estimators that model jumps."""

    jump_rate: float = setting(0.0001, 'jumps of the brake rate per second', '1/s', 0.0, 1.0)
    jump_std: float = setting(0.2, 'standard deviation of a jump', '1', 1e-3, 2.0)
    jump_time: float = setting(2.0, 'mean duration of a jump', 's', 0.05, 60.0)


@dataclass(frozen=True, slots=True)
class GsmaConfig(JumpConfig):
    """Settings of GSMA."""

    particles: int = setting(100, 'particles kept after pruning, a third of them for jumps', '1', 6, 100_000)
