# SPDX-License-Identifier: Apache-2.0
"""Interface of an algorithm for the speed model, as used by the estimator."""

from __future__ import annotations

from typing import Protocol, TypeAlias

from trainid_ros.speed_model.physical_parameters import Symmetric, Theta

Numbers: TypeAlias = tuple[float, ...]
"""State of an algorithm as it is saved: its speed x, then theta, then what else it stores."""


class Learned:
    """Result of one measurement update.

    Attributes:
        predicted: Predicted speed [m/s].
        error: Measured less predicted speed [m/s].
        limit: Errors beyond this are rejected [m/s]; the state is then only predicted.
        forgetting: Forgetting factor [1].
        variance: Variance of the error as computed by the algorithm [(m/s)^2]; 0 if it computes none.
        rejected: Whether the measurement was rejected.

    """

    def __init__(self, predicted: float, error: float, limit: float, forgetting: float, variance: float = 0.0) -> None:
        self.predicted = predicted
        self.error = error
        self.limit = limit
        self.forgetting = forgetting
        self.variance = variance
        self.rejected = abs(error) > limit


class Method(Protocol):
    """An algorithm on (y, u), independent of samples; its methods change its state."""

    def start(self, variance: float) -> None:
        """Go to the state before the first measurement; ``variance`` is that of measured speed [(m/s)^2]."""

    def numbers(self) -> Numbers:
        """Return the state."""

    def restore(self, numbers: Numbers) -> bool:
        """Continue from a saved state; return False if it has the wrong length or a variance is negative."""

    def is_usable(self) -> bool:
        """Return whether all numbers are finite, b1 > 0 and the variances of theta > 0."""

    def speed(self) -> float:
        """Return x [m/s]."""

    def theta(self) -> Theta:
        """Return a1 [s/m], a2 [1], b1 [m/s per N/kN], d0 [m/s]."""

    def covariance(self, variance: float) -> Symmetric:
        """Return the covariance of theta; ``variance`` is that of measured speed [(m/s)^2]."""

    def learn(self, y: float, u: float, scale: float, variance: float) -> Learned:
        """Update with y [m/s] of a variance [(m/s)^2] after the force u [N/kN] over ``scale`` sample periods [1]."""

    def coast(self, u: float, scale: float) -> None:
        """Predict over ``scale`` sample periods with the force u [N/kN], without a measurement."""

    def anchor(self, y: float, variance: float) -> None:
        """Restart x from a measured speed y [m/s] with a variance [(m/s)^2]; theta is unchanged."""

    def shift(self, change: float) -> None:
        """Add to x the change of speed by gradient and other known resistance over a step [m/s]."""

    def widen_load(self, share: float) -> None:
        """Add a ``share`` [1] of the load variance to b1, for a change of load at a stop."""
