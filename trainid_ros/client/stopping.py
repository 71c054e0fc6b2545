# SPDX-License-Identifier: Apache-2.0
"""Distance in which a train stops after a brake command, and its derivatives by every parameter.

With the time t since the command u1 and the brake target u0 that acts until then (magnitudes, m/s^2),

    -dv/dt = r(v) U(t) + k (a + i + b v + c v^2 + x(v)),        k = g0 / (1000 (1 + gamma)),
    r(v) = s(v) (f + e p(v) + h m(v)),
    U(t) = u0 during the dead time T, then u1 + (u0 - u1) exp(-(t - T) / tau).

s(v) is the table of the train file and f the estimated factor on it; x(v) is the resistance of the effects that the
train file states. e and h are errors of the brake rate over speed, as in ``brake_rate.motion_model``: p rises from -1/2
at rest to 1/2 at full speed, m is 1 at the changeover between electric and friction brakes.

The balance is integrated over time until the brake is built up (Runge-Kutta, order 4), then over speed down to zero
(Gauss-Legendre between the knots of r). The derivatives follow from l(t), that of the distance to go by the speed,
calculated backwards from l = v / (-dv/dt):

    dl/dt = -1 + l d(-dv/dt)/dv,        dD/dp = -integral of l d(-dv/dt)/dp over time.

The trapezoidal rule is used for both, so a derivative is up to 7 % too small if the train stops while the brake builds
up.

At a place on the line, z(s) + y(s) v^2 is added to x(v), with the distance s run: gradients, curves and tunnels, linear
between knots. The balance is then integrated over time down to zero, in steps that end at knots of s and of r. With
m(t), the derivative of the distance by a shift of the line, dl/dt = -m + l d(-dv/dt)/dv and dm/dt = l d(-dv/dt)/ds.

Upper bounds of the distance are stated at a confidence. The parameters p of a stop are normal with mean p0 and
covariance S. The bound at confidence P is the distance at the design point of the first-order reliability method: of
all p that are z = Phi^-1(P) standard deviations from p0, the one with the longest distance,

    p* = p0 + z S D' / sqrt(D'^T S D'),        D' = dD/dp at p*,

found by iteration from D' at p0. D is convex, so that each step lengthens it, and its error falls as the square of that
of p*. Where the distance is linear in p this is D + z std(D); a brake rate enters by its inverse, so that the bound of
a poorly known one is longer than that.

The deceleration d(v) of the built-up brake is linear in p. Where d0 - z std(d) <= 0 at some speed, a fraction of more
than 1 - P never slows below that speed, so from higher speeds there is no bound. At a place on the line there is none
unless a train stops that decelerates by d0 - z std(d) all the way.

The brake may have dropped since it was last observed: with probability q, its rate is (1 - loss) r. The bound D is then
that of the mixture of both brakes. With D0(z) and D1(z), the bounds of the brake as known and of the lower one,

    D = D0(z0) = D1(z1),        (1 - q) Phi(z0) + q Phi(z1) = P,

found by iteration: D0 and D1 are taken to be linear in z, with dD0/dz = sqrt(D'^T S D') at the design point.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from operator import mul
from statistics import NormalDist
from typing import Final

from trainid_ros.brake_rate.motion_model import rate_changeover, rate_slope
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.train.forces import Interpolation

# Places of the parameters in a list of them.
RATE: Final = 0  # place of f, the brake rate [1]
SLOPE: Final = 1  # place of e, its change from rest to full speed [1]
CHANGEOVER: Final = 2  # place of h, its change where electric and friction brakes change over [1]
A: Final = 3  # place of a [N/kN]
B: Final = 4  # place of b [N/kN per m/s]
C: Final = 5  # place of c [N/kN per (m/s)^2]
GRADIENT: Final = 6  # place of i, the gradient [per mille]
DELAY: Final = 7  # place of T, the dead time [s]
LAG: Final = 8  # place of tau, the time constant [s]
PARAMETERS: Final = 9  # number of parameters

MAX_SPEED: Final = 150.0
"""Largest speed of an argument or an answer [m/s]."""
EXTRA_SPEEDS: Final = [0.25 * k for k in range(601)]
"""Speeds at which x(v) is given, up to ``MAX_SPEED`` [m/s]."""
# Steps while the brake builds up, in time constants.
_BUILD_UP: Final = (0.4, 0.8, 1.2, 1.7, 2.2, 2.8, 3.5, 4.3, 5.3, 6.5, 8.0, 10.0)
# Gauss-Legendre nodes and weights on (0, 1), order 10.
_NODES: Final = (0.04691007703066802, 0.23076534494715845, 0.5, 0.7692346550528415, 0.953089922969332)
_WEIGHTS: Final = (
    0.11846344252809454, 0.23931433524968324, 0.28444444444444444, 0.23931433524968324, 0.11846344252809454
)  # fmt: skip
# Half the step of the derivative by speed [m/s].
_SPEED_STEP: Final = 0.01
# Steps at a place on the line: share of the time to the stop, shortest and longest [s].
_SHARE, _SHORTEST_S, _LONGEST_S = 0.1, 0.25, 2.0
# Knots closer than this do not end a step [m, m/s]: what is left of one changes the distance by less than 1 mm.
_NEAR_M, _NEAR_SPEED = 0.05, 0.02
# Largest number of iterations of the design point there; near a summit they would be hundreds.
_ON_LINE_STEPS: Final = 30
# A train that runs further, or becomes faster, does not stop [m, m/s].
_FURTHEST_M, _FASTEST = 1e5, 400.0


@dataclass
class RateShape:
    """Brake rate over speed of a train file: r(v) is linear between the knots but for its table."""

    speeds: list[float]  # speeds of the table [m/s], increasing; empty without one
    rates: list[float]  # its rates [1]
    max_speed: float  # speed from which p is constant [m/s]
    blend_speed: float  # speed of the changeover between brakes [m/s]
    k: float  # deceleration by a resistance of 1 N/kN [m/s^2]
    # x(v) at EXTRA_SPEEDS [N/kN], linear between them and constant beyond; empty if it is zero
    resistances: list[float] = field(default_factory=list)
    # Distances from the start of the braking [m], the first not ahead; z and y there [N/kN, N/kN per (m/s)^2], constant
    # beyond them; empty without a place
    ahead: list[float] = field(default_factory=list)
    at_place: list[float] = field(default_factory=list)
    by_square: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Prepare both tables."""
        self._table = Interpolation(self.speeds, self.rates)
        self._extra = Interpolation(EXTRA_SPEEDS, self.resistances)

    def parts(self, v: float) -> tuple[float, float, float]:
        """Return s(v), p(v) and m(v) [1]."""
        s = self._table.at(v) if len(self.speeds) > 0 else 1.0
        return s, rate_slope(v, self.max_speed), rate_changeover(v, self.blend_speed)

    def extra(self, v: float) -> float:
        """Return x(v) [N/kN]."""
        return self._extra.at(v) if len(self.resistances) > 0 else 0.0

    def place(self, run: float, v: float) -> tuple[float, float]:
        """Return z + y v^2 after a distance [N/kN] and its derivative by the distance [N/kN per m]."""
        x, z, y = self.ahead, self.at_place, self.by_square
        k = min(max(bisect_right(x, run) - 1, 0), len(x) - 2)
        slope = (z[k + 1] - z[k] + v * v * (y[k + 1] - y[k])) / (x[k + 1] - x[k])
        return z[k] + y[k] * v * v + (run - x[k]) * slope, slope

    def rate(self, v: float, theta: list[float]) -> float:
        """Return r(v) [1]."""
        s, p, m = self.parts(v)
        return s * (theta[RATE] + (theta[SLOPE] * p + theta[CHANGEOVER] * m))

    def by_parameters(self, v: float, target: float, weight: float = 1.0) -> list[float]:
        """Return the weighted derivatives of the deceleration by all parameters, but for T and tau.

        ``target`` is the brake target [m/s^2].
        """
        s, p, m = self.parts(v)
        rate, k = weight * s * target, weight * self.k
        return [rate, rate * p, rate * m, k, k * v, k * v * v, k, 0.0, 0.0]

    def knots(self, v: float) -> list[float]:
        """Return the speeds from zero to v between which r is smooth [m/s]."""
        inner = [self.blend_speed, 2.0 * self.blend_speed, self.max_speed]
        inner.extend(self.speeds)
        return [0.0, *sorted(x for x in inner if 0.0 < x < v), v]


