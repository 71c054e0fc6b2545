# SPDX-License-Identifier: Apache-2.0
"""How strong gusts, map errors and all else that is not modelled are: what they do to the speed over half a minute.

They are not white: a gust lasts for seconds, an error of the map for hundreds of metres. What matters for parameters
that are learned over many minutes is their power at low frequency, and that shows in how far the speed strays from
the model over a long window, not from one sample to the next. The corrections of x over the window add up to that,
with what was learned of theta meanwhile taken back. Windows whose errors agree in sign show a change of the resistance,
which is no disturbance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

# Longest and shortest window that counts [s].
_LONGEST: Final = 30.0
_SHORTEST: Final = 8.0
# The starting value counts for so many windows, and no window is remembered longer than so many.
_PRIOR_WINDOWS: Final = 3.0
_MEMORY: Final = 60.0
# One window counts for no more than this many times what was expected of it: a step of the resistance is no gust.
_MOST: Final = 5.0
# Weight of one window in the agreement, and the limit of one window in standard deviations.
_SHARE: Final = 0.4
_MOST_AGREED: Final = 4.0
# Errors of the map reach over more than a window: their power at long periods over that of a window.
_LASTING: Final = 1.4
# Limits of what is learned, as a standard deviation [m/s per sqrt(s)].
_RANGE: Final = (0.001, 0.05)
_PARAMETERS: Final = 4


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Strength of what is not modelled, and the window under way.

    Attributes:
        density: Variance that the speed gains in a second [(m/s)^2/s].
        windows: Windows that it was learned from.
        strayed: Sum of the corrections of x in this window [m/s].
        elapsed: Its duration so far [s].
        theta: Parameters at its beginning.
        agreed: Running mean of the errors of windows, in standard deviations.
        known: Variance of the speed at its end by the uncertain model, over the square of its duration [(m/s^2)^2].

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
        """Return the strength as declared [m/s per sqrt(s)]."""
        return cls(std * std)

    def add(
        self, correction: float, theta: tuple[float, ...], phi: tuple[float, ...], dt: float, variance: float
    ) -> Disturbance:
        """Return it after a measurement.

        Args:
            correction: Correction of x by the measurement [m/s].
            theta: Parameters that x was predicted with.
            phi: Regressor of the step.
            dt: Time since the last measurement [s].
            variance: Variance of the acceleration by that of theta [(m/s^2)^2].

        """
        if self.elapsed == 0.0:
            return replace(self, strayed=correction, elapsed=dt, theta=theta, known=variance)
        learned = sum((now - then) * p for now, then, p in zip(theta, self.theta, phi, strict=True))
        more = replace(self, strayed=self.strayed + correction + learned, elapsed=self.elapsed + dt)
        return more.ended() if more.elapsed >= _LONGEST else more

    def ended(self) -> Disturbance:
        """Return it after the end of a window, which may be too short to count."""
        again = replace(self, strayed=0.0, elapsed=0.0, theta=(), known=0.0)
        if self.elapsed < _SHORTEST:
            return again
        own = self.density * self.elapsed
        expected = own + self.known * self.elapsed * self.elapsed
        ratio = min(self.strayed * self.strayed / expected, _MOST)
        # The part of the error that the model does not explain; a window that it explains counts little.
        share = own / expected
        weight = share * share * self.elapsed / _LONGEST
        windows = min(self.windows + weight, _MEMORY)
        density = self.density * (1.0 + (weight / windows) * (ratio - 1.0) / share)
        z = min(max(self.strayed / math.sqrt(expected), -_MOST_AGREED), _MOST_AGREED)
        return replace(
            again,
            density=min(max(density, _RANGE[0] ** 2), _RANGE[1] ** 2),
            windows=windows,
            agreed=self.agreed + _SHARE * (z - self.agreed),
        )

    def is_valid(self) -> bool:
        """True if a window can be gone on with, as it may not be when restored."""
        known = self.density > 0.0 and 0.5 * _RANGE[0] < self.std < 2.0 * _RANGE[1]
        under_way = self.elapsed == 0.0 or len(self.theta) == _PARAMETERS
        return known and 0.0 < self.windows <= _MEMORY and min(self.elapsed, self.known) >= 0.0 and under_way

    @property
    def chi2(self) -> float:
        """Agreement of the windows as a chi-square of one degree of freedom."""
        return self.agreed * self.agreed * (2.0 - _SHARE) / _SHARE

    @property
    def lasting(self) -> float:
        """Density at the periods of minutes that parameters are learned from [(m/s)^2/s]."""
        return _LASTING * self.density

    @property
    def std(self) -> float:
        """Strength [m/s per sqrt(s)]."""
        return math.sqrt(self.density)
