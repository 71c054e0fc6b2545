# SPDX-License-Identifier: Apache-2.0
"""Train dynamics: the specific balance, integrated with an exact brake actuator.

``(1 + gamma) M dv/dt = F + f (1 + gamma) M u - M g / 1000 (w(v) + i + w_extra + gust)`` with the reported traction F,
the lagged and delayed brake target u <= 0, the brake rate f (times its table over speed if there is one) and the
assumed mass M: all effects act as extra resistance. Speed and position use the midpoint rule, whose error at
20 ms steps is far below that of any sensor.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from copy import copy
from dataclasses import dataclass
from typing import Final

import numpy as np

from trainid_ros.records import NS_PER_S
from trainid_ros.settings import check_settings, setting
from trainid_ros.train.brake import BrakeCommandChange, CommandHistory, actuator_response
from trainid_ros.train.davis import G, davis, specific_force, specific_inertia
from trainid_ros.train.effects import BRAKE_APPLIED, TrackPoint, heat_after, resistance_terms
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import TrainFile

STEP_NS: Final = 20_000_000


class Plant:
    """Simulated train; its public attributes are the true state.

    Attributes:
        now_ns: Time of the state [ns].
        position: Position of the front [m].
        direction: +1 while positions increase, -1 while they decrease.
        speed: Speed [m/s], never negative: a stopped train is held in place.
        acceleration: Mean acceleration over the last step [m/s^2].
        traction: Traction as reported by the drive [N].
        brake: Lagged and delayed brake target [m/s^2, <= 0].
        mass: Assumed mass [kg].
        resistance: Current Davis resistance.
        brake_rate: Current brake rate, or the factor on its table over speed [1].
        gust: Additional gust resistance [N/kN].
        distance_run: Distance run since the start [m].
        heat: Heat in the brake, calculated without fade [J/kg].
        work: Work of the traction since the start [J].

    """

    def __init__(self, train_file: TrainFile, profile: LineProfile, start_ns: int, jerk: float) -> None:
        """Start at rest at the first stop of the line.

        Args:
            train_file: The true train.
            profile: The true line profile for this train.
            start_ns: Start time [ns].
            jerk: Maximum rate of change of the traction, as jerk [m/s^3].

        Raises:
            InputError: An effect is unknown or has invalid parameters.

        """
        self.profile = profile
        self.now_ns = start_ns
        self.position = train_file.line.stops[0] if train_file.line.stops else 0.0
        self.direction = 1
        self.speed = self.acceleration = self.traction = self.brake = 0.0
        self.mass = train_file.train.mass
        self.resistance = train_file.resistance
        self.brake_rate = train_file.brake.rate
        self.gust = self.distance_run = self.heat = self.work = 0.0
        self._train, self._rate_shape = train_file.train, train_file.brake.shape_at
        self._jerk = jerk
        self._start_ns = start_ns
        self._time_constant = train_file.brake.time_constant
        self._delay_ns = round(train_file.brake.delay * NS_PER_S)
        self._commands = CommandHistory()
        self._terms = resistance_terms(train_file.effects)
        self._tractions, self._brakes = DelayLine(), DelayLine()
        self._since_release = math.inf

    @property
    def reported_force(self) -> float:
        """Force reported by drive and brake control [N]; braking is reported as that of a nominal brake."""
        return self.traction + self.mass * (1.0 + self._train.rotary_mass) * self.brake

    def twin(self) -> Plant:
        """Return a train in the same state that goes on by itself."""
        other = copy(self)
        other._commands = CommandHistory(self._commands.changes)
        other._tractions, other._brakes = self._tractions.twin(), self._brakes.twin()
        return other

    def command(self, target_acceleration: float) -> None:
        """Set the brake target [m/s^2, <= 0] from now on."""
        change = BrakeCommandChange(self.now_ns, target_acceleration)
        self._commands.push(change)
        self._commands.prune(self.now_ns - self._delay_ns)

    def step(self, traction_demand: float, dt_ns: int = STEP_NS) -> None:
        """Advance by one step [ns] while the traction ramps towards a demand [N]."""
        dt = dt_ns / NS_PER_S
        brake = self._brake_acceleration(dt_ns)
        traction = self._ramp_traction(traction_demand, dt)
        driven = traction / (self.mass * (1.0 + self._train.rotary_mass)) + brake
        if self._terms:
            middle_ns = self.now_ns + dt_ns // 2
            self._tractions.add(middle_ns, specific_force(traction, self.mass))
            self._brakes.add(middle_ns, specific_inertia(brake, self._train.rotary_mass))
        acceleration = driven - self._retardation(0.0)
        middle = max(0.0, self.speed + 0.5 * dt * acceleration)
        self.heat = heat_after(self.heat, brake, middle, dt)
        before = self.distance_run
        self._move(driven - self._retardation(0.5 * dt, middle), dt)
        self.work += traction * (self.distance_run - before)
        self.now_ns += dt_ns

    def _retardation(self, ahead_s: float, speed: float | None = None) -> float:
        """Return the deceleration by all resistances [m/s^2] a time [s] ahead of the state."""
        v = self.speed if speed is None else speed
        position = self.position + self.direction * ahead_s * v
        w = davis(self.resistance, v) + self.gust + self.profile.gradient(position, self.direction)
        if self._terms:
            point = self._track_point(position, v, ahead_s)
            for term in self._terms:
                w += term(self.resistance, point)
        return w * G / (1000.0 * (1.0 + self._train.rotary_mass))

    def _track_point(self, position: float, speed: float, ahead_s: float) -> TrackPoint:
        profile, direction = self.profile, self.direction
        return TrackPoint(
            time_s=(self.now_ns - self._start_ns) / NS_PER_S + ahead_s,
            position=position,
            direction=direction,
            speed=speed,
            curve_radius=profile.curve_radius(position, direction),
            tunnel=profile.tunnel(position, direction),
            length=profile.length,
            distance_run=self.distance_run,
            since_release=self._since_release,
            traction=self._tractions.before(0.0),
            brake=self._brakes.before(0.0),
            heat=self.heat,
            acceleration=self.acceleration,
            brake_before=self._brakes.before,
            traction_before=self._tractions.before,
            gradient_ahead=lambda ahead: profile.gradient(position + direction * ahead, direction),
        )

    def _move(self, acceleration: float, dt: float) -> None:
        before = self.speed
        after = before + acceleration * dt
        if after > 0.0:
            run = 0.5 * (before + after) * dt
        else:
            # The train stops within the step and is held there.
            run = 0.5 * before * before / -acceleration if before > 0.0 else 0.0
            after = 0.0
        self.speed = after
        self.acceleration = (after - before) / dt
        self.position += self.direction * run
        self.distance_run += run

    def _ramp_traction(self, demand: float, dt: float) -> float:
        """Ramp the traction towards its demand; return its mean over the step [N]."""
        max_change = self._jerk * self.mass * dt
        before = self.traction
        self.traction = before + min(max_change, max(-max_change, demand - before))
        return 0.5 * (before + self.traction)

    def _brake_acceleration(self, dt_ns: int) -> float:
        """Advance the actuator under its delayed command; return the mean brake acceleration [m/s^2]."""
        start_ns, delay_ns, tau = self.now_ns, self._delay_ns, self._time_constant
        self.brake, change = actuator_response(
            self._commands, start_ns, start_ns + dt_ns, self.brake, delay_ns=delay_ns, time_constant=tau
        )
        dt = dt_ns / NS_PER_S
        self._since_release = 0.0 if self.brake < BRAKE_APPLIED else self._since_release + dt
        return self.brake_rate * self._rate_shape(self.speed) * change / dt


@dataclass(frozen=True, slots=True)
class GustModel:
    """Gust resistance [N/kN]: AR(1) process ``r(t + dt) = rho r(t) + noise`` with rho = exp(-dt / tau)."""

    std: float = setting(0.1, 'standard deviation of the gust resistance', 'N/kN', 0.0, 10.0)
    time_constant: float = setting(5.0, 'correlation time of the gust resistance', 's', 0.01, 1e4)


class Gust:
    """Gust resistance, sampled in equal time steps; ``value`` is the current one [N/kN]."""

    def __init__(self, model: GustModel, dt: float, rng: np.random.Generator) -> None:
        """Start from the stationary distribution.

        Args:
            model: Standard deviation and correlation time.
            dt: Time step [s].
            rng: Random generator; the process takes ownership.

        Raises:
            InputError: A setting is out of range.

        """
        check_settings(model)
        self._rho = math.exp(-dt / model.time_constant)
        self._noise_std = model.std * math.sqrt(1.0 - self._rho**2)
        self._rng = rng
        self.value = model.std * float(rng.standard_normal())

    def step(self) -> float:
        """Advance by one step and return the resistance [N/kN]."""
        self.value = self._rho * self.value + self._noise_std * float(self._rng.standard_normal())
        return self.value


MAX_DELAY_S: Final = 12.0
"""Length of the history [s]; no effect looks back further."""


class DelayLine:
    """Bounded history of values over time; 0 before the first one."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._values: list[float] = []

    def twin(self) -> DelayLine:
        """Return a copy."""
        other = DelayLine()
        other._stamps, other._values = self._stamps.copy(), self._values.copy()
        return other

    def add(self, stamp_ns: int, value: float) -> None:
        """Append a value; stamps [ns] must increase."""
        self._stamps.append(stamp_ns)
        self._values.append(value)
        oldest_ns = stamp_ns - round(MAX_DELAY_S * NS_PER_S)
        # Old values are deleted in batches, which is cheaper than one by one.
        if self._stamps[0] < oldest_ns - round(MAX_DELAY_S * NS_PER_S):
            count = bisect_right(self._stamps, oldest_ns) - 1
            del self._stamps[:count], self._values[:count]

    def before(self, seconds: float) -> float:
        """Return the interpolated value a number of seconds before the newest one; the newest one if negative."""
        if not self._stamps or seconds <= 0.0:
            return self._values[-1] if self._values else 0.0
        at_ns = self._stamps[-1] - round(seconds * NS_PER_S)
        right = bisect_right(self._stamps, at_ns)
        if right == 0:
            return 0.0
        left_ns, left = self._stamps[right - 1], self._values[right - 1]
        return left + (self._values[right] - left) * (at_ns - left_ns) / (self._stamps[right] - left_ns)