@dataclass
class Stop:
    """A stop or the bound of one."""

    distance: float = 0.0  # Distance, or its bound [m]; infinite if the train does not stop
    std: float = 0.0  # Standard deviation of the distance [m]
    dD_dv: float = 0.0  # Derivative of the distance by the speed [s]
    # Its derivatives by the parameters, of a bound at the design point
    gradient: list[float] = field(default_factory=lambda: [0.0] * PARAMETERS)


class Braking:
    """A brake application with known parameters ``theta``, in the order of ``RATE`` to ``LAG``.

    ``command`` is u1, the brake target from now on [m/s^2, > 0], ``applied`` is u0, that which acts until then.
    """

    def __init__(self, shape: RateShape, theta: list[float], command: float, applied: float) -> None:
        self._shape, self._theta = shape, theta
        self._command, self._applied = command, applied
        self._dead_steps = math.ceil(max(0.0, theta[DELAY]) / 0.8)  # of at most 0.8 s
        self._dead_end = 0  # Number of steps until the dead time is over; -1 if the train stops before
        self._on_line = len(shape.ahead) > 0
        self._knots = shape.knots(_FASTEST) if self._on_line else [0.0]

    def stop(self, speed: float) -> Stop:
        """Return the stop from a speed [m/s, >= 0]."""
        out = Stop()
        times, speeds, runs = [0.0], [speed], [0.0]
        self._build_up(out, times, speeds, runs)
        last = speeds[len(speeds) - 1]
        costate = self._hold(out, last) if last > 0.0 and not math.isinf(out.distance) else 0.0
        if not math.isinf(out.distance):
            self._go_back(out, times, speeds, runs, costate)
        return out

    def _target(self, t: float) -> float:
        """Return U(t) [m/s^2]."""
        since, tau = t - self._theta[DELAY], self._theta[LAG]
        if since <= 0.0:
            return self._applied
        return self._command + (self._applied - self._command) * math.exp(-since / tau) if tau > 0.0 else self._command

    def _deceleration(self, v: float, target: float, run: float = 0.0) -> float:
        theta = self._theta
        resistance = theta[A] + theta[GRADIENT] + v * (theta[B] + v * theta[C]) + self._shape.extra(v)
        if self._on_line:
            resistance += self._shape.place(run, v)[0]
        return self._shape.rate(v, theta) * target + self._shape.k * resistance

    def _steps(self) -> list[float]:
        """Return the times of all steps until the brake is built up [s]."""
        delay, lag = self._theta[DELAY], self._theta[LAG]
        times, count = [0.0], self._dead_steps
        times.extend([delay * k / count for k in range(1, count + 1)])
        if lag > 0.0:
            times.extend([delay + lag * x for x in _BUILD_UP])
        return times

    def _build_up(self, out: Stop, times: list[float], speeds: list[float], runs: list[float]) -> None:
        """Integrate until the brake is built up, or the train stops, which at a place is the end; collect the steps."""
        steps = self._steps()
        v, t, k, count = speeds[0], 0.0, 1, len(steps)
        self._dead_end = -1 if self._dead_steps > 0 else 0
        while k < count or (self._on_line and v > 0.0):
            end = steps[k] if k < count else math.inf
            if self._on_line:
                end = min(end, t + self._smooth_s(t, v, out.distance))
            after, run = self._step(t, v, end - t, out.distance)
            if after <= 0.0:
                dt = self._time_of_stop(t, v, end - t, after, out.distance)
                after, run, end = 0.0, self._step(t, v, dt, out.distance)[1], t + dt
            out.distance += run
            times.append(end)
            speeds.append(after)
            runs.append(out.distance)
            if k < count and end >= steps[k]:
                if k == self._dead_steps:
                    self._dead_end = len(times) - 1
                k += 1
            v, t = after, end
            if v <= 0.0:
                return
            if v > _FASTEST or out.distance > _FURTHEST_M:
                out.distance = math.inf
                return

    def _smooth_s(self, t: float, v: float, run: float) -> float:
        """Return how long a step may be that ends at the next knot of place or speed at the latest [s]."""
        knots, ahead = self._knots, self._shape.ahead
        d = self._deceleration(v, self._target(t), run)
        step = min(max(_SHARE * v / max(abs(d), 1e-9), _SHORTEST_S), _LONGEST_S)
        k = bisect_right(ahead, run + _NEAR_M)
        gap = ahead[k] - run if k < len(ahead) else _FURTHEST_M
        square = v * v - 2.0 * d * gap  # of the speed there
        if square > 0.0:
            step = min(step, 2.0 * gap / (v + math.sqrt(square)))
        k = bisect_left(knots, v - _NEAR_SPEED)
        return min(step, (v - knots[k - 1]) / d) if d > 0.0 and k > 1 else step

    def _step(self, t: float, v: float, dt: float, run: float) -> tuple[float, float]:
        """Return speed [m/s] and distance [m] after a step of Runge-Kutta."""
        start, middle, end = self._target(t), self._target(t + 0.5 * dt), self._target(t + dt)
        k1 = self._deceleration(v, start, run)
        k2 = self._deceleration(v - 0.5 * dt * k1, middle, run + 0.5 * dt * v)
        k3 = self._deceleration(v - 0.5 * dt * k2, middle, run + 0.5 * dt * (v - 0.5 * dt * k1))
        k4 = self._deceleration(v - dt * k3, end, run + dt * (v - 0.5 * dt * k2))
        way = dt * v - dt * dt * (k1 + k2 + k3) / 6.0
        return v - dt * (k1 + 2.0 * (k2 + k3) + k4) / 6.0, way

    def _time_of_stop(self, t: float, v: float, dt: float, after: float, run: float) -> float:
        """Return the time from t until the train stands [s], by regula falsi (Illinois variant).

        ``after`` is the negative speed after dt.
        """
        low, high, above, below = 0.0, dt, v, after
        for _ in range(60):
            x = low + (high - low) * above / (above - below)
            y = self._step(t, v, x, run)[0]
            if abs(y) < 1e-13 or high - low < 1e-13:
                break
            if y > 0.0:
                low, above, below = x, y, below * 0.5
            else:
                high, below, above = x, y, above * 0.5
        return x

    def _hold(self, out: Stop, speed: float) -> float:
        """Add the stop with the brake built up; return l at its start [s]."""
        target, knots = self._command, self._shape.knots(speed)
        for k in range(1, len(knots)):
            # Near a speed at which the train hardly slows down, distance by speed has a pole.
            self._hold_between(out, knots[k - 1], knots[k], halvings=12)
            if math.isinf(out.distance):
                return 0.0
        return speed / self._deceleration(speed, target)

    def _hold_between(self, out: Stop, low: float, high: float, halvings: int) -> None:
        """Add the way between two speeds, in halves where the deceleration varies too much for the quadrature."""
        target, width = self._command, high - low
        below, above = self._deceleration(low, target), self._deceleration(high, target)
        if min(below, above) <= 0.0:
            out.distance = math.inf
            return
        if halvings > 0 and max(below, above) > 2.0 * min(below, above):
            middle = 0.5 * (low + high)
            self._hold_between(out, low, middle, halvings - 1)
            if not math.isinf(out.distance):
                self._hold_between(out, middle, high, halvings - 1)
            return
        for j in range(5):
            v = low + width * _NODES[j]
            d = self._deceleration(v, target)
            if d <= 0.0:
                out.distance = math.inf
                return
            run = width * _WEIGHTS[j] * v / d
            out.distance += run
            self._add(out.gradient, -run / d, v, target)

    def _add(self, gradient: list[float], weight: float, v: float, target: float) -> None:
        """Add weight times the derivatives of the deceleration by f, e, h, a, b, c and i."""
        found = self._shape.by_parameters(v, target, weight)
        for j in range(DELAY):
            gradient[j] += found[j]

    def _go_back(self, out: Stop, times: list[float], speeds: list[float], runs: list[float], costate: float) -> None:
        """Calculate l and m backwards over the steps, and the derivatives with them (trapezoidal rule)."""
        last, gradient = len(times) - 1, out.gradient
        delay, by_place = self._theta[DELAY], 1.0
        stiffness = self._stiffness(times[last], speeds[last], runs[last])
        for k in range(last, -1, -1):
            width = 0.0
            if k < last:
                dt, before = times[k + 1] - times[k], self._stiffness(times[k], speeds[k], runs[k])
                after = costate
                costate = (costate * (1.0 - 0.5 * dt * stiffness) + dt * by_place) / (1.0 + 0.5 * dt * before)
                stiffness, width = before, dt
                if self._on_line:
                    slope = self._shape.place(0.5 * (runs[k] + runs[k + 1]), speeds[k])[1]
                    by_place -= 0.5 * dt * (costate + after) * self._shape.k * slope
            if k > 0:
                width += times[k] - times[k - 1]
            self._add(gradient, -0.5 * width * costate, speeds[k], self._target(times[k]))
            self._add_lag(gradient, -0.5 * width * costate, speeds[k], times[k] - delay)
            if k == self._dead_end:
                passed = by_place * speeds[k] - costate * self._deceleration(speeds[k], self._applied, runs[k])
                gradient[DELAY] = passed
        out.dD_dv = costate

    def _stiffness(self, t: float, v: float, run: float) -> float:
        """Return the derivative of the deceleration by speed [1/s]."""
        target = self._target(t)
        above = self._deceleration(v + _SPEED_STEP, target, run)
        below = self._deceleration(v - _SPEED_STEP, target, run)
        return (above - below) / (2.0 * _SPEED_STEP)

    def _add_lag(self, gradient: list[float], weight: float, v: float, since: float) -> None:
        """Add weight times the derivative of the deceleration by tau, a time [s] after the dead time."""
        tau = self._theta[LAG]
        if since > 0.0 and tau > 0.0:
            change = (self._applied - self._command) * math.exp(-since / tau) * since / (tau * tau)
            gradient[LAG] += weight * self._shape.rate(v, self._theta) * change


