# SPDX-License-Identifier: Apache-2.0
"""Exact response of the brake over one sample, linear in the brake rate.

The brake follows ``tau a' = -a + f u(t - T)`` (Zheng et al. 2015, eq. (1), with T for the printed tau in
the argument) and the command u is piecewise constant, so over any interval

    a_end = decay * a_start + f * gain_a,      v gains  a_start * reach + f * gain_v.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from trainid_ros.records import NS_PER_S
from trainid_ros.train.brake import actuator_response, lag_integral, lag_response

if TYPE_CHECKING:
    from trainid_ros.train.brake import CommandHistory
    from trainid_ros.train.train_file import Brake


@dataclass(frozen=True, slots=True)
class BrakeStep:
    """Coefficients of the exact response over an interval; see the module.

    Attributes:
        decay: Share of the initial brake acceleration left at the end [1].
        reach: Gain of speed per initial brake acceleration [s].
        gain_a: Gain of brake acceleration by the command for f = 1 [m/s^2].
        gain_v: Gain of speed by the command for f = 1 [m/s].
        start_target: Brake acceleration at the start for f = 1 [m/s^2].

    """

    decay: float
    reach: float
    gain_a: float
    gain_v: float
    start_target: float

    @property
    def end_target(self) -> float:
        """Brake acceleration at the end of the interval for f = 1 [m/s^2]."""
        return self.decay * self.start_target + self.gain_a


def brake_step(commands: CommandHistory, brake: Brake, start_ns: int, end_ns: int, start_target: float) -> BrakeStep:
    """Return the response over (start, end] [ns] to the command delayed by the dead time, eq. (1).

    ``start_target`` is the brake acceleration at the start for f = 1 [m/s^2].
    """
    delay_ns = round(brake.delay * NS_PER_S)
    tau = brake.time_constant
    a, v = actuator_response(commands, start_ns, end_ns, 0.0, delay_ns=delay_ns, time_constant=tau)
    elapsed = (end_ns - start_ns) / NS_PER_S
    return BrakeStep(lag_response(1.0, 0.0, tau, elapsed), lag_integral(1.0, 0.0, tau, elapsed), a, v, start_target)
