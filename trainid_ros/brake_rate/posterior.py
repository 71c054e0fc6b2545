# SPDX-License-Identifier: Apache-2.0
"""What an estimator of the brake rate believes, whatever form the belief has: Gaussian, mixture or particles."""

from __future__ import annotations

from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Errors = tuple[float, float, float, float, float, float, float, float]
NO_ERRORS: Final[Errors] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
UNCHANGED: Final[Errors] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
ERRORS: Final = len(NO_ERRORS)
STATES: Final = 3 + ERRORS
"""Number of states x = [v, a, b, e]."""


class Transition(NamedTuple):
    """What moves the train over one sample, linear in x = [v, a, b, e] and the brake rate f.

    v' = v + reach a + dt b + lean e + gain_v f + known,   a' = decay a + gain_a f,   b' = rho b,   e' = keep e.

    v is speed, a the acceleration by the brake, b a disturbance along the line. The errors e of the train file are
    those of dead time and lag, times f [s]; the relative errors of a + b v, of c v^2 and of the traction; the
    change of the brake rate from standstill to full speed; its change where electric and friction brakes change over;
    and the error of the brake at its present level [m/s^2].

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
        lean: Gain of speed by one unit of each error.
        keep: What is left of each error at the end.
        q_e: Variance that enters each error.
        calm: 1 while the response of the brake stands, towards 0 while it changes: then f is not seen to jump.

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
    lean: Errors = NO_ERRORS
    keep: Errors = UNCHANGED
    q_e: Errors = NO_ERRORS
    calm: float = 1.0


class Start(NamedTuple):
    """How speed v, brake acceleration a = f target and disturbance b start anew, and how the errors e go on.

    Attributes:
        speed: Speed [m/s].
        target: Brake acceleration at f = 1 [m/s^2].
        variances: Variances of v, a and b.
        keep: What is left of each error.
        q_e: Variance that enters each error.

    """

    speed: float
    target: float
    variances: tuple[float, float, float]
    keep: Errors = UNCHANGED
    q_e: Errors = NO_ERRORS


class Posterior(Protocol):
    """The joint distribution of f and of the train's motion x = [v, a, b, e]."""

    @property
    def rate(self) -> float:
        """Mean of f."""

    @property
    def variance(self) -> float:
        """Variance of f when it last learned."""

    def total_rate(self, share: Array) -> tuple[float, float]:
        """Return mean and variance of f + share e, shape (8,): the brake rate at this speed and level."""

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""

    @property
    def effective(self) -> float:
        """Effective number of hypotheses; 1 for a Gaussian."""

    @property
    def errors(self) -> Errors:
        """Means of the errors of the train file."""

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors of the train file."""

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Go back to the prior: mean and standard deviation of f, and of the errors, whose mean is zero."""

    def anchor(self, start: Start) -> None:
        """Start v, a and b anew; f stands."""

    def recentre(self, shift: Errors) -> None:
        """Count the errors from a new origin, ``shift`` away from the old."""

    def predict(self, interval: Transition) -> None:
        """Follow the motion over an interval; f stands."""

    def predicted(self) -> tuple[float, float]:
        """Return mean and variance of v over all hypotheses."""

    def follow(self, speed: float, r: float) -> None:
        """Take in a speed with variance r that tells nothing of f."""

    def learn(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Take in a speed that also tells of f, which drifted over ``elapsed`` [s]; after :meth:`predict`.

        Returns:
            False, and nothing changes, if a number is no longer finite.

        """

    def save(self) -> str:
        """Return the whole state as JSON text."""

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError, and nothing changes, if it does not fit."""


def errors_of(values: Array | list[float]) -> Errors:
    """Return eight numbers as errors."""
    e: list[float] = values if isinstance(values, list) else values.tolist()
    return e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7]
