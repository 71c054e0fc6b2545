# SPDX-License-Identifier: Apache-2.0
"""Sensitivity of the brake response to dead time T and lag tau, which may be wrong in a train file.

The integral of the lagged target y over a sample, s(T, tau), is computed for T +- h and tau +- h. Its differences give
the gains of speed by the errors of dead time and lag, for f = 1, by statistical linearisation:

    gain_T = (s(T + h, tau) - s(T - h, tau)) / 2 h,

and the remaining variance, for an error with standard deviation h, is half the square of the second difference.
Whenever the brake is released, T and tau are set to their estimates, and h to their standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
Four = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Timing:
    """Estimates of dead time and lag.

    Attributes:
        delay: Dead time [s].
        lag: Time constant [s].
        spread: Standard deviations h of both [s]; 0: known exactly.
        targets: Lagged targets of a brake of rate 1 with T + h, T - h, tau + h, tau - h [m/s^2].
        fresh: Whether the brake has acted since the last update.

    """

    delay: float
    lag: float
    spread: tuple[float, float]
    targets: Four = (0.0, 0.0, 0.0, 0.0)
    fresh: bool = False

    @property
    def variants(self) -> tuple[tuple[float, float], ...]:
        """Dead time and lag of the four targets [s]."""
        delay, lag, (h, k) = self.delay, self.lag, self.spread
        return (delay + h, lag), (max(0.0, delay - h), lag), (delay, lag + k), (delay, max(0.25 * lag, lag - k))

    def is_valid(self) -> bool:
        """Return whether restored times and targets are physically possible."""
        return min(self.delay, self.lag, *self.spread) >= 0.0 and max(self.targets) <= 0.0

    def at_rest(self, commands: CommandHistory, stamp_ns: int) -> bool:
        """Return whether no command acts, acted recently, or is still pending for any possible dead time."""
        if commands.value(stamp_ns) != 0.0 or min(self.targets) < -_NOTHING:
            return False
        longest_ns = round(self.variants[0][0] * NS_PER_S)
        return not commands.changes or commands.changes[-1].stamp_ns < stamp_ns - longest_ns

    def moved(self, errors: tuple[float, float], stds: tuple[float, float], brake: Brake) -> Timing:
        """Return the timing corrected by estimated errors of T and tau with standard deviations [s]."""
        delay, lag = max(0.0, self.delay + errors[0]), max(0.25 * brake.time_constant, self.lag + errors[1])
        spread = (_spread(stds[0], self.spread[0]), _spread(stds[1], self.spread[1]))
        return Timing(delay, lag, spread)


@dataclass(frozen=True, slots=True)
class TimingStep:
    """Gains of speed by errors of dead time and lag for f = 1 [m/s per s], and the remaining variance [(m/s)^2]."""

    delay_gain: float
    lag_gain: float
    variance: float


def timing_step(
    timing: Timing, commands: CommandHistory, start_ns: int, end_ns: int, nominal: float
) -> tuple[Timing, TimingStep]:
    """Propagate the four targets over (start, end] [ns]; ``nominal`` is the integral of the nominal target [m/s]."""
    if timing.at_rest(commands, end_ns):
        return replace(timing, targets=(0.0, 0.0, 0.0, 0.0)), TimingStep(0.0, 0.0, 0.0)
    ends, sums = [], []
    for (delay, lag), before in zip(timing.variants, timing.targets, strict=True):
        shift = round(delay * NS_PER_S)
        end, total = actuator_response(commands, start_ns, end_ns, before, delay_ns=shift, time_constant=lag)
        ends.append(end)
        sums.append(total)
    (later, _), (sooner, _), (_, slower), (_, faster) = timing.variants
    delay_gain = (sums[0] - sums[1]) / max(later - sooner, _LEAST_SPREAD)
    lag_gain = (sums[2] - sums[3]) / max(slower - faster, _LEAST_SPREAD)
    remaining = 0.5 * (sums[0] + sums[1] - 2.0 * nominal) ** 2 + 0.5 * (sums[2] + sums[3] - 2.0 * nominal) ** 2
    targets = (ends[0], ends[1], ends[2], ends[3])
    return replace(timing, targets=targets, fresh=True), TimingStep(delay_gain, lag_gain, remaining)


def _spread(std: float, before: float) -> float:
    return min(max(std, _LEAST_SPREAD), before) if before > 0.0 else 0.0