NO_BRAKE: Final = 1e-3
"""Brake rates below this count as no brake [1]."""


@dataclass(frozen=True, slots=True)
class StopPosterior:
    """What is known of the parameters of a stop: independent but for a, b and c."""

    mean: tuple[float, ...]  # in the order of RATE to LAG
    variances: tuple[float, ...]  # of each in its squared unit; those of a, b and c are in ``davis``
    davis: tuple[float, ...]  # covariance of (a, b, c), 3x3, row-major
    dropped: float = 0.0  # probability that the brake rate has dropped since it was last observed [1]
    loss: float = 0.0  # size of such a drop as a share of the rate [1]

    def lower(self) -> StopPosterior:
        """Return what is known of a stop with the lower brake."""
        left = 1.0 - self.loss
        mean = [left * x for x in self.mean[:A]]
        variances = [left * left * x for x in self.variances[:A]]
        return StopPosterior((*mean, *self.mean[A:]), (*variances, *self.variances[A:]), self.davis)

    def spread(self, gradient: list[float]) -> list[float]:
        """Return the covariance times a gradient, shape (9,)."""
        out = [variance * slope for variance, slope in zip(self.variances, gradient, strict=True)]
        for i in range(3):
            row = self.davis[3 * i : 3 * i + 3]
            out[A + i] = row[0] * gradient[A] + row[1] * gradient[B] + row[2] * gradient[C]
        return out

    def std(self, gradient: list[float]) -> float:
        """Return the standard deviation along a gradient."""
        return math.sqrt(max(0.0, math.fsum(map(mul, self.spread(gradient), gradient))))


