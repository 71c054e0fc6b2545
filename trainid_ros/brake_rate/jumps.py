# SPDX-License-Identifier: Apache-2.0
"""A brake rate that drifts quietly, and rarely moves fast for a short time: a two-state Markov chain.

Whether it jumped since the last braking shows only when the response of the brake to its command stands: until then
an error of dead time or lag looks alike. So the chain moves with the calm of the response, and what may have
happened while no brake acted waits for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from trainid_ros.brake_rate.config import BrakeRateConfig
from trainid_ros.core.settings import setting


@dataclass(frozen=True, slots=True)
class JumpConfig(BrakeRateConfig):
    """Settings of estimators that expect jumps."""

    jump_rate: float = setting(0.0001, 'jumps of the brake rate per second', '1/s', 0.0, 1.0)
    jump_std: float = setting(0.2, 'standard deviation of a jump', '1', 1e-3, 2.0)
    jump_time: float = setting(2.0, 'mean duration of a jump', 's', 0.05, 60.0)


def transition(config: JumpConfig, dt: float, pause: float = 0.0) -> tuple[float, float]:
    """Return the probabilities that a quiet brake began to jump, and that a jump ended.

    Args:
        config: Settings.
        dt: Time in which jumps show, the sample times the calm of the response [s].
        pause: Time before the sample in which no brake acted [s].

    """
    return -math.expm1(-config.jump_rate * (dt + pause)), -math.expm1(-dt / config.jump_time)


def drifts(config: JumpConfig) -> tuple[float, float]:
    """Return the variance per second of f in the quiet and in the jumping state.

    Over its mean duration a jump has the variance ``jump_std^2``.
    """
    quiet = config.drift**2
    return quiet, quiet + config.jump_std**2 / config.jump_time
