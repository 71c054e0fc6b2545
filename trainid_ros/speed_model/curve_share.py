# SPDX-License-Identifier: Apache-2.0
"""Error of the train file's curve resistance, estimated as one more parameter in addition to theta.

A typical curve coefficient is accurate to 20 %, and on a line with many curves this is the largest error. It changes
the speed by a known amount per step, so it is estimated jointly with x and theta: the kernels hold the covariance of
x and theta; this module holds the variance of the curve error and its covariance with x and theta.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from trainid_ros.speed_model.method import Numbers

# Index of var(x) in the numbers of the kernel; cov(x, theta) follows.
_VARIANCE: Final = 5
# One update leaves at least this share of the variance, so that rounding cannot make it negative.
_LEAST: Final = 1e-3
# Limit of a squared correlation in a restored state: one, with a margin for rounding.
_MOST_CORRELATED: Final = 1.01


@dataclass(frozen=True, slots=True)
class CurveShare:
    """Error of the curve resistance at 600 m [N/kN], its covariance with x, a1, a2, b1, d0, and its variance."""

    error: float
    x: float
    a1: float
    a2: float
    b1: float
    d0: float
    variance: float

    def is_valid(self, variances: tuple[float, ...]) -> bool:
        """Return whether a restored state is consistent with these variances of x, a1, a2, b1, d0."""
        most, own = _MOST_CORRELATED * self.variance, (self.x, self.a1, self.a2, self.b1, self.d0)
        return most >= 0.0 and all(c * c <= most * v for c, v in zip(own, variances, strict=True))

    def push(self, numbers: Numbers, change: float) -> tuple[Numbers, CurveShare]:
        """Apply the curve error to a step in which 1 N/kN at 600 m radius changes the speed by ``change`` [m/s]."""
        x, *others = numbers
        others[_VARIANCE - 1] += change * (2.0 * self.x + change * self.variance)
        for i, with_error in enumerate((self.a1, self.a2, self.b1, self.d0)):
            others[_VARIANCE + i] += change * with_error
        return (x + change * self.error, *others), replace(self, x=self.x + change * self.variance)

    def step(self, x: float, theta: Numbers, u: float, scale: float) -> CurveShare:
        """Propagate over a model step from the speed x [m/s] with the force u [N/kN] over ``scale`` sample periods."""
        a1, a2 = theta[0], theta[1]
        slope = 1.0 + scale * (2.0 * a1 * x + a2 - 1.0)
        return replace(self, x=slope * self.x + scale * (x * x * self.a1 + x * self.a2 + u * self.b1 + self.d0))

    def learn(self, corrected: Numbers, error: float, variance: float, noise: float) -> CurveShare:
        """Return the curve error after a measurement update of the kernel.

        Args:
            corrected: State of the kernel after the update.
            error: Measured less predicted speed [m/s].
            variance: Variance of that innovation [(m/s)^2].
            noise: Variance of the measurement noise, a part of it [(m/s)^2].

        """
        gain = self.x / variance
        # Gains of the kernel: the covariance with x before the update is that after it times variance / noise.
        share = gain * variance / noise
        with_own, with_a1, with_a2, with_b1, with_d0 = corrected[_VARIANCE : _VARIANCE + 5]
        return CurveShare(
            error=self.error + gain * error,
            x=self.x - share * with_own,
            a1=self.a1 - share * with_a1,
            a2=self.a2 - share * with_a2,
            b1=self.b1 - share * with_b1,
            d0=self.d0 - share * with_d0,
            variance=max(self.variance - gain * self.x, _LEAST * self.variance),
        )

    def anchored(self) -> CurveShare:
        """Return the curve error after a restart of x from a measurement."""
        return replace(self, x=0.0)
