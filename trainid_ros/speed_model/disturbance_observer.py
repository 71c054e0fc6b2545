# SPDX-License-Identifier: Apache-2.0
"""Strength of unmodelled disturbances (gusts, map errors), from the speed error over windows of half a minute.

The disturbances are not white: a gust lasts for seconds, a map error for hundreds of metres. For parameters that are
estimated over many minutes their power at low frequency matters, which shows in the deviation of the speed from the
model over a long window, not from one sample to the next. This deviation is the sum of the corrections of x over the
window, without the effect of the updates of theta meanwhile. Consecutive windows with errors of the same sign
indicate a change of the resistance, not a disturbance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

# Longest window, and shortest one that is used [s].
_LONGEST: Final = 30.0
_SHORTEST: Final = 8.0
# Weight of the initial value, and memory, both in windows.
_PRIOR_WINDOWS: Final = 3.0
_MEMORY: Final = 60.0
# Limit of a squared window error over its expectation: a step of the resistance is not a gust.
_MOST: Final = 5.0
# Weight of one window in the running mean, and its limit in standard deviations.
_SHARE: Final = 0.4
_MOST_AGREED: Final = 4.0
# Map errors extend beyond one window: their power at long periods over that within a window.
_LASTING: Final = 1.4
# Limits of the estimate, as a standard deviation [m/s per sqrt(s)].
_RANGE: Final = (0.001, 0.05)
_PARAMETERS: Final = 4


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Strength of the unmodelled disturbances, and the current window.

    Attributes:
        density: Variance that the speed gains in a second [(m/s)^2/s].
        windows: Number of windows used for it [1].
        strayed: Sum of the corrections of x in the current window [m/s].
        elapsed: Duration of the window so far [s].
        theta: Parameters at the start of the window.
        agreed: Running mean of the window errors, in standard deviations [1].
        known: Variance of the speed at the end of the window due to the uncertainty of theta, over the square of its
            duration [(m/s^2)^2].

    """

    density: float
    windows: float = _PRIOR_WINDOWS
    strayed: float = 0.0
    elapsed: float = 0.0
    theta: tuple[float, ...] = ()
    known: float = 0.0
    agreed: float = 0.0

    @classmethod
    def declared(cls, std: float) -> Disturbance:
        """Return the initial state with the configured strength [m/s per sqrt(s)]."""
        return cls(std * std)

    def add(
        self, correction: float, theta: tuple[float, ...], phi: tuple[float, ...], dt: float, variance: float
    ) -> Disturbance:
        """Add a measurement to the current window.

        Args:
            correction: Correction of x by the measurement [m/s].
            theta: Parameters used to predict x.
            phi: Regressor of the step.
            dt: Time since the previous measurement [s].
            variance: Variance of the acceleration due to that of theta [(m/s^2)^2].

        """
        if self.elapsed == 0.0:
            return replace(self, strayed=correction, elapsed=dt, theta=theta, known=variance)
        updates = sum((now - then) * p for now, then, p in zip(theta, self.theta, phi, strict=True))
        more = replace(self, strayed=self.strayed + correction + updates, elapsed=self.elapsed + dt)
        return more.ended() if more.elapsed >= _LONGEST else more

    def ended(self) -> Disturbance:
        """Close the current window and update the strength, unless the window is too short."""
        restarted = replace(self, strayed=0.0, elapsed=0.0, theta=(), known=0.0)
        if self.elapsed < _SHORTEST:
            return restarted
        own = self.density * self.elapsed
        expected = own + self.known * self.elapsed * self.elapsed
        ratio = min(self.strayed * self.strayed / expected, _MOST)
        # Share of the error variance not due to theta; a window dominated by theta's uncertainty has little weight.
        share = own / expected
        weight = share * share * self.elapsed / _LONGEST
        windows = min(self.windows + weight, _MEMORY)
        density = self.density * (1.0 + (weight / windows) * (ratio - 1.0) / share)
        z = min(max(self.strayed / math.sqrt(expected), -_MOST_AGREED), _MOST_AGREED)
        return replace(
            restarted,
            density=min(max(density, _RANGE[0] ** 2), _RANGE[1] ** 2),
            windows=windows,
            agreed=self.agreed + _SHARE * (z - self.agreed),
        )

    def is_valid(self) -> bool:
        """Return whether a restored window can be continued."""
        known = self.density > 0.0 and 0.5 * _RANGE[0] < self.std < 2.0 * _RANGE[1]
        consistent = self.elapsed == 0.0 or len(self.theta) == _PARAMETERS
        return known and 0.0 < self.windows <= _MEMORY and min(self.elapsed, self.known) >= 0.0 and consistent

    @property
    def chi2(self) -> float:
        """Chi-square of the mean window error, one degree of freedom [1]."""
        return self.agreed * self.agreed * (2.0 - _SHARE) / _SHARE

    @property
    def lasting(self) -> float:
        """Density at periods of minutes, over which parameters are estimated [(m/s)^2/s]."""
        return _LASTING * self.density

    @property
    def std(self) -> float:
        """Standard deviation of the disturbance [m/s per sqrt(s)]."""
        return math.sqrt(self.density)