class _LeastBraking(Braking):
    """A train that decelerates at each place and speed by the least that is credible: z standard deviations less."""

    def __init__(self, shape: RateShape, posterior: StopPosterior, command: float, applied: float, z: float) -> None:
        super().__init__(shape, list(posterior.mean), command, applied)
        self._posterior, self._z = posterior, z

    def _deceleration(self, v: float, target: float, run: float = 0.0) -> float:
        less = self._z * self._posterior.std(self._shape.by_parameters(v, target))
        return super()._deceleration(v, target, run) - less


# So that z0 and z1 are finite: a probability that counts as none, and the least part of the risk 1 - P left to D0 [1].
_NONE, _KNOWN_RISK = 1e-6, 0.01
# Iterations of z0, difference of D0 and D1 that ends them, whose square is left [1], and halvings of it.
_MIXTURE_STEPS, _MIXTURE_ERROR, _HALVINGS = 60, 1e-6, 40
NORMAL: Final = NormalDist()


class StoppingBounds:
    """Bounds of the stopping distance for one brake command, see :class:`Braking`, at a confidence in [0.5, 1).

    ``limit`` says why the command is less than asked for, empty if it is not.
    """

    def __init__(
        self, shape: RateShape, posterior: StopPosterior, command: float, applied: float, confidence: float,
        limit: str = '',
    ) -> None:  # fmt: skip
        self._shape, self._posterior, self._limit = shape, posterior, limit
        self._command, self._applied = command, applied
        self._confidence = confidence
        # That of the brake as known, with a lower one the last z0; its least and largest value.
        self._z = self._z_least = self._z_most = NORMAL.inv_cdf(confidence)
        self._lower: StoppingBounds | None = None
        if posterior.dropped * posterior.loss > 0.0:
            self._lower = StoppingBounds(shape, posterior.lower(), command, applied, confidence)
            share = confidence / max(1.0 - posterior.dropped, confidence)
            self._z_most = NORMAL.inv_cdf(min(share, 1.0 - _KNOWN_RISK * (1.0 - confidence)))
        self._at_mean = Braking(shape, list(posterior.mean), command, applied)
        # Speeds at which the deceleration is checked [m/s], and the number of them at which it is known to be positive.
        knots = shape.knots(MAX_SPEED)
        self._grid = [0.0]
        for k in range(1, len(knots)):
            self._grid.extend([knots[k - 1] + share * (knots[k] - knots[k - 1]) for share in (0.25, 0.5, 0.75, 1.0)])
        self._good = 0

    def at(self, speed: float) -> Stop:
        """Return the bound for a speed [m/s, >= 0]; infinite where the train may not stop."""
        return self._alone(speed, self._z) if self._lower is None else self._mixed(speed, self._lower)

    def _mixed(self, speed: float, lower: StoppingBounds) -> Stop:
        """Return the bound of a brake that may have dropped. For any z0 the longer of D0 and D1 is one."""
        dropped, most, low, high, z = self._posterior.dropped, self._z_most, self._z_least, math.inf, self._z
        best = Stop(math.inf, math.inf, math.inf)
        for _ in range(_MIXTURE_STEPS):
            share = (self._confidence - (1.0 - dropped) * NORMAL.cdf(z)) / dropped
            z_lower = NORMAL.inv_cdf(min(max(share, _NONE), self._confidence))
            known, of_lower = self._alone(speed, z), lower._alone(speed, z_lower)
            excess = known.distance - of_lower.distance
            if z == most and share <= _NONE and excess <= 0.0:
                best = known  # the drop is within the risk
                break
            longer = of_lower if excess < 0.0 else known
            if longer.distance < best.distance:
                best, best.std = longer, known.std
            low, high = (z, high) if excess < 0.0 else (low, z)
            middle = 0.5 * (low + high) if high <= most else most
            if math.isnan(excess) or middle - low <= 1e-12:
                break
            if math.isinf(excess):
                z = middle
                continue
            by_z = max(self._posterior.std(known.gradient), 1e-12)
            by_z_lower = max(lower._posterior.std(of_lower.gradient), 1e-12)
            distance = self._between(known.distance, by_z, z, of_lower.distance, by_z_lower, z_lower)
            if abs(excess) <= _MIXTURE_ERROR * known.distance:
                # Weights by the densities of the distance.
                density, of_drop = (1.0 - dropped) * NORMAL.pdf(z) / by_z, dropped * NORMAL.pdf(z_lower) / by_z_lower
                best.distance = distance
                best.dD_dv = (density * known.dD_dv + of_drop * of_lower.dD_dv) / (density + of_drop)
                break
            following = min(z + (distance - known.distance) / by_z, most)
            z = following if low < following < high else middle
        return best

    def _between(self, known: float, by_z: float, z: float, lower: float, by_z_lower: float, z_lower: float) -> float:
        """Return the distance of the mixture between those of both brakes [m], which are linear in z."""
        dropped, low, high = self._posterior.dropped, min(known, lower), max(known, lower)
        for _ in range(_HALVINGS):
            x = 0.5 * (low + high)
            share = (1.0 - dropped) * NORMAL.cdf(z + (x - known) / by_z)
            share += dropped * NORMAL.cdf(z_lower + (x - lower) / by_z_lower)
            low, high = (x, high) if share < self._confidence else (low, x)
        return high

    def _alone(self, speed: float, z: float) -> Stop:
        """Return the bound of this brake alone at a z."""
        self._good, self._z = (self._good if z <= self._z else 0), z
        at_mean = self._at_mean.stop(speed)
        if math.isinf(at_mean.distance) or not self._slows_down(speed):
            return Stop(math.inf, math.inf, math.inf)
        std, on_line = self._posterior.std(at_mean.gradient), len(self._shape.ahead) > 0
        found = longest = self.design_point_step(speed, at_mean.gradient)
        for _ in range(_ON_LINE_STEPS if on_line else 200):
            if math.isinf(found.distance):
                break
            before, found = found.distance, self.design_point_step(speed, found.gradient)
            # Where a little more speed carries the train over a summit, the steps may go to and fro.
            if not (on_line and found.distance < longest.distance):
                longest = found
            if abs(found.distance - before) <= 1e-9 * before:
                break
        else:
            longest = longest if on_line else Stop(math.inf, std, math.inf)
        longest.std = std
        return longest

    def _slows_down(self, speed: float) -> bool:
        """Return whether the built-up brake decelerates the train at all speeds up to one [m/s], or stops it there."""
        slowest = _LeastBraking(self._shape, self._posterior, self._command, self._applied, self._z)
        if self._shape.ahead:
            return not math.isinf(slowest.stop(speed).distance)
        last = bisect_right(self._grid, speed)
        while self._good < last:
            if slowest._deceleration(self._grid[self._good], self._command) <= 0.0:
                return False
            self._good += 1
        return slowest._deceleration(speed, self._command) > 0.0

    def design_point_step(self, speed: float, gradient: list[float]) -> Stop:
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

        The train stops within the distance from all speeds up to this one. It is at most ``MAX_SPEED``, and 0 where
        even the slowest train may not stop within the distance.

        Raises:
            NoAnswerError: The train may not stop from any speed.
        """
        low, high, speed = 0.0, MAX_SPEED, min(self._first_guess(distance), MAX_SPEED)
        found = self.at(speed)
        for _ in range(100):
            excess = found.distance - distance
            if (
                abs(excess) <= 1e-9
                or high - low <= (1e-6 if self._shape.ahead else 1e-12)
                or (speed == MAX_SPEED and excess < 0.0)
            ):
                break
            low, high = (low, speed) if excess > 0.0 else (speed, high)
            # Newton's method, or halves where it leaves the bracket.
            following = speed - excess / found.dD_dv if 0.0 < found.dD_dv < math.inf else -math.inf
            inner = following if low < following < high else 0.5 * (low + high)
            speed = MAX_SPEED if following >= high == MAX_SPEED else inner
            found = self.at(speed)
        if found.distance > distance + 1e-6:  # it leaps, as where a faster train passes the top of a hill
            speed, found = low, self.at(low)
        if speed > 1e-9:  # else it counts as standstill
            # For unphysical drag the sign of the derivative is unreliable.
            return speed, found.std / abs(found.dD_dv)
        if math.isinf(self.at(1e-3).distance):  # not even the slowest train may stop
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
        weak = self._limit or f'command = {-self._command:g} m/s^2'
        return f'at this confidence the train may not stop: {weak} is too weak here'
