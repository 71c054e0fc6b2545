# SPDX-License-Identifier: Apache-2.0
"""Markov chain of a brake rate with two states: slow drift (quiet) and a rare, short, fast change (jumping).

A jump since the last braking can be detected only when the response of the brake to its command is steady: before
that, an error of dead time or lag has the same effect. So time in the chain is scaled by the steadiness of the
response, and the probability of a jump while no brake acted is kept until then.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trainid_ros.brake_rate.brake_rate_settings import JumpConfig


def transition(config: JumpConfig, dt: float, pause: float = 0.0) -> tuple[float, float]:
    """Return the probabilities [1] that a quiet brake started to jump, and that a jump ended.

    Args:
        config: Settings.
        dt: Time in which jumps are observable, the sample period times ``steadiness`` [s].
        pause: Time before the sample in which no brake acted [s].

    """
    return -math.expm1(-config.jump_rate * (dt + pause)), -math.expm1(-dt / config.jump_time)


def drifts(config: JumpConfig) -> tuple[float, float]:
    """Return the variance of f per second in the quiet and in the jumping state [1/s].

    Over its mean duration a jump has the variance ``jump_std^2``.
    """
    quiet = config.drift**2
    return quiet, quiet + config.jump_std**2 / config.jump_time
