# SPDX-License-Identifier: Apache-2.0
"""Delay of the reported force, estimated from the response of the speed to changes of the force.

If the stamps of the force f are late by delta, the model output equals the train's speed delta ago, so it is compared
with the speed measured then. An error in delta puts the model off by k delta (f - f0), where f0 is the force at the
last restart of the model from a measurement and k the acceleration coefficient: each change of the force makes the
error visible in the innovations. Measurement updates correct the model, so the sensitivity ``gain`` of x to delta
shrinks with each update. delta has a scalar recursion of its own, separate from that of theta: both use the same
innovations, and the uncertainty of one adds to the variance of x for the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

# Smallest standard deviation of the delay [s]: lags and the sampling grid are not a pure delay.
_LEAST_STD: Final = 0.003


@dataclass(frozen=True, slots=True)
class ForceDelay:
    """Delay of the reported force [s], its variance [s^2], and sensitivity of x to the delay [m/s^2]."""

    delay: float
    variance: float
    gain: float = 0.0

    @classmethod
    def unknown(cls, std: float) -> ForceDelay:
        """Return the prior: zero delay with a standard deviation [s]."""
        return cls(0.0, std * std)

    def changed(self, change: float) -> ForceDelay:
        """Return the prediction after the force changed the acceleration by ``change`` [m/s^2]."""
        return replace(self, gain=self.gain + change)

    def speed_variance(self, before: ForceDelay) -> float:
        """Return the variance that the uncertainty of the delay adds to x [(m/s)^2]."""
        return max(self.gain * self.gain - before.gain * before.gain, 0.0) * self.variance

    def learn(self, error: float, variance: float, noise: float) -> ForceDelay:
        """Update with an innovation of speed.

        Args:
            error: Measured less predicted speed [m/s].
            variance: Variance of that innovation [(m/s)^2].
            noise: Variance of the measurement noise, a part of it [(m/s)^2].

        """
        step = self.variance * self.gain / variance
        remaining = self.variance - step * self.gain * self.variance
        return ForceDelay(
            self.delay + step * error, max(remaining, min(self.variance, _LEAST_STD**2)), self.gain * noise / variance
        )

    def anchored(self) -> ForceDelay:
        """Return the delay after a restart of x from a measurement."""
        return replace(self, gain=0.0)
