# SPDX-License-Identifier: Apache-2.0
"""Interface of an algorithm for the speed model, as used by the estimator."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    from trainid_ros.speed_model.physical_parameters import Symmetric, Theta

Numbers: TypeAlias = tuple[float, ...]
"""State of an algorithm: its speed x, then theta, then what else it stores."""


class Learned(NamedTuple):
    """Result of one measurement update.

    Attributes:
        numbers: State after the update.
        predicted: Predicted speed [m/s].
        error: Measured less predicted speed [m/s].
        limit: Errors beyond this are rejected [m/s]; the state is then only predicted.
        forgetting: Forgetting factor [1].
        variance: Variance of the error as computed by the algorithm [(m/s)^2]; 0 if it computes none.

    """

    numbers: Numbers
    predicted: float
    error: float
    limit: float
    forgetting: float
    variance: float = 0.0

    @property
    def rejected(self) -> bool:
        """Whether the measurement was rejected."""
        return abs(self.error) > self.limit


class Method(Protocol):
    """An algorithm on (y, u): pure functions of its state, independent of samples."""

    def start(self, variance: float) -> Numbers:
        """Return the state before the first measurement; ``variance`` is that of measured speed [(m/s)^2]."""

    def fits(self, numbers: Numbers) -> bool:
        """Return whether finite numbers have the length of a state of this algorithm and no negative variance."""

    def learn(self, numbers: Numbers, y: float, u: float, scale: float, variance: float) -> Learned:
        """Update with y [m/s] of a variance [(m/s)^2] after the force u [N/kN] over ``scale`` sample periods [1]."""

    def coast(self, numbers: Numbers, u: float, scale: float) -> Numbers:
        """Predict over ``scale`` sample periods with the force u [N/kN], without a measurement."""

    def anchor(self, numbers: Numbers, y: float, variance: float) -> Numbers:
        """Restart x from a measured speed y [m/s] with a variance [(m/s)^2]; theta is unchanged."""

    def shift(self, numbers: Numbers, change: float) -> Numbers:
        """Add to x the change of speed by gradient and other known resistance over a step [m/s]."""

    def widen_speed(self, numbers: Numbers, variance: float) -> Numbers:
        """Add the variance of unmodelled changes of speed over a step to that of x [(m/s)^2]."""

    def widen_load(self, numbers: Numbers, share: float = 1.0) -> Numbers:
        """Add a ``share`` [1] of the load variance to b1, for a change of load at a stop."""

    def forget(self, numbers: Numbers, factor: float) -> Numbers:
        """Reduce the information on the resistance by a factor in (0, 1]."""

    def theta(self, numbers: Numbers) -> Theta:
        """Return a1 [s/m], a2 [1], b1 [m/s per N/kN], d0 [m/s]."""

    def covariance(self, numbers: Numbers, variance: float) -> Symmetric:
        """Return the covariance of theta; ``variance`` is that of measured speed [(m/s)^2]."""
