# SPDX-License-Identifier: Apache-2.0
"""Sensitivity of the brake response to dead time T and lag tau, which may be wrong in a train file.

The integral of the lagged target y over a sample, s(T, tau), is computed for T +- h and tau +- h. Its differences give
the gains of speed by the errors of dead time and lag, for f = 1, by statistical linearisation:

    gain_T = (s(T + h, tau) - s(T - h, tau)) / 2 h,

and the remaining variance, for an error with standard deviation h, is half the square of the second difference.
Whenever the brake is released, T and tau are set to their estimates, and h to their standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.records import NS_PER_S
from trainid_ros.train.brake import actuator_response

if TYPE_CHECKING:
    from trainid_ros.train.brake import CommandHistory
    from trainid_ros.train.train_file import Brake

# Smallest step of a difference quotient; below it rounding dominates [s].
_LEAST_SPREAD: Final = 0.02
# A smaller target has no effect [m/s^2].
_NOTHING: Final = 1e-4
# A time constant stays above this share of that of the train file [1].
_LEAST_LAG: Final = 0.25


class TimingStep:
    """Gains of speed by errors of dead time and lag for f = 1 [m/s per s], and the remaining variance [(m/s)^2]."""

    def __init__(self, delay_gain: float, lag_gain: float, variance: float) -> None:
        self.delay_gain, self.lag_gain, self.variance = delay_gain, lag_gain, variance


@dataclass
class Timing:
    """Estimates of dead time and lag.

    Attributes:
        delay: Dead time [s].
        lag: Time constant [s].
        delay_std: Standard deviation h of the dead time [s]; 0: known exactly.
        lag_std: Standard deviation h of the time constant [s].
        later: Lagged target of a brake of rate 1 with T + h [m/s^2].
        sooner: The same with T - h.
        slower: The same with tau + h.
        faster: The same with tau - h.
        has_acted: Whether the brake has acted since the last update.

    """

    delay: float
    lag: float
    delay_std: float
    lag_std: float
    later: float = 0.0
    sooner: float = 0.0
    slower: float = 0.0
    faster: float = 0.0
    has_acted: bool = False

    def is_valid(self) -> bool:
        """Return whether restored times and targets are physically possible."""
        times = (self.delay, self.lag, self.delay_std, self.lag_std)
        return min(times) >= 0.0 and max(self.later, self.sooner, self.slower, self.faster) <= 0.0

    def at_rest(self, commands: CommandHistory, stamp_ns: int) -> bool:
        """Return whether no command acts, acted recently, or is still pending for any possible dead time."""
        if commands.value(stamp_ns) != 0.0 or min(self.later, self.sooner, self.slower, self.faster) < -_NOTHING:
            return False
        longest_ns = round((self.delay + self.delay_std) * NS_PER_S)
        return not commands.changes or commands.changes[-1].stamp_ns < stamp_ns - longest_ns

    def release(self) -> None:
        """Set the targets to those of a released brake."""
        self.later = self.sooner = self.slower = self.faster = 0.0

    def move(self, errors: tuple[float, float], stds: tuple[float, float], brake: Brake) -> None:
        """Correct by estimated errors of T and tau with standard deviations [s], while the brake is released."""
        self.delay = max(0.0, self.delay + errors[0])
        self.lag = max(_LEAST_LAG * brake.time_constant, self.lag + errors[1])
        self.delay_std, self.lag_std = _spread(stds[0], self.delay_std), _spread(stds[1], self.lag_std)
        self.release()
        self.has_acted = False

    def step(self, commands: CommandHistory, start_ns: int, end_ns: int, nominal: float) -> TimingStep:
        """Propagate the targets over (start, end] [ns]; ``nominal`` is the integral of the nominal target [m/s]."""
        if self.at_rest(commands, end_ns):
            self.release()
            return TimingStep(0.0, 0.0, 0.0)
        T, tau, h, k = self.delay, self.lag, self.delay_std, self.lag_std
        shorter, less = max(0.0, T - h), max(_LEAST_LAG * tau, tau - k)
        self.later, later = _response(commands, start_ns, end_ns, self.later, T + h, tau)
        self.sooner, sooner = _response(commands, start_ns, end_ns, self.sooner, shorter, tau)
        self.slower, slower = _response(commands, start_ns, end_ns, self.slower, T, tau + k)
        self.faster, faster = _response(commands, start_ns, end_ns, self.faster, T, less)
        delay_gain = (later - sooner) / max(T + h - shorter, _LEAST_SPREAD)
        lag_gain = (slower - faster) / max(tau + k - less, _LEAST_SPREAD)
        by_delay, by_lag = later + sooner - 2.0 * nominal, slower + faster - 2.0 * nominal
        self.has_acted = True
        return TimingStep(delay_gain, lag_gain, 0.5 * (by_delay * by_delay) + 0.5 * (by_lag * by_lag))


def _response(
    commands: CommandHistory, start_ns: int, end_ns: int, target: float, delay: float, lag: float
) -> tuple[float, float]:
    """Return a target at the end of (start, end] [m/s^2], and its integral over it [m/s]."""
    return actuator_response(commands, start_ns, end_ns, target, delay_ns=round(delay * NS_PER_S), time_constant=lag)


def _spread(std: float, before: float) -> float:
    return min(max(std, _LEAST_SPREAD), before) if before > 0.0 else 0.0
