# SPDX-License-Identifier: Apache-2.0
"""Interface of the posterior of a brake rate estimator: Gaussian, mixture or particles."""

from __future__ import annotations

from typing import Final, Protocol

from trainid_ros.vectors import vec

Errors = tuple[float, float, float, float, float, float, float, float]
NO_ERRORS: Errors = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
UNCHANGED: Errors = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
ERRORS: Final = 8
STATES: Final = 11
"""Number of states x = [v, a, b, e]."""


class Transition:
    """Motion of the train over one sample, linear in x = [v, a, b, e] and the brake rate f.

    v' = v + reach a + dt b + gain_e e + gain_v f + known,   a' = decay a + gain_a f,   b' = rho b,   e' = decay_e e.

    v is the speed [m/s], a the acceleration by the brake [m/s^2], b a disturbance along the line [m/s^2]. The errors e
    of the train file are those of dead time and lag, times f [s]; the relative errors of a + b v, of c v^2 and of the
    traction [1]; the change of the brake rate from standstill to full speed [1]; its change where electric and friction
    brakes change over [1]; and the error of the brake at its present level [m/s^2].

    Attributes:
        dt: Duration [s].
        reach: Gain of speed by the brake acceleration at the start [s].
        decay: Share of that acceleration left at the end [1].
        gain_v: Gain of speed by the command at f = 1 [m/s].
        gain_a: Gain of brake acceleration by the command at f = 1 [m/s^2].
        rho: Share of the disturbance left at the end [1].
        known: Gain of speed by all known forces [m/s].
        q_v: Variance that white acceleration adds to v [(m/s)^2].
        q_b: Variance added to b [(m/s^2)^2].
        gain_e: Gain of speed per unit of each error [m/s per unit].
        decay_e: Share of each error left at the end [1].
        q_e: Variance added to each error.
        steadiness: Steadiness of the brake response [1]: 1 while it is constant, towards 0 while it changes, when a
            jump of f cannot be detected.

    The arrays over the errors have the shape (8,).

    """

    def __init__(
        self,
        dt: float,
        reach: float,
        decay: float,
        gain_v: float,
        gain_a: float,
        rho: float,
        known: float,
        q_v: float,
        q_b: float,
        gain_e: Errors = NO_ERRORS,
        decay_e: Errors = UNCHANGED,
        q_e: Errors = NO_ERRORS,
        steadiness: float = 1.0,
    ) -> None:
        self.dt, self.reach, self.decay, self.gain_v, self.gain_a = dt, reach, decay, gain_v, gain_a
        self.rho, self.known, self.q_v, self.q_b, self.steadiness = rho, known, q_v, q_b, steadiness
        self.gain_e, self.decay_e, self.q_e = vec[float](gain_e), vec[float](decay_e), vec[float](q_e)


class Start:
    """Restart of speed v, brake acceleration a = f target and disturbance b; propagation of the errors e.

    Attributes:
        speed: Speed [m/s].
        target: Brake acceleration at f = 1 [m/s^2].
        variances: Variances of v [(m/s)^2], a given f [(m/s^2)^2] and b [(m/s^2)^2].
        decay_e: Share of each error that is left [1].
        q_e: Variance added to each error.

    """

    def __init__(
        self,
        speed: float,
        target: float,
        variances: tuple[float, float, float],
        decay_e: Errors = UNCHANGED,
        q_e: Errors = NO_ERRORS,
    ) -> None:
        self.speed, self.target, self.variances = speed, target, variances
        self.decay_e, self.q_e = vec[float](decay_e), vec[float](q_e)


class Posterior(Protocol):
    """The joint distribution of f and of the train's motion x = [v, a, b, e]."""

    @property
    def rate(self) -> float:
        """Mean of f [1]."""

    @property
    def variance(self) -> float:
        """Variance of f at its last update [1]."""

    def total_rate(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance of f + share e [1], the brake rate at this speed and level; share of shape (8,)."""

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""

    @property
    def effective(self) -> float:
        """Effective number of hypotheses [1]; 1 for a Gaussian."""

    @property
    def errors(self) -> Errors:
        """Means of the errors of the train file; units as in :class:`Transition`."""

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors of the train file."""

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior: mean and std of f [1], and standard deviations of the errors, whose mean is zero."""

    def anchor(self, start: Start) -> None:
        """Restart v, a and b; f is unchanged."""

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval; f is constant."""

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v over all hypotheses."""

    def follow(self, speed: float, r: float) -> None:
        """Update all states except f with a measured speed [m/s] of variance r [(m/s)^2]."""

    def learn(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update all states and f, which drifted over ``elapsed`` [s], with a measured speed; after :meth:`predict`.

        Args:
            interval: Motion model since the last sample.
            elapsed: Time since the last update of f [s].
            speed: Measured speed [m/s].
            r: Its variance [(m/s)^2].

        Returns:
            False if a number is no longer finite; the posterior is then unchanged.

        """

    def save(self) -> str:
        """Return the complete state as JSON text."""

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError and leave the state unchanged if it is invalid."""
