# SPDX-License-Identifier: Apache-2.0
"""How late the reported force is, from what the speed does when the force changes.

With a force f whose stamps are late by delta the model is where the train was delta ago, so it is compared with the
speed measured then. What delta is off by leaves the model behind by k delta (f - f0), with f0 the force where the model
started from a measurement and k its acceleration coefficient: each change of the force shows it in the errors of
prediction. The model follows the measurement, and with each correction the share of the error that delta explains
becomes smaller: ``gain``. One recursion on delta alone, beside that on theta: both are shown by the same errors, and
what one is uncertain of widens the variance of x for the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

# The delay is never known better [s]: lags and the grid of the samples are no pure delay.
_LEAST_STD: Final = 0.003


@dataclass(frozen=True, slots=True)
class ForceDelay:
    """Delay of the reported force [s], its variance [s^2], and change of x for a change of the delay [m/s^2]."""

    delay: float
    variance: float
    gain: float = 0.0

    @classmethod
    def unknown(cls, std: float) -> ForceDelay:
        """Return the prior: no delay, with a standard deviation [s]."""
        return cls(0.0, std * std)

    def changed(self, change: float) -> ForceDelay:
        """Return it after a change of the acceleration by the force [m/s^2], before its measurement."""
        return replace(self, gain=self.gain + change)

    def speed_variance(self, before: ForceDelay) -> float:
        """Return what the variance of x gains by the uncertain delay [(m/s)^2]."""
        return max(self.gain * self.gain - before.gain * before.gain, 0.0) * self.variance

    def learn(self, error: float, variance: float, noise: float) -> ForceDelay:
        """Return it after an error of prediction [m/s].

        Args:
            error: Measured less predicted speed [m/s].
            variance: Variance of the error [(m/s)^2].
            noise: Part of the variance that is noise of the measurement [(m/s)^2].

        """
        step = self.variance * self.gain / variance
        left = self.variance - step * self.gain * self.variance
        return ForceDelay(
            self.delay + step * error, max(left, min(self.variance, _LEAST_STD**2)), self.gain * noise / variance
        )

    def anchored(self) -> ForceDelay:
        """Return it where x starts anew from a measurement."""
        return replace(self, gain=0.0)
