# SPDX-License-Identifier: Apache-2.0
"""Exact response of the brake over one sample, linear in the brake rate.

The brake follows ``tau a' = -a + f u(t - T)`` (Zheng et al. 2015, eq. (1), with T for the printed tau in
the argument) and the command u is piecewise constant, so over any interval

    a_end = decay * a_start + f * gain_a,      v gains  a_start * reach + f * gain_v.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainid_ros.records import NS_PER_S
from trainid_ros.scalars import seconds
from trainid_ros.train.brake import actuator_response, lag_integral, lag_response

if TYPE_CHECKING:
    from trainid_ros.train.brake import CommandHistory


class BrakeStep:
    """Coefficients of the exact response over an interval; see the module.

    Attributes:
        decay: Share of the initial brake acceleration left at the end [1].
        reach: Gain of speed per initial brake acceleration [s].
        gain_a: Gain of brake acceleration by the command for f = 1 [m/s^2].
        gain_v: Gain of speed by the command for f = 1 [m/s].
        start_target: Brake acceleration at the start for f = 1 [m/s^2].
        end_target: Brake acceleration at the end for f = 1 [m/s^2].

    """

    def __init__(self, decay: float, reach: float, gain_a: float, gain_v: float, start_target: float) -> None:
        self.decay, self.reach, self.gain_a, self.gain_v = decay, reach, gain_a, gain_v
        self.start_target, self.end_target = start_target, decay * start_target + gain_a


def brake_step(
    commands: CommandHistory, delay: float, tau: float, start_ns: int, end_ns: int, start_target: float
) -> BrakeStep:
    """Return the response over (start, end] [ns] to the command, eq. (1).

    Args:
        commands: History of the command.
        delay: Dead time [s].
        tau: Time constant [s].
        start_ns: Start of the interval [ns].
        end_ns: Its end [ns].
        start_target: Brake acceleration at the start for f = 1 [m/s^2].

    """
    delay_ns = round(delay * NS_PER_S)
    a, v = actuator_response(commands, start_ns, end_ns, 0.0, delay_ns=delay_ns, time_constant=tau)
    elapsed = seconds(end_ns - start_ns)
    return BrakeStep(lag_response(1.0, 0.0, tau, elapsed), lag_integral(1.0, 0.0, tau, elapsed), a, v, start_target)
