# SPDX-License-Identifier: Apache-2.0
"""What an estimator of the brake rate believes, whatever form the belief has: Gaussian, mixture or particles."""

from __future__ import annotations

from typing import NamedTuple, Protocol


class Interval(NamedTuple):
    """What moves the train over one sample, linear in speed v, brake acceleration a, disturbance b and rate f.

    v' = v + reach a + dt b + gain_v f + known,   a' = decay a + gain_a f,   b' = rho b.

    Attributes:
        dt: Duration [s].
        reach: Gain of speed by the brake acceleration at the start [s].
        decay: What is left of that acceleration at the end.
        gain_v: Gain of speed by the command at f = 1 [m/s].
        gain_a: The same of acceleration [m/s^2].
        rho: What is left of the disturbance at the end.
        known: Gain of speed by all known forces [m/s].
        q_v: Variance that white acceleration adds to v [(m/s)^2].
        q_b: Variance that enters b [(m/s^2)^2].

    """

    dt: float
    reach: float
    decay: float
    gain_v: float
    gain_a: float
    rho: float
    known: float
    q_v: float
    q_b: float


class Belief(Protocol):
    """The joint belief in f and in the train's motion x = [v, a, b]."""

    @property
    def rate(self) -> float:
        """Mean of f."""

    @property
    def variance(self) -> float:
        """Variance of f when it last learned."""

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""

    @property
    def effective(self) -> float:
        """Effective number of hypotheses; 1 for a Gaussian."""

    def reset(self, rate: float, std: float) -> None:
        """Go back to the prior."""

    def anchor(self, speed: float, target: float, variances: tuple[float, float, float]) -> None:
        """Start x anew from v and a = f target, with variances of v, a and b; f stands."""

    def predict(self, interval: Interval) -> None:
        """Follow the motion over an interval; f stands."""

    def predicted(self) -> tuple[float, float]:
        """Return mean and variance of v over all hypotheses."""

    def follow(self, speed: float, r: float) -> None:
        """Take in a speed with variance r that tells nothing of f."""

    def learn(self, interval: Interval, elapsed: float, speed: float, r: float) -> bool:
        """Take in a speed that also tells of f, which drifted over ``elapsed`` [s]; after :meth:`predict`.

        Returns:
            False, and nothing changes, if a number is no longer finite.

        """

    def save(self) -> str:
        """Return the whole state as JSON text."""

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError, and nothing changes, if it does not fit."""
