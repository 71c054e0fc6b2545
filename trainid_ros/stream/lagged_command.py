# SPDX-License-Identifier: Apache-2.0
"""The brake command after the lag, and its integral at earlier times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from trainid_ros.records import NS_PER_S
from trainid_ros.stream.samples import Sample
from trainid_ros.train.brake import lag_integral, lag_response

# A lagged command that does not brake [m/s^2].
_RELEASED: Final = 1e-3


@dataclass(slots=True)
class LaggedCommand:
    """The brake command after the lag, without dead time.

    Attributes:
        command: Brake command [m/s^2].
        lagged: The command after the lag [m/s^2].
        integral: Its integral since the braking began [m/s].
        time_s: Time since then [s].
        rest_s: Time for which nothing has been commanded [s].
        history: Times [s] and integrals [m/s] in turn, oldest first.

    """

    command: float = 0.0
    lagged: float = 0.0
    integral: float = 0.0
    time_s: float = 0.0
    rest_s: float = 0.0
    history: tuple[float, ...] = ()

    def follow(self, sample: Sample, time_constant: float, longest_s: float) -> None:
        """Go on to a sample; a history older than ``longest_s`` [s] is forgotten."""
        left = sample.dt
        for change in sample.brake_changes:
            after = min(max((sample.stamp_ns - change.stamp_ns) / NS_PER_S, 0.0), left)
            self._hold(left - after, time_constant)
            left, self.command = after, change.target_acceleration
        self._hold(left, time_constant)
        self.time_s += sample.dt
        released = self.command == 0.0 and self.lagged > -_RELEASED
        self.rest_s = self.rest_s + sample.dt if released else 0.0
        history, first = (*self.history, self.time_s, self.integral), 0
        while first + 4 <= len(history) and history[first + 2] < self.time_s - longest_s:
            first += 2
        self.history = history[first:]

    def _hold(self, duration: float, time_constant: float) -> None:
        self.integral += lag_integral(self.lagged, self.command, time_constant, duration)
        self.lagged = lag_response(self.lagged, self.command, time_constant, duration)

    def begin(self) -> None:
        """Count time and integral from now on."""
        self.time_s = self.integral = 0.0
        self.history = (0.0, 0.0)

    def integral_at(self, time_s: float) -> float:
        """Return the integral at a time [s]; nothing acts before the braking, and it goes on as it is at the end."""
        history = self.history
        last = len(history) - 2
        if time_s >= history[last]:
            return history[last + 1] + self.lagged * (time_s - history[last])
        while last >= 2 and history[last - 2] > time_s:
            last -= 2
        if last < 2:
            return history[1]
        before_s, before = history[last - 2], history[last - 1]
        return before + (history[last + 1] - before) * (time_s - before_s) / (history[last] - before_s)
