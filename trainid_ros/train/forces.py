# SPDX-License-Identifier: Apache-2.0
"""Longitudinal force balance of a train in specific form: newtons per kilonewton of its weight.

``1000 F / (M g0) = w(v) + i + w_extra + 1000 (1 + gamma) (dv/dt) / g0`` with the Davis resistance
``w(v) = a + b v + c v^2`` [N/kN, v in m/s], the gradient i [per mille, + uphill] and gamma the
rotating mass as a share of the mass [1].

The brake actuator follows ``tau a' = -a + u(t - delay)``. The command u is piecewise constant, so the
response over each piece is known in closed form: no Pade approximation and no step-size error.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Final, overload

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, stored
from trainid_ros.train.train_file import Brake, Davis, Train

G: Final = 9.80665
"""Standard gravity g0 [m/s^2] (3rd CGPM, 1901), used throughout the package."""


@overload
def davis(resistance: Davis, v: float) -> float: ...
@overload
def davis(resistance: Davis, v: NDArray[np.float64]) -> NDArray[np.float64]: ...
def davis(resistance: Davis, v: Any) -> Any:
    """Return the running resistance [N/kN] at a speed [m/s], or at each of an array of speeds."""
    return resistance.a + v * (resistance.b + resistance.c * v)


def load_drag(c: float, mass: float, weighed: float, v: float) -> float:
    """Return by how much the drag c v^2 [N/kN] of a mass [kg] differs at the mass as weighed [kg], negative if more.

    ``c`` is its part that goes by 1/weight [N/kN per (m/s)^2], ``v`` the speed [m/s]. Without a weighed mass it is 0.
    """
    return c * v * v * (mass / weighed - 1.0) if is_finite(weighed) else 0.0


def specific_force(force: float, mass: float) -> float:
    """Return ``1000 F / (M g0)`` [N/kN] of a force [N] on a mass [kg]."""
    return force * (1000.0 / (mass * G))


def specific_inertia(acceleration: float, rotary_mass: float) -> float:
    """Return ``1000 (1 + gamma) a / g0`` [N/kN] of an acceleration [m/s^2]; ``rotary_mass`` is gamma [1]."""
    return acceleration * (1000.0 * (1.0 + rotary_mass) / G)


def acceleration(force: float, mass: float, rotary_mass: float, resistance: float) -> float:
    """Return the acceleration [m/s^2] of a mass [kg] under a force [N] and the total resistance [N/kN].

    ``resistance`` is the sum w(v) + i + w_extra, ``rotary_mass`` is gamma [1].
    """
    return (specific_force(force, mass) - resistance) * (G / (1000.0 * (1.0 + rotary_mass)))


def required_force(acceleration: float, mass: float, rotary_mass: float, resistance: float) -> float:
    """Return the force [N] that gives an acceleration [m/s^2]: the inverse of :func:`acceleration`."""
    return (specific_inertia(acceleration, rotary_mass) + resistance) * (mass * G / 1000.0)


MAX_CHANGES: Final = 1024
"""Maximum length of a history of commands, to bound the memory: more than 200 s at 5 Hz."""


@dataclass(frozen=True, slots=True)
class BrakeCommandChange:
    """A brake command that holds from ``stamp_ns`` on [m/s^2, <= 0]."""

    stamp_ns: int
    target_acceleration: float


@dataclass
class CommandHistory:
    """Bounded history of the piecewise-constant brake command; changes oldest first, the newest ``MAX_CHANGES``."""

    changes: tuple[BrakeCommandChange, ...] = stored((), kind=BrakeCommandChange)

    def push(self, change: BrakeCommandChange) -> None:
        """Add a change; a repeat of the last value is dropped, and one with the stamp of the last one replaces it.

        InputError if the change is older than the last one, or its value is not finite or is positive.
        """
        value = change.target_acceleration
        if not (is_finite(value) and value <= 0.0):
            raise InputError(f'target_acceleration = {value:g} m/s^2 must be finite and <= 0')
        kept = self.changes
        if kept and change.stamp_ns < kept[-1].stamp_ns:
            raise InputError(
                f'brake command stamp_ns = {change.stamp_ns} is earlier than the last one, {kept[-1].stamp_ns}'
            )
        if kept and change.stamp_ns == kept[-1].stamp_ns:
            kept = kept[:-1]
        if not kept or kept[-1].target_acceleration != value:
            kept = (*kept, change)[-MAX_CHANGES:]
        self.changes = kept

    def follow(self, changes: tuple[BrakeCommandChange, ...]) -> None:
        """Add the changes of a sample; those older than the last one, which arrived late, are dropped."""
        for change in changes:
            if not self.changes or change.stamp_ns >= self.changes[-1].stamp_ns:
                self.push(change)

    def prune(self, before_ns: int) -> None:
        """Drop the changes that do not affect the command at or after a time [ns]."""
        first = 0
        while first + 1 < len(self.changes) and self.changes[first + 1].stamp_ns <= before_ns:
            first += 1
        if first:
            self.changes = self.changes[first:]

    def value(self, at_ns: int) -> float:
        """Return the command in force at a time [ns] in m/s^2; 0.0 before the first change."""
        count = self._count_until(at_ns)
        return self.changes[count - 1].target_acceleration if count else 0.0

    def segments(self, start_ns: int, end_ns: int) -> list[tuple[float, float]]:
        """Return the pieces (duration [s], value [m/s^2]) of the command over (start, end] [ns].

        InputError if the end is before the start.
        """
        if end_ns < start_ns:
            raise InputError(f'brake command interval ends at {end_ns} ns, before its start {start_ns} ns')
        pieces = []
        while start_ns < end_ns:
            count = self._count_until(start_ns)
            until_ns = self.changes[count].stamp_ns if count < len(self.changes) else end_ns
            until_ns = min(until_ns, end_ns)
            value = self.changes[count - 1].target_acceleration if count else 0.0
            pieces.append((seconds(until_ns - start_ns), value))
            start_ns = until_ns
        return pieces

    def _count_until(self, at_ns: int) -> int:
        """Return the number of changes until a time [ns], which as a rule is close to the newest."""
        count = len(self.changes)
        while count and self.changes[count - 1].stamp_ns > at_ns:
            count -= 1
        return count


def actuator_response(
    commands: CommandHistory, start_ns: int, end_ns: int, initial: float, *, delay_ns: int, time_constant: float
) -> tuple[float, float]:
    """Return the output [m/s^2] at the end of (start, end] [ns], and its integral over it [m/s].

    ``initial`` is the output at the start [m/s^2], ``time_constant`` that of the lag [s].
    """
    output, integral = initial, 0.0
    for duration, target in commands.segments(start_ns - delay_ns, end_ns - delay_ns):
        integral += lag_integral(output, target, time_constant, duration)
        output = lag_response(output, target, time_constant, duration)
    return output, integral


class BrakeActuator:
    """The brake command after the dead time and the lag of the train file, followed from stamp to stamp.

    Attributes:
        commands: Commands that may still act.
        output: Present output [m/s^2, <= 0], that of a brake of rate 1.
        delay_ns: Dead time [ns].
    """

    STATE: ClassVar[State] = declare('commands', 'output')

    def __init__(self, brake: Brake) -> None:
        self.delay_ns = round(brake.delay * NS_PER_S)
        self._time_constant = brake.time_constant
        self.commands, self.output = CommandHistory(), 0.0

    def advance(self, start_ns: int, end_ns: int) -> float:
        """Advance over (start, end] [ns]; return the integral of the output over it [m/s]."""
        self.output, integral = actuator_response(
            self.commands, start_ns, end_ns, self.output, delay_ns=self.delay_ns, time_constant=self._time_constant
        )
        self.commands.prune(end_ns - self.delay_ns)
        return integral


def held_by(train: Train, force: float) -> float:
    """Return the output of the brake that has held a train until its record begins [m/s^2], by its force [N].

    No train stands without a brake, whatever the command says by then.
    """
    return min(0.0, force / (train.mass * (1.0 + train.rotary_mass)))  # 0 where the force is not known


def lag_response(initial: float, target: float, time_constant: float, duration: float) -> float:
    """Return the output of a first-order lag after a constant target has acted for a duration [s].

    ``y(T) = target + (initial - target) exp(-T / tau)`` with the time constant tau [s], in the unit of the target;
    with ``tau`` = 0 the output follows immediately.
    """
    if duration <= 0.0:
        return initial
    if time_constant <= 0.0:
        return target
    return target + (initial - target) * math.exp(-duration / time_constant)


def lag_integral(initial: float, target: float, time_constant: float, duration: float) -> float:
    """Return the exact integral of :func:`lag_response` over the duration [s].

    ``target T + (initial - target) tau (1 - exp(-T / tau))``: for accelerations [m/s^2], the change of speed [m/s].
    """
    if duration <= 0.0:
        return 0.0
    if time_constant <= 0.0:
        return target * duration
    decay = -math.expm1(-duration / time_constant)
    return target * duration + (initial - target) * time_constant * decay


class Interpolation:
    """Values [any unit] at rising x [s or m]: linear between them, constant beyond both ends."""

    def __init__(self, x: list[float], y: list[float]) -> None:
        self.x, self.y = x, y

    def at(self, x: float) -> float:
        """Return the value at one x; faster than numpy's interpolation for one point."""
        right = bisect_right(self.x, x)
        if right == 0:
            return self.y[0]
        if right == len(self.x):
            return self.y[right - 1]
        low, high = self.x[right - 1], self.x[right]
        share = (x - low) / (high - low)
        return self.y[right - 1] + share * (self.y[right] - self.y[right - 1])

    def before(self, x: float, distance: float) -> float:
        """Return the value a distance before x."""
        return self.at(x - distance)

    def ahead(self, x: float, distance: float) -> float:
        """Return the value a distance ahead of x."""
        return self.at(x + distance)


