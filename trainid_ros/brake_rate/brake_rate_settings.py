# SPDX-License-Identifier: Apache-2.0
"""Settings of brake rate estimators."""

from __future__ import annotations

from dataclasses import dataclass

from trainid_ros.settings import setting


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
    level_std: float = setting(
        0.005, 'error of the brake acceleration that depends on the brake level', 'm/s^2', 0.0, 0.2
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
