# SPDX-License-Identifier: Apache-2.0
"""What an algorithm for the speed model must offer to be driven by samples."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    from trainid_ros.speed_model.physical_parameters import Symmetric, Theta

Numbers: TypeAlias = tuple[float, ...]
"""All that an algorithm remembers; the first is its speed x, then theta."""


class Learned(NamedTuple):
    """What became of one measurement.

    Attributes:
        numbers: State after it.
        predicted: Speed predicted for it [m/s].
        error: Measured less predicted [m/s].
        limit: Errors beyond this are refused [m/s]; the state has then only moved on.
        forgetting: Forgetting factor.
        variance: Variance of the error as the algorithm states it [(m/s)^2]; 0 if it states none.

    """

    numbers: Numbers
    predicted: float
    error: float
    limit: float
    forgetting: float
    variance: float = 0.0

    @property
    def rejected(self) -> bool:
        """True if the measurement was not believed."""
        return abs(self.error) > self.limit


class Method(Protocol):
    """An algorithm on (y, u): pure functions of its state, no samples."""

    def start(self, variance: float) -> Numbers:
        """Return the state before the first measurement."""

    def fits(self, numbers: Numbers) -> bool:
        """Return whether finite numbers are as many as a state of this algorithm has, and no variance is negative."""

    def learn(self, numbers: Numbers, y: float, u: float, scale: float, variance: float) -> Learned:
        """Take in a speed y [m/s] after the force u [N/kN] over ``scale`` sample periods; variance of y [(m/s)^2]."""

    def coast(self, numbers: Numbers, u: float, scale: float) -> Numbers:
        """Move on without a measurement."""

    def anchor(self, numbers: Numbers, y: float, variance: float) -> Numbers:
        """Start the speed anew from a measurement; theta stands."""

    def shift(self, numbers: Numbers, change: float) -> Numbers:
        """Change the speed by what gradient and other known resistance do to it over a step [m/s]."""

    def widen_speed(self, numbers: Numbers, variance: float) -> Numbers:
        """Allow for what else changes the speed over a step [(m/s)^2]."""

    def widen_load(self, numbers: Numbers, share: float = 1.0) -> Numbers:
        """Allow for another load after a stop; ``share`` of the variance that is set."""

    def forget(self, numbers: Numbers, factor: float) -> Numbers:
        """Forget what was learned of the resistance by a factor."""

    def theta(self, numbers: Numbers) -> Theta:
        """Return a1, a2, b1, d0."""

    def covariance(self, numbers: Numbers, variance: float) -> Symmetric:
        """Return the covariance of theta, ``variance`` that of measured speed."""
