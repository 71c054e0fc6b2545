# SPDX-License-Identifier: Apache-2.0
"""Line profile under a train of finite length.

Gradient and curvature are means over the train, by the mass of its cars if they are stated, else by their length.
Positions are those of the train's front. Its rear is one length behind: at ``position - length`` while
positions increase (direction +1), at ``position + length`` while they decrease (-1). Values of the train file
apply from their position on; the first one also applies before it.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from itertools import pairwise, takewhile

from trainid_ros.interface.errors import InputError
from trainid_ros.train.train_file import Line, Pairs, TrainFile

SAME_STOP_M = 5.0
"""A stop closer than this [m] is the one the train is standing at, not the next one."""


class LineProfile:
    """Gradient, curve, tunnel and speed limit under a train; fast for single positions.

    Attributes:
        line: Line of the train file.
        length: Length of the train [m]; InputError unless it is positive.
        joints: Where its mass per metre changes [m from the end that leads while positions increase], with both ends.
        first: Where the line begins [m]: the lower one of first stop and first gradient, less the length of the train.
        last: Where it ends [m]. A line without stops has no ends.
    """

    def __init__(self, line: Line, train_length: float, consist: Pairs = ()) -> None:
        """Prepare a line for a train of a length [m] and, unless its mass is even, mass [kg] and length [m] of cars."""
        if not train_length > 0.0:
            raise InputError(f'train length = {train_length:g} m must be > 0')
        self.line, self.length = line, train_length
        self.joints, self._shares = _spread(train_length, consist)
        self._gradient = _Steps(line.gradient)
        self._curvature = _Steps(tuple((x, 1.0 / r if r > 0.0 else 0.0) for x, r in line.curve))
        # Of two edges at one position the later one applies: adjacent tunnels are joined.
        edges = dict(edge for start, end in line.tunnel for edge in ((start, 1.0), (end, 0.0)))
        self._tunnel = _Steps(((line.tunnel[0][0] - 1.0, 0.0), *edges.items()) if edges else ())
        ends = (*line.stops, *(x for x, _ in line.gradient)) if line.stops else (-math.inf, math.inf)
        self.first, self.last = min(ends) - train_length, max(ends) + train_length
        self._limit_from = [x for x, _ in line.speed_limit]
        self._limit = [v for _, v in line.speed_limit]

    def gradient(self, position: float, direction: int) -> float:
        """Return the mean gradient under the train [per mille, + uphill in its direction]: its height difference."""
        if self._shares:
            return direction * self._by_mass(self._gradient, position, direction)
        rear = position - direction * self.length
        return (self._gradient.integral(position) - self._gradient.integral(rear)) / self.length

    def curve_radius(self, position: float, direction: int) -> float:
        """Return the radius of the mean curvature under the train [m]; 0 = straight."""
        if self._curvature.always_zero:
            return 0.0
        mean = self._by_mass if self._shares else self._mean
        curvature = mean(self._curvature, position, direction)
        return 1.0 / curvature if curvature > 0.0 else 0.0

    def tunnel(self, position: float, direction: int) -> bool:
        """Return whether at least half of the train is in a tunnel."""
        return not self._tunnel.always_zero and self._mean(self._tunnel, position, direction) >= 0.5

    def speed_limit(self, position: float, direction: int) -> float:
        """Return the lowest speed limit under the train [m/s], infinite if there is none."""
        if not self._limit:
            return math.inf
        rear = position - direction * self.length
        first = max(0, bisect_right(self._limit_from, min(position, rear)) - 1)
        last = bisect_left(self._limit_from, max(position, rear))
        return min(self._limit[first : max(last, first + 1)])

    def limits_ahead(self, position: float, direction: int, distance: float) -> Pairs:
        """Return the speed limits that begin within a distance ahead: (distance [m], limit [m/s])."""
        starts, limits = self._limit_from, self._limit
        if direction > 0:
            places = range(bisect_right(starts, position), len(starts))
            ahead = ((starts[i] - position, limits[i]) for i in places)
        else:
            places = range(bisect_left(starts, position) - 1, 0, -1)
            ahead = ((position - starts[i], limits[i - 1]) for i in places)
        return tuple(takewhile(lambda limit: limit[0] <= distance, ahead))

    def next_stop(self, position: float, direction: int) -> float | None:
        """Return the position of the next stop [m], None beyond the last one."""
        stops = self.line.stops
        if direction > 0:
            i = bisect_right(stops, position + SAME_STOP_M)
            return stops[i] if i < len(stops) else None
        i = bisect_left(stops, position - SAME_STOP_M) - 1
        return stops[i] if i >= 0 else None

    def _mean(self, steps: _Steps, position: float, direction: int) -> float:
        rear = position - direction * self.length
        return abs(steps.integral(position) - steps.integral(rear)) / self.length

    def _by_mass(self, steps: _Steps, position: float, direction: int) -> float:
        top = position if direction > 0 else position + self.length
        heights = [steps.integral(top - joint) for joint in self.joints]
        return math.fsum(share * (a - b) for share, (a, b) in zip(self._shares, pairwise(heights), strict=True))


def profile_of(train_file: TrainFile) -> LineProfile:
    """Return the line of a train file under its train."""
    train = train_file.train
    return LineProfile(train_file.line, train.length, train.consist)


def _spread(length: float, consist: Pairs) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return where the mass per metre changes [m], with both ends, and shares of the mass per metre; none if even."""
    joints, densities = [0.0], list[float]()
    for mass, metres in consist:
        if densities and math.isclose(densities[-1], mass / metres):
            joints[-1] += metres
        else:
            densities.append(mass / metres)
            joints.append(joints[-1] + metres)
    if len(densities) < 2:
        return (0.0, length), ()
    stretch = length / joints[-1]  # what is rounded in the lengths of the cars
    mass = math.fsum(mass for mass, _ in consist) * stretch
    return tuple(stretch * x for x in joints), tuple(density / mass for density in densities)


class _Steps:
    """A piecewise-constant function with its integral; the first and last values extend beyond the ends."""

    def __init__(self, pairs: Pairs) -> None:
        knots = pairs or ((0.0, 0.0),)
        self._x = [x for x, _ in knots]
        self._value = [value for _, value in knots]
        self._sum = [0.0]
        for (x, value), (following, _) in pairwise(knots):
            self._sum.append(self._sum[-1] + value * (following - x))
        self.always_zero = not any(self._value)

    def integral(self, x: float) -> float:
        """Return the integral from the first knot to x [m]."""
        i = max(0, bisect_right(self._x, x) - 1)
        return self._sum[i] + self._value[i] * (x - self._x[i])
