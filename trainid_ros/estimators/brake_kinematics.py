# SPDX-License-Identifier: Apache-2.0
"""Exact response of the brake over one sample, linear in the brake rate.

The brake follows ``tau a' = -a + f u(t - T)`` (Zheng et al. 2015, eq. (1), with T for the printed tau in
the argument) and the command u is piecewise constant, so over any interval

    a_end = decay * a_start + f * gain_a,      v gains  a_start * reach + f * gain_v.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from trainid_ros.core.records import NS_PER_S

if TYPE_CHECKING:
    from trainid_ros.physics.brake import CommandHistory
    from trainid_ros.physics.train_file import Brake


@dataclass(frozen=True, slots=True)
class BrakeStep:
    """Coefficients of the exact response over an interval; see the module."""

    decay: float
    reach: float
    gain_a: float
    gain_v: float


def brake_step(commands: CommandHistory, brake: Brake, start_ns: int, end_ns: int) -> BrakeStep:
    """Return the response over (start, end] to the command before the dead time."""
    delay_ns = round(brake.delay * NS_PER_S)
    tau = brake.time_constant
    a, v, decay_all = 0.0, 0.0, 1.0
    for duration, u in commands.segments(start_ns - delay_ns, end_ns - delay_ns):
        decay = math.exp(-duration / tau) if tau > 0.0 else 0.0
        v += u * duration + (a - u) * tau * (1.0 - decay)
        a = u + (a - u) * decay
        decay_all *= decay
    return BrakeStep(decay_all, tau * (1.0 - decay_all), a, v)
