# SPDX-License-Identifier: Apache-2.0
"""Upper bounds of the stopping distance at a stated confidence, and the speed from which a bound is met.

The parameters p of a stop are normal with mean p0 and covariance S. The bound at confidence P is the distance at the
design point of the first-order reliability method: of all p that are z = Phi^-1(P) standard deviations from p0, the
one with the longest distance,

    p* = p0 + z S D' / sqrt(D'^T S D'),        D' = dD/dp at p*,

found by iteration from D' at p0. D is convex, so that each step lengthens it, and its error falls as the square of that
of p*. Where the distance is linear in p this is D + z std(D); a brake rate enters by its inverse, so that the bound of
a poorly known one is longer than that.

The deceleration d(v) of the built-up brake is linear in p. Where d0 - z std(d) <= 0 at some speed, a fraction of more
than 1 - P never slows below that speed, so from higher speeds there is no bound.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Final

from trainid_ros.client.stopping import DELAY, LAG, PARAMETERS, RATE, A, B, Braking, C
from trainid_ros.errors import NoAnswerError

if TYPE_CHECKING:
    from trainid_ros.client.stopping import RateShape, Stop

MOST_SPEED: Final = 150.0
"""Largest speed of an argument or an answer [m/s]."""
_DAVIS: Final = (A, B, C)
# The design point is found when its distance grows by no more than this share, and most iterations to it.
_CONVERGED: Final = 1e-9
_REFINEMENTS: Final = 200
# Where the deceleration is calculated between two knots of the brake rate.
_BETWEEN: Final = (0.25, 0.5, 0.75, 1.0)
# The speed is found when its bound is this close to the distance [m].
_CLOSE: Final = 1e-9
_ITERATIONS: Final = 100
# Speeds below this count as standstill, and the slowest at which a train has to stop at all [m/s].
_STANDING: Final = 1e-9
_SLOWEST: Final = 1e-3
NO_BRAKE: Final = 1e-3
"""Brake rates below this count as no brake [1]."""


@dataclass(frozen=True, slots=True)
class StopPosterior:
    """What is known of the parameters of a stop: independent but for a, b and c.

    Attributes:
        mean: In the order of ``stopping.RATE`` to ``LAG``.
        variances: Of each in its squared unit; those of a, b and c are in ``davis``.
        davis: Covariance of (a, b, c), 3x3, row-major.

    """

    mean: tuple[float, ...]
    variances: tuple[float, ...]
    davis: tuple[float, ...]

    def spread(self, gradient: list[float]) -> list[float]:
        """Return the covariance times a gradient, shape (9,)."""
        out = [variance * slope for variance, slope in zip(self.variances, gradient, strict=True)]
        for i, place in enumerate(_DAVIS):
            row = self.davis[3 * i : 3 * i + 3]
            out[place] = row[0] * gradient[A] + row[1] * gradient[B] + row[2] * gradient[C]
        return out

    def std(self, gradient: list[float]) -> float:
        """Return the standard deviation along a gradient."""
        return math.sqrt(max(0.0, math.fsum(map(_product, self.spread(gradient), gradient))))


def _product(x: float, y: float) -> float:
    return x * y


@dataclass(frozen=True, slots=True)
class Bound:
    """Bound of a stopping distance [m], standard deviation of the distance [m], and derivative by speed [s].

    Attributes:
        gradient: Derivatives of the distance by the parameters at the design point; empty where the bound is infinite.

    """

    distance: float
    std: float
    by_speed: float
    gradient: list[float]


class LeastDeceleration:
    """Whether the built-up brake decelerates at all speeds up to one, at a confidence.

    Args:
        shape: Brake rate over speed.
        posterior: What is known of the parameters.
        command: Brake target [m/s^2, > 0].
        z: Standard deviations of the confidence.

    """

    def __init__(self, shape: RateShape, posterior: StopPosterior, command: float, z: float) -> None:
        self._shape, self._posterior, self._command, self._z = shape, posterior, command, z
        knots = shape.knots(MOST_SPEED)
        self._grid = [0.0]
        for k in range(1, len(knots)):
            self._grid.extend([knots[k - 1] + share * (knots[k] - knots[k - 1]) for share in _BETWEEN])
        # Number of these speeds that are known to be good.
        self._good = 0

    def is_positive(self, speed: float) -> bool:
        """Return whether the train slows down at all speeds up to one [m/s]."""
        last = bisect_right(self._grid, speed)
        while self._good < last:
            if self._least(self._grid[self._good]) <= 0.0:
                return False
            self._good += 1
        return self._least(speed) > 0.0

    def _least(self, v: float) -> float:
        """Return the deceleration at a speed less z standard deviations [m/s^2]."""
        shape, k = self._shape, self._shape.k
        rate = shape.table(v) * self._command
        gradient = [rate, rate * shape.slope(v), rate * shape.changeover(v), k, k * v, k * v * v, k, 0.0, 0.0]
        mean = math.fsum(map(_product, gradient, self._posterior.mean)) + k * shape.extra(v)
        return mean - self._z * self._posterior.std(gradient)


class StoppingBounds:
    """Bounds of the stopping distance for one brake command.

    Args:
        shape: Brake rate over speed.
        posterior: What is known of the parameters.
        command: Brake target from now on [m/s^2, > 0].
        applied: Brake target until it acts [m/s^2, >= 0].
        confidence: Probability that the train stops within the bound, in [0.5, 1).

    """

    def __init__(
        self, shape: RateShape, posterior: StopPosterior, command: float, applied: float, confidence: float
    ) -> None:
        self._shape, self._posterior = shape, posterior
        self._command, self._applied = command, applied
        self._z = NormalDist().inv_cdf(confidence)
        self._at_mean = Braking(shape, list(posterior.mean), command, applied)
        self._least = LeastDeceleration(shape, posterior, command, self._z)

    def at(self, speed: float) -> Bound:
        """Return the bound for a speed [m/s, >= 0]; infinite where the train may not stop."""
        at_mean = self._at_mean.stop(speed)
        if math.isinf(at_mean.distance) or not self._least.is_positive(speed):
            return Bound(math.inf, math.inf, math.inf, [])
        std = self._posterior.std(at_mean.gradient)
        found = self._beside(speed, at_mean.gradient)
        for _ in range(_REFINEMENTS):
            if math.isinf(found.distance):
                break
            before, found = found.distance, self._beside(speed, found.gradient)
            if abs(found.distance - before) <= _CONVERGED * before:
                return Bound(found.distance, std, found.by_speed, found.gradient)
        return Bound(math.inf, std, math.inf, [])

    def _beside(self, speed: float, gradient: list[float]) -> Stop:
        """Return the stop z standard deviations from the mean along a gradient."""
        spread, std = self._posterior.spread(gradient), self._posterior.std(gradient)
        step = self._z / std if std > 0.0 else 0.0
        theta = [self._posterior.mean[j] + step * spread[j] for j in range(PARAMETERS)]
        theta[DELAY], theta[LAG] = max(0.0, theta[DELAY]), max(0.0, theta[LAG])
        stop = Braking(self._shape, theta, self._command, self._applied).stop(speed)
        if theta[RATE] < NO_BRAKE:
            stop.distance = math.inf
        return stop

    def speed(self, distance: float) -> tuple[float, float]:
        """Return the speed [m/s] whose bound is a distance [m, >= 0], and the standard deviation of that speed [m/s].

        The train stops within the distance from all speeds up to this one. It is at most ``MOST_SPEED``, and 0 where
        even the slowest train may not stop within the distance.

        Raises:
            NoAnswerError: The train may not stop from any speed.

        """
        low, high, speed = 0.0, MOST_SPEED, min(self._first_guess(distance), MOST_SPEED)
        found = self.at(speed)
        for _ in range(_ITERATIONS):
            excess = found.distance - distance
            if abs(excess) <= _CLOSE or high - low <= 1e-12 or (speed == MOST_SPEED and excess < 0.0):
                break
            low, high = (low, speed) if excess > 0.0 else (speed, high)
            speed = self._next(speed, excess, found, low, high)
            found = self.at(speed)
        if math.isinf(found.distance):
            speed, found = low, self.at(low)
        return self._checked(speed, found)

    @staticmethod
    def _next(speed: float, excess: float, found: Bound, low: float, high: float) -> float:
        """Return the speed of the next iteration: by Newton's method, or by halves where that leaves the bracket."""
        following = speed - excess / found.by_speed if 0.0 < found.by_speed < math.inf else -math.inf
        if following >= high == MOST_SPEED:
            return MOST_SPEED
        return following if low < following < high else 0.5 * (low + high)

    def _checked(self, speed: float, found: Bound) -> tuple[float, float]:
        if speed > _STANDING:
            # Of a stiff balance, which no train has, the derivative may have any sign.
            return speed, found.std / abs(found.by_speed)
        if math.isinf(self.at(_SLOWEST).distance):
            raise NoAnswerError(self.no_answer())
        return 0.0, 0.0

    def _first_guess(self, distance: float) -> float:
        """Return the speed of a constant deceleration after dead time and time constant [m/s]."""
        mean = self._posterior.mean
        d = max(0.05, mean[RATE] * self._command)
        lost = d * (mean[DELAY] + mean[LAG]) if self._applied == 0.0 else 0.0
        return math.sqrt(lost * lost + 2.0 * d * distance) - lost

    def no_answer(self) -> str:
        """Return the message of NoAnswerError."""
        return f'at this confidence the train may not stop: command = {-self._command:g} m/s^2 is too weak here'