STANDING: Final = 0.5
"""A train slower than this may stand [m/s]: passengers change, and with them the mass. Faster ones have departed."""
COOLING_S: Final = 300.0
"""Cooling time constant of the brake [s]: a hot brake loses 63 % of its heat in this time."""
BRAKE_APPLIED: Final = -0.02
"""The brake counts as applied when its nominal acceleration is below this value [m/s^2]."""


def _zero(_: float) -> float:
    return 0.0


@dataclass(slots=True)
class TrackPoint:
    """Position and motion of the train at one time; unknown values have neutral defaults.

    Live estimators use one object for all times: an effect must not keep it.
    """

    time_s: float  # Time since the start [s]
    position: float  # Position of the train's front [m], NaN if unknown
    direction: int  # +1 while positions increase, -1 while they decrease
    speed: float  # Speed [m/s, >= 0]
    curve_radius: float = 0.0  # Radius that gives the mean curvature under the train [m], 0 = straight
    tunnel: bool = False  # True in a tunnel
    length: float = 0.0  # Length of the train [m]; 0 treats it as a point at its front
    distance_run: float = 0.0  # Distance run since the start [m]
    # Time since the brake was released [s]; 0 while it is applied, infinite if it never was. A train that stands as
    # its record begins was held until then.
    since_release: float = math.inf
    traction: float = 0.0  # Reported traction, 1000 F/(M g0) with the assumed mass M [N/kN]
    brake: float = 0.0  # Braking force of the assumed brake, including its rate, per assumed weight [N/kN, <= 0]
    heat: float = 0.0  # Heat stored in this brake after cooling [J per kg of train]
    acceleration: float = 0.0  # Acceleration [m/s^2]; 0 in live estimators, which measure only speed
    run: int = 0  # Number of departures since the start; 0 if not known
    # ``brake`` a number of seconds ago; constant in live estimators, which shift its dead time instead
    brake_before: Callable[[float], float] = _zero
    # ``traction`` a number of seconds ago; only fits have future values (negative seconds)
    traction_before: Callable[[float], float] = _zero
    # Reported gradient [per mille] a number of metres ahead; negative metres are behind
    gradient_ahead: Callable[[float], float] = _zero


def heat_after(heat: float, brake: float, speed: float, duration: float) -> float:
    """Return the heat in a brake [J/kg] after braking at constant acceleration: the solution of h' = -brake v - h / T.

    ``brake`` is the acceleration by the assumed brake [m/s^2, <= 0], ``speed`` the mean speed [m/s].
    """
    decay = math.exp(-duration / COOLING_S)
    return heat * decay - brake * speed * COOLING_S * (1.0 - decay)


def share_inside(at: TrackPoint, start: float, end: float) -> float:
    """Return the share [0 to 1] of the train between two positions [m]; 0 while its position is unknown."""
    if math.isnan(at.position):
        return 0.0
    if at.length <= 0.0:
        return 1.0 if start <= at.position < end else 0.0
    low = at.position - at.length if at.direction > 0 else at.position
    high = low + at.length
    if high <= start or low >= end:
        return 0.0
    return (min(high, end) - max(low, start)) / at.length
